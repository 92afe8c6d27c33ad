/* Guards of a half-edge collapse.
 *
 * Both neighbours of a patch face make the edges and triangles inside it, so a patch that made one of its own would
 * have it doubled or crossed by the other: only the border rule may put an edge there. Thin triangles have no
 * trustworthy normal, and a border vertex that lies almost on an edge is a crack to the eye: an altitude is at least
 * 1/100 cell. */
#include "core/guard.h"

#include "core/predicates.h"

#define ALTITUDE_MIN (0.01 * LATTICE)

bool guard_patch_faces(struct halfedge_mesh *mesh, const uint8_t *faces, uint32_t h, uint32_t v, uint32_t allowed)
{
	uint32_t u = halfedge_other(mesh, h, v);
	if (!faces[u])
		return true;
	halfedge_mark_ring(mesh, u);
	HALFEDGE_EACH(mesh, e, v)
	{
		uint32_t x = halfedge_target(mesh, e), y = mesh->origin[halfedge_previous(e)];
		if (x != u && y != u && (faces[u] & faces[x] & faces[y]))
			return false;
		if (x != u && x != allowed && (faces[u] & faces[x]) && mesh->mark[x] != mesh->stamp)
			return false;
		if (y != u && y != allowed && (faces[u] & faces[y]) && mesh->mark[y] != mesh->stamp)
			return false;
	}
	return true;
}

static double squared(const int64_t n[3])
{
	return (double)n[0] * (double)n[0] + (double)n[1] * (double)n[1] + (double)n[2] * (double)n[2];
}

static bool thick(const int64_t normal[3], const int32_t a[3], const int32_t b[3], const int32_t c[3])
{
	int64_t ab = distance_squared3(a, b), bc = distance_squared3(b, c), ca = distance_squared3(c, a);
	int64_t longest = ab > bc ? ab : bc;
	longest = longest > ca ? longest : ca;
	return squared(normal) > ALTITUDE_MIN * ALTITUDE_MIN * (double)longest;
}

bool guard_turn(const int32_t v[3], const int32_t to[3], const int32_t b[3], const int32_t c[3], double cosine)
{
	int64_t before[3], after[3];
	triangle_normal(v, b, c, before);
	triangle_normal(to, b, c, after);
	if (!thick(after, to, b, c))
		return false;
	double dot = (double)before[0] * (double)after[0] + (double)before[1] * (double)after[1] +
	             (double)before[2] * (double)after[2];
	double bound = cosine * cosine * squared(before) * squared(after);
	return cosine >= 0 ? dot > 0 && dot * dot > bound : dot >= 0 || dot * dot < bound;
}

bool guard_shape(const struct halfedge_mesh *mesh, uint32_t h, uint32_t v, double cosine)
{
	uint32_t u = halfedge_other(mesh, h, v);
	HALFEDGE_EACH(mesh, e, v)
	{
		uint32_t x = halfedge_target(mesh, e), y = mesh->origin[halfedge_previous(e)];
		if (x != u && y != u &&
		    !guard_turn(mesh->position[v], mesh->position[u], mesh->position[x], mesh->position[y], cosine))
			return false;
	}
	return true;
}
