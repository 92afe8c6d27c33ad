/* A whole mesh in one piece: the patches of a store, welded.
 *
 * Two vertices are one exactly where their lattice points are equal; a patch's point (key, u16 0..4096) is a point of
 * the lattice of the whole map, so that no tolerance is needed and none is used. Normals are summed as integers (a
 * cross product of lattice differences is twice the area, exactly), so they do not depend on the order of the faces.
 * Vertices come in the order of patch keys and of vertices in a patch, only those that a triangle uses. */
#include "core/model.h"

#include <assert.h>
#include <errno.h>
#include <math.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define PATCH_LATTICE (PATCH_SIDE * LATTICE)
#define NOT_USED      UINT32_MAX

struct point {
	int64_t at[3]; /* of the whole map's lattice */
};

struct weld {
	struct point *point;  /* [nv] */
	int64_t (*normal)[3]; /* [nv] sums */
	uint32_t *slot;       /* open addressing, vertex + 1; 0 is free */
	size_t slots;         /* a power of two, more than twice the vertices */
	uint32_t *local;      /* [PATCH_VERTICES_MAX] vertex of a patch -> vertex of the model */
	uint32_t nv;
};

static uint64_t point_hash(const struct point *p)
{
	uint64_t h = 0;
	for (int a = 0; a < 3; a++) {
		h = (h + (uint64_t)p->at[a]) * 0x9e3779b97f4a7c15ull;
		h ^= h >> 29;
	}
	return h;
}

static uint32_t weld_point(struct weld *weld, const struct point *p)
{
	size_t at = point_hash(p) & (weld->slots - 1);
	for (; weld->slot[at]; at = (at + 1) & (weld->slots - 1))
		if (!memcmp(&weld->point[weld->slot[at] - 1], p, sizeof *p))
			return weld->slot[at] - 1;
	weld->point[weld->nv] = *p;
	weld->slot[at] = ++weld->nv;
	return weld->nv - 1;
}

static void add_normal(struct weld *weld, const uint32_t triangle[3])
{
	int64_t u[3], v[3];
	for (int a = 0; a < 3; a++) {
		u[a] = weld->point[triangle[1]].at[a] - weld->point[triangle[0]].at[a];
		v[a] = weld->point[triangle[2]].at[a] - weld->point[triangle[0]].at[a];
	}
	for (int a = 0; a < 3; a++) {
		int b = (a + 1) % 3, c = (a + 2) % 3;
		for (int corner = 0; corner < 3; corner++)
			weld->normal[triangle[corner]][a] += u[b] * v[c] - u[c] * v[b];
	}
}

static void weld_vertices(struct weld *weld, const struct patch *patch)
{
	for (uint32_t v = 0; v < patch->nv; v++)
		weld->local[v] = NOT_USED;
	for (uint32_t t = 0; t < patch->nt; t++)
		for (int c = 0; c < 3; c++)
			weld->local[patch->triangle[t][c]] = 0;
	const int32_t key[3] = {patch->key.x, patch->key.y, patch->key.z};
	for (uint32_t v = 0; v < patch->nv; v++) {
		struct point p;
		if (weld->local[v] == NOT_USED)
			continue;
		for (int a = 0; a < 3; a++)
			p.at[a] = (int64_t)key[a] * PATCH_LATTICE + patch->vertex[v][a];
		weld->local[v] = weld_point(weld, &p);
	}
}

/* Planes of a patch are local to it: each gets a number of its own in the model, from *planes on. */
static void weld_patch(struct weld *weld, const struct patch *patch, struct model *model, int32_t *planes)
{
	uint32_t t = 0;
	weld_vertices(weld, patch);
	for (uint32_t r = 0; r < patch->nruns; r++) {
		const struct patch_run *run = &patch->run[r];
		if (run->plane != PLANE_NONE && (r == 0 || run->plane != run[-1].plane))
			++*planes;
		for (uint32_t i = 0; i < run->triangles; i++, t++, model->nt++) {
			uint32_t *triangle = model->triangle[model->nt];
			for (int c = 0; c < 3; c++)
				triangle[c] = weld->local[patch->triangle[t][c]];
			model->plane[model->nt] = run->plane == PLANE_NONE ? -1 : *planes - 1;
			model->class[model->nt] = run->class;
			add_normal(weld, triangle);
		}
	}
}

