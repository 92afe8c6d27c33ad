/* Follows the map of a running facetd and says what every commit brought, and how much floor-like surface there is: area
 * whose normal points up. Goes on through a restart of the daemon.
 *
 *     cc follow.c -o follow $(pkg-config --cflags --libs libfacet)
 *     ./follow [ADDRESS [COMMITS]] */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include <facet.h>

/* Twice the area vector of a triangle. */
static void cross(const double *a, const double *b, const double *c, double ret[3])
{
	for (int i = 0; i < 3; i++) {
		const int j = (i + 1) % 3, k = (i + 2) % 3;
		ret[i] = (b[j] - a[j]) * (c[k] - a[k]) - (b[k] - a[k]) * (c[j] - a[j]);
	}
}

/* Square metres of a patch that one could stand on. */
static double level_m2(const struct facet_patch *patch, double cell_m)
{
	struct facet_patch_info info;
	facet_patch_info(patch, &info);
	double *vertex = malloc(3 * sizeof(double) * info.vertices), sum = 0;
	if (!vertex)
		return 0;
	facet_patch_vertices(patch, cell_m, vertex);
	const uint32_t *triangle = facet_patch_triangles(patch);
	for (uint32_t t = 0; t < info.triangles; t++, triangle += 3) {
		double normal[3];
		cross(vertex + 3 * triangle[0], vertex + 3 * triangle[1], vertex + 3 * triangle[2], normal);
		const double area = sqrt(normal[0] * normal[0] + normal[1] * normal[1] + normal[2] * normal[2]) / 2;
		if (normal[2] > 2 * area * 0.95)
			sum += area;
	}
	free(vertex);
	return sum;
}

static void show(struct facet *facet, const struct facet_event *event)
{
	const struct facet_patch *const *patch;
	struct facet_map map;
	size_t n;
	double level = 0;
	if (facet_map(facet, &map) || facet_patches(facet, &patch, &n))
		return;
	for (size_t i = 0; i < n; i++)
		level += level_m2(patch[i], map.cell_m);
	printf("step %llu: %zu patches changed, %zu removed%s; %zu in all, %.1f m2 level\n",
	       (unsigned long long)event->step, event->changed, event->removed, event->reset ? ", a new map" : "", n,
	       level);
	fflush(stdout);
}

int main(int argc, char **argv)
{
	char error[FACET_ERROR_MAX];
	struct facet_event event;
	long left = argc > 2 ? atol(argv[2]) : -1;
	struct facet *facet = facet_open(argc > 1 ? argv[1] : NULL, 5000, error);
	if (!facet || facet_want(facet, NULL)) {
		fprintf(stderr, "follow: %s\n", facet ? facet_error(facet) : error);
		facet_close(facet);
		return 1;
	}
	while (left != 0 && facet_follow(facet, -1, &event) > 0) {
		if (event.kind == FACET_COMMIT)
			show(facet, &event);
		else if (event.kind == FACET_LOST)
			fprintf(stderr, "follow: %s\n", facet_error(facet));
		left -= left > 0 && event.kind == FACET_COMMIT;
	}
	facet_close(facet);
	return 0;
}
