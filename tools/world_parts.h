/* What worlds are built of. world.c knows solids, rays and drives; world_hall.c and world_building.c only furnish. */
#ifndef FACET_TOOLS_WORLD_PARTS_H
#define FACET_TOOLS_WORLD_PARTS_H

#include "tools/simulator.h"

#define WORLD_SOLIDS_MAX 1024 /* at the limit an assertion: worlds are built in */
#define WORLD_PATH_MAX   32

/* Boxes with their sides along the axes, from the corner `lo` to `hi`. */
void world_box(struct world *, double x0, double y0, double z0, double x1, double y1, double z1);
/* The same, turned about its own middle by `yaw_deg`. */
void world_turned_box(struct world *, double x, double y, double length, double width, double z0, double z1,
                      double yaw_deg);
/* An upright cylinder. */
void world_cylinder(struct world *, double x, double y, double radius, double z0, double z1);

/* A hole in a wall, from `from` to `to` along it and from z0 to z1. */
struct world_opening {
	double from, to, z0, z1;
};
/* A wall of the given thickness from floor to `height`, along x (at y..y+thickness) or along y. Openings in order. */
void world_wall_x(struct world *, double y, double x0, double x1, double thickness, double height,
                  const struct world_opening *, int openings);
void world_wall_y(struct world *, double x, double y0, double y1, double thickness, double height,
                  const struct world_opening *, int openings);

/* Furniture; (x, y) is its middle. */
void world_table(struct world *, double x, double y, double length, double width, double height, double yaw_deg);
void world_round_table(struct world *, double x, double y, double radius, double height);
void world_chair(struct world *, double x, double y, double yaw_deg);
/* Steps of `rise` and `run`, climbing along +x from x0. */
void world_stairs(struct world *, double x0, double y0, double y1, int steps, double rise, double run);

/* The drive: straight lines between corners that are rounded with `radius`. */
struct world_corner {
	double x, y;
};
void world_path(struct world *, const struct world_corner *, int n, double radius_m, double speed_m_s,
                double turn_speed_m_s);

void world_build_hall(struct world *);
void world_build_building(struct world *);

#endif
