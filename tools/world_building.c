/* The building: 25 x 15 m, 2.8 m high, a corridor along its middle with three rooms on the north and four on the south
 * side. Doors stand open, ajar or shut; windows are holes, as a laser sees them: no echo from the sky.
 *
 *      +------------+------------+--------------+ y 15
 *      |  workshop  |  meeting   |   office     |
 *      |            |            |   * end      |
 *      +----[ ]-----+----[ ]-----+--[ ]---------+ 8.65
 *  start ->   ->   ->  |             ^              corridor
 *      +---[ ]---+--[|]----+---[ ^]---+--[ ]----+ 6.35
 *      |  store  | kitchen | office   | archive |
 *      |         |    +----->--+      |         |
 *      +---------+---------+----------+---------+ 0
 *      0         6         12         18        25 x
 *
 * The robot comes in through the main door, turns into the kitchen, goes through the door between kitchen and office,
 * back to the corridor and into the northern office. */
#include "tools/world_parts.h"

#define LENGTH 25.0
#define WIDTH  15.0
#define HEIGHT 2.8
#define SHELL  0.3
#define THIN   0.15 /* inner walls */
#define DOOR   2.1  /* height */
#define SILL   0.9
#define LINTEL 2.1

static void shell(struct world *w)
{
	static const struct world_opening south[] = {{1.5, 3.0, SILL, LINTEL},   {7.5, 9.0, SILL, LINTEL},
	                                             {9.6, 11.1, SILL, LINTEL},  {13.5, 15.0, SILL, LINTEL},
	                                             {15.6, 17.1, SILL, LINTEL}, {20.0, 22.5, SILL, LINTEL}};
	static const struct world_opening north[] = {{1.5, 3.5, SILL, LINTEL},   {5.0, 7.0, SILL, LINTEL},
	                                             {10.0, 14.0, SILL, LINTEL}, {17.5, 19.0, SILL, LINTEL},
	                                             {20.0, 21.5, SILL, LINTEL}, {22.5, 24.0, SILL, LINTEL}};
	static const struct world_opening west[] = {{6.7, 8.3, 0.0, DOOR}, {10.5, 12.5, SILL, LINTEL}};
	static const struct world_opening east[] = {{2.0, 4.0, SILL, LINTEL}, {7.0, 8.0, SILL, LINTEL}};

	world_box(w, -3.0, -SHELL, -SHELL, LENGTH + SHELL, WIDTH + SHELL, 0.0);
	world_box(w, -SHELL, -SHELL, HEIGHT, LENGTH + SHELL, WIDTH + SHELL, HEIGHT + SHELL);
	world_wall_x(w, -SHELL, -SHELL, LENGTH + SHELL, SHELL, HEIGHT, south, 6);
	world_wall_x(w, WIDTH, -SHELL, LENGTH + SHELL, SHELL, HEIGHT, north, 6);
	world_wall_y(w, -SHELL, 0.0, WIDTH, SHELL, HEIGHT, west, 2);
	world_wall_y(w, LENGTH, 0.0, WIDTH, SHELL, HEIGHT, east, 2);
}

static void inner_walls(struct world *w)
{
	static const struct world_opening south[] = {
	    {2.5, 3.5, 0.0, DOOR}, {7.5, 8.6, 0.0, DOOR}, {13.4, 14.5, 0.0, DOOR}, {20.5, 21.5, 0.0, DOOR}};
	static const struct world_opening north[] = {
	    {4.0, 5.0, 0.0, DOOR}, {11.0, 12.0, 0.0, DOOR}, {18.0, 19.1, 0.0, DOOR}};
	static const struct world_opening between[] = {{2.7, 3.8, 0.0, DOOR}};

	world_wall_x(w, 6.35, 0.0, LENGTH, THIN, HEIGHT, south, 4);
	world_wall_x(w, 8.5, 0.0, LENGTH, THIN, HEIGHT, north, 3);
	world_wall_y(w, 6.0, 0.0, 6.35, THIN, HEIGHT, NULL, 0);
	world_wall_y(w, 11.0, 0.0, 6.35, THIN, HEIGHT, between, 1);
	world_wall_y(w, 18.0, 0.0, 6.35, THIN, HEIGHT, NULL, 0);
	world_wall_y(w, 8.0, 8.65, WIDTH, THIN, HEIGHT, NULL, 0);
	world_wall_y(w, 16.0, 8.65, WIDTH, THIN, HEIGHT, NULL, 0);
}

