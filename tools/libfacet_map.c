/* What a client holds, as libfacet's users see it: a struct facet_patch is a struct patch. */
#include <assert.h>
#include <errno.h>
#include <string.h>

#include "tools/libfacet.h"

static const struct patch *patch_of(const struct facet_patch *patch)
{
	return (const struct patch *)patch;
}

int facet_map(const struct facet *facet, struct facet_map *ret)
{
	const struct native_hello *hello = native_mirror_hello(libfacet_mirror(facet));
	if (!hello)
		return -EAGAIN;
	*ret = (struct facet_map){.generation = hello->generation,
	                          .cell_m = hello->cell_m,
	                          .step = native_mirror_step(libfacet_mirror(facet))};
	memcpy(ret->id, hello->map_id, sizeof(ret->id));
	return 0;
}

const struct facet_patch *facet_changed(const struct facet *facet, size_t i)
{
	size_t n;
	struct patch *const *changed = native_mirror_changed(libfacet_mirror(facet), &n);
	assert(i < n);
	return (const struct facet_patch *)changed[i];
}

void facet_removed(const struct facet *facet, size_t i, int32_t ret_key[3])
{
	size_t n;
	struct patch *const *removed = native_mirror_removed(libfacet_mirror(facet), &n);
	assert(i < n);
	ret_key[0] = removed[i]->key.x;
	ret_key[1] = removed[i]->key.y;
	ret_key[2] = removed[i]->key.z;
}

const struct facet_patch *facet_patch_at(const struct facet *facet, const int32_t key[3])
{
	const struct patch *patch =
	    patch_store_get(native_mirror_patches(libfacet_mirror(facet)), (struct patch_key){key[0], key[1], key[2]});
	return patch && patch->nt ? (const struct facet_patch *)patch : NULL;
}

int facet_hash(const struct facet *facet, char ret[65])
{
	patch_store_hash(native_mirror_patches(libfacet_mirror(facet)), ret);
	return ret[0] ? 0 : -ENOMEM;
}

/* The count is all that changes of a patch, so taking it through a const pointer breaks no promise. */
const struct facet_patch *facet_patch_ref(const struct facet_patch *patch)
{
	return (const struct facet_patch *)patch_ref((struct patch *)patch);
}

void facet_patch_unref(const struct facet_patch *patch)
{
	patch_unref((struct patch *)patch);
}

void facet_patch_info(const struct facet_patch *facet_patch, struct facet_patch_info *ret)
{
	const struct patch *patch = patch_of(facet_patch);
	*ret = (struct facet_patch_info){.key = {patch->key.x, patch->key.y, patch->key.z},
	                                 .version = patch->version,
	                                 .t_first_ns = patch->t_first_ns,
	                                 .t_last_ns = patch->t_last_ns,
	                                 .vertices = patch->nv,
	                                 .triangles = patch->nt,
	                                 .runs = patch->nruns};
}

const uint16_t *facet_patch_lattice(const struct facet_patch *patch)
{
	return &patch_of(patch)->vertex[0][0];
}

const uint32_t *facet_patch_triangles(const struct facet_patch *patch)
{
	return &patch_of(patch)->triangle[0][0];
}

/* Through integers of the whole map, so that equal points of two patches become equal numbers. */
void facet_patch_vertices(const struct facet_patch *facet_patch, double cell_m, double *ret)
{
	const struct patch *patch = patch_of(facet_patch);
	const int64_t from[3] = {patch->key.x, patch->key.y, patch->key.z};
	for (uint32_t i = 0; i < patch->nv; i++)
		for (int axis = 0; axis < 3; axis++)
			ret[3 * i + (uint32_t)axis] =
			    (double)(from[axis] * PATCH_SIDE * LATTICE + patch->vertex[i][axis]) / LATTICE * cell_m;
}

void facet_patch_runs(const struct facet_patch *facet_patch, struct facet_run *ret)
{
	const struct patch *patch = patch_of(facet_patch);
	uint32_t first = 0;
	for (uint32_t i = 0; i < patch->nruns; i++) {
		ret[i] = (struct facet_run){first, patch->run[i].triangles, patch->run[i].plane, patch->run[i].class};
		first += patch->run[i].triangles;
	}
}