static int weld_reserve(struct weld *weld, struct model *model, size_t nv, size_t nt)
{
	if (nv >= UINT32_MAX || nt >= UINT32_MAX)
		return -ENOMEM;
	weld->slots = 64;
	while (weld->slots <= nv * 2)
		weld->slots *= 2;
	weld->point = calloc(nv + 1, sizeof *weld->point);
	weld->normal = calloc(nv + 1, sizeof *weld->normal);
	weld->slot = calloc(weld->slots, sizeof *weld->slot);
	weld->local = calloc(PATCH_VERTICES_MAX, sizeof *weld->local);
	model->triangle = calloc(nt + 1, sizeof *model->triangle);
	model->plane = calloc(nt + 1, sizeof *model->plane);
	model->class = calloc(nt + 1, sizeof *model->class);
	bool all =
	    weld->point && weld->normal && weld->slot && weld->local && model->triangle && model->plane && model->class;
	return all ? 0 : -ENOMEM;
}

static void weld_finish(struct weld *weld)
{
	free(weld->point);
	free(weld->normal);
	free(weld->slot);
	free(weld->local);
}

/* Metres and unit normals; straight up where the faces of a point cancel out. */
static int place_vertices(const struct weld *weld, double cell_m, struct model *model)
{
	double unit = cell_m / LATTICE;
	model->vertex = calloc(weld->nv + 1, sizeof *model->vertex);
	model->normal = calloc(weld->nv + 1, sizeof *model->normal);
	if (!model->vertex || !model->normal)
		return -ENOMEM;
	model->nv = weld->nv;
	for (uint32_t v = 0; v < weld->nv; v++) {
		double n[3], length = 0;
		for (int a = 0; a < 3; a++) {
			model->vertex[v][a] = (double)weld->point[v].at[a] * unit;
			n[a] = (double)weld->normal[v][a];
			length += n[a] * n[a];
		}
		length = sqrt(length);
		for (int a = 0; a < 3; a++)
			model->normal[v][a] = length > 0 ? (float)(n[a] / length) : (float)(a == 2);
	}
	return 0;
}

int model_weld(const struct patch_store *store, double cell_m, struct model *ret)
{
	assert(store && ret);
	struct weld weld = {0};
	struct model model = {0};
	struct patch **patches;
	size_t n = patch_store_living(store, &patches), nv = 0, nt = 0;
	if (!patches)
		return -ENOMEM;
	for (size_t i = 0; i < n; i++) {
		nv += patches[i]->nv;
		nt += patches[i]->nt;
	}
	int32_t planes = 0;
	int r = weld_reserve(&weld, &model, nv, nt);
	for (size_t i = 0; i < n && !r; i++)
		weld_patch(&weld, patches[i], &model, &planes);
	if (!r)
		r = place_vertices(&weld, cell_m, &model);
	weld_finish(&weld);
	free(patches);
	if (r)
		model_finish(&model);
	else
		*ret = model;
	return r;
}

void model_finish(struct model *model)
{
	free(model->vertex);
	free(model->normal);
	free(model->triangle);
	free(model->plane);
	free(model->class);
	*model = (struct model){0};
}

bool buffer_reserve(struct buffer *buffer, size_t more)
{
	size_t cap = buffer->cap ? buffer->cap : 256;
	if (buffer->error)
		return false;
	if (more <= buffer->cap - buffer->len)
		return true;
	while (cap - buffer->len < more && cap <= SIZE_MAX / 2)
		cap *= 2;
	uint8_t *data = cap - buffer->len < more ? NULL : realloc(buffer->data, cap);
	if (!data) {
		buffer->error = -ENOMEM;
		return false;
	}
	buffer->data = data;
	buffer->cap = cap;
	return true;
}

void buffer_append(struct buffer *buffer, const void *data, size_t len)
{
	if (!len || !buffer_reserve(buffer, len))
		return;
	memcpy(buffer->data + buffer->len, data, len);
	buffer->len += len;
}

void buffer_printf(struct buffer *buffer, const char *format, ...)
{
	char text[256];
	va_list args;
	va_start(args, format);
	int n = vsnprintf(text, sizeof text, format, args);
	va_end(args);
	if (n < (int)sizeof text) {
		buffer_append(buffer, text, n > 0 ? (size_t)n : 0);
		return;
	}
	if (!buffer_reserve(buffer, (size_t)n + 1))
		return;
	va_start(args, format);
	vsnprintf((char *)buffer->data + buffer->len, (size_t)n + 1, format, args);
	va_end(args);
	buffer->len += (size_t)n;
}

void buffer_finish(struct buffer *buffer)
{
	free(buffer->data);
	*buffer = (struct buffer){0};
}
