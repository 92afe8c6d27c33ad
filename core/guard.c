/* Guards of a half-edge collapse.
 *
 * Both neighbours of a patch face make the edges and triangles inside it, so a patch that made one of its own would
 * have it doubled or crossed by the other: only the border rule may put an edge there. Thin triangles have no
 * trustworthy normal, and a border vertex that lies almost on an edge is a crack to the eye: an altitude is at least
 * 1/100 cell. */
#include "core/guard.h"

bool guard_patch_faces(const struct halfedge_mesh *mesh, const uint8_t *faces, const struct halfedge_ring *ring,
                       uint32_t u, uint32_t allowed)
{
	if (!faces[u])
		return true;
	for (uint32_t k = 0; k < ring->n; k++) {
		uint32_t x = ring->x[k], y = ring->y[k];
		if (x != u && y != u && (faces[u] & faces[x] & faces[y]))
			return false;
		if (x != u && x != allowed && (faces[u] & faces[x]) && !halfedge_marked(mesh, x))
			return false;
		if (y != u && y != allowed && (faces[u] & faces[y]) && !halfedge_marked(mesh, y))
			return false;
	}
	return true;
}

static struct vec3 between(const int32_t a[3], const int32_t b[3])
{
	return (struct vec3){b[0] - a[0], b[1] - a[1], b[2] - a[2]};
}

/* Differences, normals and squared sides are whole numbers below 2^53: as doubles they are exact. */
bool guard_turn(const int32_t v[3], const int32_t to[3], const int32_t b[3], const int32_t c[3], double cosine)
{
	struct vec3 bc = between(b, c), ab = between(to, b), ac = between(to, c);
	double longest = vec3_dot(ab, ab), side = vec3_dot(ac, ac);
	longest = longest > side ? longest : side;
	side = vec3_dot(bc, bc);
	longest = longest > side ? longest : side;
	return guard_normals(vec3_cross(between(v, b), between(v, c)), vec3_cross(ab, ac), longest, cosine);
}

bool guard_shape(const struct halfedge_mesh *mesh, const struct halfedge_ring *ring, uint32_t u, double cosine)
{
	for (uint32_t k = 0; k < ring->n; k++) {
		uint32_t x = ring->x[k], y = ring->y[k];
		if (x != u && y != u &&
		    !guard_turn(mesh->position[ring->v], mesh->position[u], mesh->position[x], mesh->position[y],
		                cosine))
			return false;
	}
	return true;
}

bool guard_fan(const struct fan *fan, struct vec3 v, double cosine)
{
	double before[FAN_MAX], after[FAN_MAX], dot[FAN_MAX];
	struct vec3 back = vec3_sub(v, fan->a);
	bool all = true;
	for (uint32_t k = 0; k < fan->n; k++) {
		double bx = fan->ab[0][k] - back.x, by = fan->ab[1][k] - back.y, bz = fan->ab[2][k] - back.z;
		double cx = fan->ac[0][k] - back.x, cy = fan->ac[1][k] - back.y, cz = fan->ac[2][k] - back.z;
		double x = by * cz - bz * cy, y = bz * cx - bx * cz, z = bx * cy - by * cx;
		double nx = fan->normal[0][k], ny = fan->normal[1][k], nz = fan->normal[2][k];
		before[k] = x * x + y * y + z * z;
		after[k] = nx * nx + ny * ny + nz * nz;
		dot[k] = x * nx + y * ny + z * nz;
	}
	for (uint32_t k = 0; k < fan->n; k++) {
		double longest = fan->ab_ab[k] > fan->ac_ac[k] ? fan->ab_ab[k] : fan->ac_ac[k];
		longest = longest > fan->bc_bc[k] ? longest : fan->bc_bc[k];
		all &= guard_lengths(before[k], after[k], dot[k], longest, cosine);
	}
	return all;
}
