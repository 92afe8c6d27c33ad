/* A small software renderer: a look into a building from above, as a picture. */
#ifndef FACET_TOOLS_RENDER_H
#define FACET_TOOLS_RENDER_H

#include <stdbool.h>

#include "tools/mesh_read.h"

#define RENDER_SIDE_MAX 4096 /* pixels; larger pictures are refused */

struct render_view {
	int width, height; /* pixels */
	double yaw_rad;    /* 0 looks along x, positive to the left */
	double pitch_rad;  /* how far it looks down: pi/2 is a plan */
	double cut_m;      /* what lies higher is cut off; INFINITY: nothing */
	bool edges;        /* draw the triangles' edges */
};

struct picture {
	int width, height;
	uint8_t *rgb; /* rows from the top, three bytes a pixel */
};

/* The height at which a storey is best cut: above door height, below the ceiling; INFINITY where there is no ceiling. */
double render_cut_height(const struct mesh *);

/* 0, -EINVAL (nothing to see, impossible size) or -ENOMEM. */
int render_mesh(const struct mesh *, const struct render_view *, struct picture *ret);
int render_png(const struct picture *, struct buffer *ret);
void picture_finish(struct picture *);

#endif