/* Leaves of 4 cm; the shut ones lie in the middle of the wall, the open ones stand in the rooms. */
static void door_leaves(struct world *w)
{
	world_box(w, 20.5, 6.40, 0.0, 21.5, 6.44, DOOR);
	world_box(w, 4.0, 8.56, 0.0, 5.0, 8.60, DOOR);
	world_turned_box(w, 2.55, 5.85, 1.0, 0.04, 0.0, DOOR, 85.0);
	world_turned_box(w, 7.45, 5.80, 1.05, 0.04, 0.0, DOOR, 95.0);
	world_turned_box(w, 14.62, 5.84, 1.05, 0.04, 0.0, DOOR, 80.0);
	world_turned_box(w, 12.25, 9.1, 1.0, 0.04, 0.0, DOOR, 60.0);
	world_turned_box(w, 19.2, 9.18, 1.05, 0.04, 0.0, DOOR, 82.0);
	world_turned_box(w, -0.75, 8.42, 0.85, 0.05, 0.0, DOOR, 165.0);
}

static void south_rooms(struct world *w)
{
	world_box(w, 0.0, 0.0, 0.0, 0.5, 5.0, 2.0); /* store: shelves and boxes */
	world_box(w, 5.5, 0.5, 0.0, 6.0, 4.5, 2.0);
	world_turned_box(w, 2.6, 2.2, 0.8, 0.6, 0.0, 0.7, 20.0);
	world_turned_box(w, 2.5, 2.2, 0.5, 0.4, 0.7, 1.1, 35.0);
	world_box(w, 6.15, 0.0, 0.0, 11.0, 0.62, 0.9); /* kitchen: worktop, cupboards over it, a fridge, tables */
	world_box(w, 6.15, 0.0, 1.45, 7.3, 0.35, 2.2);
	world_box(w, 6.15, 0.62, 0.0, 6.8, 1.25, 1.85);
	world_round_table(w, 9.9, 1.7, 0.45, 0.75);
	world_chair(w, 9.9, 5.6, 10.0);
	world_table(w, 9.8, 4.95, 1.4, 0.7, 0.74, 0.0);
	world_table(w, 16.4, 1.2, 1.6, 0.8, 0.74, 0.0); /* office */
	world_table(w, 16.8, 4.6, 0.8, 1.6, 0.74, 0.0);
	world_chair(w, 16.4, 2.0, -100.0);
	world_chair(w, 15.9, 4.6, 0.0);
	world_box(w, 11.15, 0.0, 0.0, 12.6, 0.45, 1.9);
	world_box(w, 11.15, 4.4, 0.0, 11.6, 6.2, 1.4);
	for (int i = 0; i < 3; i++) /* archive */
		world_box(w, 19.5 + 1.8 * i, 0.6, 0.0, 20.0 + 1.8 * i, 4.2, 2.1);
}

static void north_rooms(struct world *w)
{
	world_table(w, 2.0, 14.2, 2.4, 0.9, 0.9, 0.0); /* workshop */
	world_table(w, 6.4, 12.0, 1.0, 2.0, 0.9, 15.0);
	world_cylinder(w, 0.6, 9.4, 0.3, 0.0, 0.9);
	world_table(w, 12.0, 12.2, 3.2, 1.2, 0.74, 0.0); /* meeting */
	for (int i = 0; i < 3; i++) {
		world_chair(w, 11.0 + i, 11.2, 90.0);
		world_chair(w, 11.0 + i, 13.2, -90.0);
	}
	world_box(w, 8.15, 14.4, 0.0, 9.4, 15.0, 0.8);
	world_table(w, 23.4, 11.0, 0.8, 1.8, 0.74, 0.0); /* office */
	world_chair(w, 22.5, 11.0, 0.0);
	world_table(w, 18.4, 14.2, 1.8, 0.8, 0.74, 0.0);
	world_chair(w, 18.4, 13.3, 90.0);
	world_box(w, 16.15, 10.2, 0.0, 16.6, 12.6, 2.0);
	world_box(w, 22.0, 8.65, 0.0, 24.2, 9.1, 1.3);
	world_cylinder(w, 24.3, 14.4, 0.35, 0.0, 1.1);
}

static void corridor(struct world *w)
{
	world_box(w, 10.0, 8.15, 0.0, 10.8, 8.5, 1.9);
	world_box(w, 15.0, 8.2, 0.38, 17.0, 8.5, 0.44); /* a bench */
	world_box(w, 15.1, 8.25, 0.0, 15.2, 8.5, 0.38);
	world_box(w, 16.8, 8.25, 0.0, 16.9, 8.5, 0.38);
	world_cylinder(w, 1.0, 8.2, 0.2, 0.0, 0.6);
	world_cylinder(w, 24.4, 6.9, 0.25, 0.0, 1.2);
}

void world_build_building(struct world *w)
{
	static const struct world_corner path[] = {{-1.0, 7.45},  {8.05, 7.45},  {8.05, 3.25}, {13.95, 3.25},
	                                           {13.95, 7.45}, {18.55, 7.45}, {18.55, 11.4}};

	shell(w);
	inner_walls(w);
	door_leaves(w);
	south_rooms(w);
	north_rooms(w);
	corridor(w);
	world_path(w, path, 7, 0.8, 0.8, 0.55);
}
