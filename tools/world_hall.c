/* The hall: 14 x 9 x 3.2 m with pillars, a round column, tables, cupboards, doors, window niches and stairs. The corner
 * with the smallest x and y is the origin. The robot drives once around the round column and never touches anything. */
#include "tools/world_parts.h"

#define LENGTH 14.0
#define WIDTH  9.0
#define HEIGHT 3.2
#define SHELL  0.3 /* of floor, ceiling and walls, outwards */

static void shell(struct world *w)
{
	/* Door leaves stand 8 cm back in their openings, window panes 20 cm. */
	static const struct world_opening door[] = {{3.0, 4.0, 0.0, 2.1}, {9.5, 11.1, 0.0, 2.1}};
	static const struct world_opening window[] = {
	    {1.0, 2.6, 0.9, 2.4}, {4.2, 5.8, 0.9, 2.4}, {7.4, 9.0, 0.9, 2.4}, {10.6, 12.2, 0.9, 2.4}};

	world_box(w, -SHELL, -SHELL, -SHELL, LENGTH + SHELL, WIDTH + SHELL, 0.0);
	world_box(w, -SHELL, -SHELL, HEIGHT, LENGTH + SHELL, WIDTH + SHELL, HEIGHT + SHELL);
	world_box(w, -SHELL, -SHELL, 0.0, 0.0, WIDTH + SHELL, HEIGHT);
	world_box(w, LENGTH, -SHELL, 0.0, LENGTH + SHELL, WIDTH + SHELL, HEIGHT);
	world_wall_x(w, -0.08, 0.0, LENGTH, 0.08, HEIGHT, door, 2);
	world_box(w, 0.0, -SHELL, 0.0, LENGTH, -0.08, HEIGHT);
	world_wall_x(w, WIDTH, 0.0, LENGTH, 0.2, HEIGHT, window, 4);
	world_box(w, 0.0, WIDTH + 0.2, 0.0, LENGTH, WIDTH + SHELL, HEIGHT);
}

static void pillars(struct world *w)
{
	for (int i = 0; i < 4; i++) {
		double x = i & 1 ? 10.2 : 3.8, y = i & 2 ? 5.9 : 3.0;

		world_box(w, x - 0.2, y - 0.2, 0.0, x + 0.2, y + 0.2, HEIGHT);
	}
	world_cylinder(w, 6.6, 4.4, 0.35, 0.0, HEIGHT);
}

static void furniture(struct world *w)
{
	world_table(w, 5.4, 5.6, 1.6, 0.8, 0.74, 0.0);
	world_table(w, 12.4, 5.2, 1.6, 0.8, 0.74, 90.0);
	world_table(w, 11.6, 7.6, 1.8, 0.9, 0.74, 25.0);
	world_box(w, 0.0, 0.4, 0.0, 0.45, 1.6, 1.9);
	world_box(w, 0.0, 5.2, 0.0, 0.6, 7.6, 2.2);
	world_box(w, 13.5, 6.6, 0.0, LENGTH, 8.4, 1.2);
	world_turned_box(w, 6.0, 0.5, 1.2, 0.45, 0.0, 1.9, 8.0);
	world_turned_box(w, 8.0, 8.3, 0.6, 0.6, 0.0, 0.6, 30.0);
	world_cylinder(w, 13.3, 4.0, 0.25, 0.0, 0.8);
	world_stairs(w, 12.0, 0.0, 1.5, 6, 0.17, 0.29);
}

void world_build_hall(struct world *w)
{
	static const struct world_corner path[] = {{2.0, 1.7}, {8.7, 1.7}, {8.7, 7.0}, {2.0, 7.0}, {2.0, 4.5}};

	shell(w);
	pillars(w);
	furniture(w);
	world_path(w, path, 5, 0.8, 0.5, 0.5);
}
