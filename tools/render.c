/* Deferred: triangles are cut at a height and put into two z-buffers, one for the sides that were seen by a beam and one
 * for the backs, as numbers of faces; then every pixel is lit once. Backs are drawn as a thin veil, so that the walls
 * towards the camera do not hide the rooms behind them.
 *
 * Light is a sky, a sun and the darkness of corners: at each pixel some points of the half space over the face are
 * looked up in the z-buffer (ambient occlusion); corners and things on the floor get their soft shadow by it. The
 * points are turned in a 4 x 4 pattern and the result is smoothed over the same pattern, so no noise remains and no
 * random numbers are needed. Everything is drawn at twice the size and averaged.
 *
 * Depth is kept as 1/w, which is linear on the screen; greater is nearer, 0 is nothing. The camera stands outside of
 * everything that is drawn, so nothing needs to be clipped at a near plane. */
#include "tools/render.h"

#include <errno.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include <png.h>

#define SUPER     2    /* pixels drawn for one shown, each way */
#define FOCAL     2.4  /* in half heights of the picture: 45 degrees of view */
#define MARGIN    0.95 /* of the picture that is used */
#define SAMPLES   16   /* of the half space over a pixel */
#define PATTERN   4
#define NOTHING   UINT32_MAX
#define BACK_VEIL 0.16f
#define PI        3.14159265358979323846

struct point {
	float x, y, z;
};

/* What a side of a face is: a line within a cut triangle, an edge of the mesh, or where the cut went through. */
enum side_kind { SIDE_INNER, SIDE_MESH, SIDE_CUT };

struct face {
	struct point corner[3];
	struct point normal;
	float area; /* m2 */
	uint8_t class;
	uint8_t side[3]; /* of the side that begins at each corner */
};

struct layer {
	float *depth; /* 1/w */
	uint32_t *face;
	uint8_t *ink; /* 0 .. 255: how much of the pixel a line covers */
};

struct canvas {
	int width, height;
	struct point right, up, forward, eye, sun, lamp;
	double focal, cx, cy; /* pixels */
	struct face *face;
	uint32_t faces, cap;
	struct layer front, back;
	float *shadow;  /* 0 dark .. 1 open */
	float radius_m; /* of the shadows of corners */
};

static struct point minus(struct point a, struct point b)
{
	return (struct point){a.x - b.x, a.y - b.y, a.z - b.z};
}

static struct point mix(struct point a, struct point b, float s)
{
	return (struct point){a.x + (b.x - a.x) * s, a.y + (b.y - a.y) * s, a.z + (b.z - a.z) * s};
}

static float dot(struct point a, struct point b)
{
	return a.x * b.x + a.y * b.y + a.z * b.z;
}

static struct point cross(struct point a, struct point b)
{
	return (struct point){a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}

static bool normalise(struct point *p)
{
	const float length = sqrtf(dot(*p, *p));
	if (!(length > 0))
		return false;
	*p = (struct point){p->x / length, p->y / length, p->z / length};
	return true;
}

/* Faces ----------------------------------------------------------------------------------------------------------- */

static int add_face(struct canvas *canvas, struct face face)
{
	if (canvas->faces == canvas->cap) {
		const uint32_t cap = canvas->cap ? 2 * canvas->cap : 4096;
		struct face *grown = realloc(canvas->face, cap * sizeof(*grown));
		if (!grown)
			return -ENOMEM;
		canvas->face = grown;
		canvas->cap = cap;
	}
	const struct point normal = cross(minus(face.corner[1], face.corner[0]), minus(face.corner[2], face.corner[0]));
	face.area = sqrtf(dot(normal, normal)) / 2;
	canvas->face[canvas->faces++] = face;
	return 0;
}

/* What of a triangle lies below the cut: up to four corners, and what the sides from them on are. */
static int cut_triangle(const struct point in[3], float cut, struct point out[4], uint8_t kind[4])
{
	int n = 0;
	for (int i = 0; i < 3; i++) {
		const struct point a = in[i], b = in[(i + 1) % 3];
		if (a.z <= cut) {
			kind[n] = SIDE_MESH;
			out[n++] = a;
		}
		if ((a.z <= cut) != (b.z <= cut)) {
			kind[n] = b.z <= cut ? SIDE_MESH : SIDE_CUT;
			out[n++] = mix(a, b, (cut - a.z) / (b.z - a.z));
		}
	}
	return n;
}

static bool mesh_triangle(const struct mesh *mesh, uint32_t t, struct point ret_corner[3], struct point *ret_normal)
{
	for (int i = 0; i < 3; i++) {
		const float *v = mesh->vertex[mesh->triangle[t][i]];
		ret_corner[i] = (struct point){v[0], v[1], v[2]};
	}
	*ret_normal = cross(minus(ret_corner[1], ret_corner[0]), minus(ret_corner[2], ret_corner[0]));
	return normalise(ret_normal);
}

static int collect_faces(struct canvas *canvas, const struct mesh *mesh, float cut)
{
	for (uint32_t t = 0; t < mesh->nt; t++) {
		struct point in[3], out[4], normal;
		uint8_t kind[4];
		if (!mesh_triangle(mesh, t, in, &normal))
			continue;
		const int n = cut_triangle(in, cut, out, kind);
		for (int i = 2; i < n; i++) {
			const struct face face = {
			    .corner = {out[0], out[i - 1], out[i]},
			    .normal = normal,
			    .class = mesh->class[t],
			    .side = {i == 2 ? kind[0] : SIDE_INNER, kind[i - 1], i == n - 1 ? kind[i] : SIDE_INNER},
			};
			if (add_face(canvas, face))
				return -ENOMEM;
		}
	}
	return canvas->faces ? 0 : -EINVAL;
}

/* Camera ---------------------------------------------------------------------------------------------------------- */

static struct point to_camera(const struct canvas *canvas, struct point p)
{
	const struct point d = minus(p, canvas->eye);
	return (struct point){dot(d, canvas->right), dot(d, canvas->up), dot(d, canvas->forward)};
}

/* x and y in pixels, z = 1/w. */
static struct point project(const struct canvas *canvas, struct point p)
{
	const struct point c = to_camera(canvas, p);
	return (struct point){(float)(canvas->cx + canvas->focal * c.x / c.z),
	                      (float)(canvas->cy - canvas->focal * c.y / c.z), 1 / c.z};
}

struct extent {
	float low, high;
};

#define EXTENT_BINS 1024

static float axis_of(struct point p, int axis)
{
	return axis == 0 ? p.x : axis == 1 ? p.y : p.z;
}

static struct extent extent_of(const struct canvas *canvas, const struct point *corner, int axis)
{
	struct extent all = {INFINITY, -INFINITY};
	for (size_t i = 0; i < 3 * (size_t)canvas->faces; i++) {
		all.low = fminf(all.low, axis_of(corner[i], axis));
		all.high = fmaxf(all.high, axis_of(corner[i], axis));
	}
	return all;
}

/* The same without the outermost 300th of the area at either end: stray specks that a scanner saw through a window do
 * not make the building small. They are still drawn where they fall into the picture. */
static struct extent trimmed_extent(const struct canvas *canvas, const struct point *corner, int axis)
{
	const struct extent all = extent_of(canvas, corner, axis);
	const float width = fmaxf((all.high - all.low) / EXTENT_BINS, 1e-9f);
	double bin[EXTENT_BINS] = {0}, total = 0, sum;
	for (size_t i = 0; i < 3 * (size_t)canvas->faces; i++) {
		const float area = canvas->face[i / 3].area;
		bin[(int)fminf((axis_of(corner[i], axis) - all.low) / width, EXTENT_BINS - 1)] += area;
		total += area;
	}
	int low = 0, high = EXTENT_BINS - 1;
	for (sum = bin[0]; sum < 0.003 * total && low < high; sum += bin[low])
		low++;
	for (sum = bin[high]; sum < 0.003 * total && high > low; sum += bin[high])
		high--;
	return (struct extent){all.low + width * (float)low, all.low + width * (float)(high + 1)};
}

static void map_corners(const struct canvas *canvas, struct point (*map)(const struct canvas *, struct point),
                        struct point *ret)
{
	for (size_t i = 0; i < 3 * (size_t)canvas->faces; i++)
		ret[i] = map(canvas, canvas->face[i / 3].corner[i % 3]);
}

static struct point combine(const struct canvas *canvas, float right, float up, float forward)
{
	const struct point r = canvas->right, u = canvas->up, f = canvas->forward;
	return (struct point){r.x * right + u.x * up + f.x * forward, r.y * right + u.y * up + f.y * forward,
	                      r.z * right + u.z * up + f.z * forward};
}

/* Turns the camera, steps back until everything is before it, then zooms and shifts until the picture is filled. The
 * lights turn with it, so that a scene looks alike from every side. */
static int aim(struct canvas *canvas, const struct render_view *view)
{
	const float cy = (float)cos(view->yaw_rad), sy = (float)sin(view->yaw_rad);
	const float cp = (float)cos(view->pitch_rad), sp = (float)sin(view->pitch_rad);
	struct point *corner = malloc(3 * (size_t)canvas->faces * sizeof(*corner));
	if (!corner)
		return -ENOMEM;
	canvas->forward = (struct point){cp * cy, cp * sy, -sp};
	canvas->right = (struct point){sy, -cy, 0};
	canvas->up = cross(canvas->right, canvas->forward);
	canvas->sun = (struct point){-0.48f * sy - 0.30f * cy, 0.48f * cy - 0.30f * sy, 0.82f};
	canvas->lamp = (struct point){0.75f * sy - 0.45f * cy, -0.75f * cy - 0.45f * sy, 0.48f};
	map_corners(canvas, to_camera, corner); /* the eye is still at the origin */
	struct extent x = trimmed_extent(canvas, corner, 0), y = trimmed_extent(canvas, corner, 1);
	const float wide = fmaxf((x.high - x.low) * (float)canvas->height / (float)canvas->width, y.high - y.low);
	const float trimmed_back = trimmed_extent(canvas, corner, 2).low - (float)FOCAL * wide / 2;
	const float back = fminf(trimmed_back, extent_of(canvas, corner, 2).low - 0.1f * wide - 0.1f);
	canvas->eye = combine(canvas, (x.low + x.high) / 2, (y.low + y.high) / 2, back);
	canvas->focal = 1;
	map_corners(canvas, project, corner);
	x = trimmed_extent(canvas, corner, 0);
	y = trimmed_extent(canvas, corner, 1);
	free(corner);
	const double fit_x = canvas->width / fmax(x.high - x.low, 1e-9),
	             fit_y = canvas->height / fmax(y.high - y.low, 1e-9);
	canvas->focal = MARGIN * fmin(fit_x, fit_y);
	canvas->cx = canvas->width / 2.0 - canvas->focal * (x.low + x.high) / 2;
	canvas->cy = canvas->height / 2.0 - canvas->focal * (y.low + y.high) / 2;
	return 0;
}

/* Drawing --------------------------------------------------------------------------------------------------------- */

/* Twice the area of a, b, p: positive on one side of the edge. */
static float side(struct point a, struct point b, float x, float y)
{
	return (b.x - a.x) * (y - a.y) - (b.y - a.y) * (x - a.x);
}

/* A triangle on the screen. */
struct shape {
	uint32_t face;
	const struct layer *layer;
	struct point p[3];
	float length[3]; /* of its sides, pixels; 0: the side is not drawn */
	float line[3];   /* half the width of the line along a side, pixels */
	float area;
};

static void draw_pixel(const struct canvas *canvas, const struct shape *s, int x, int y)
{
	const float px = (float)x + 0.5f, py = (float)y + 0.5f;
	const struct point *p = s->p;
	const float w[3] = {side(p[1], p[2], px, py) / s->area, side(p[2], p[0], px, py) / s->area,
	                    side(p[0], p[1], px, py) / s->area};
	if (w[0] < 0 || w[1] < 0 || w[2] < 0)
		return;
	const float depth = w[0] * p[0].z + w[1] * p[1].z + w[2] * p[2].z;
	const size_t at = (size_t)y * (size_t)canvas->width + (size_t)x;
	if (depth <= s->layer->depth[at])
		return;
	float cover = 0;
	for (int i = 0; i < 3; i++)
		if (s->length[i] > 0) /* distance from a side: twice the area over it, by its length */
			cover = fmaxf(cover, s->line[i] + 0.5f - w[(i + 2) % 3] * fabsf(s->area) / s->length[i]);
	s->layer->depth[at] = depth;
	s->layer->face[at] = s->face;
	s->layer->ink[at] = (uint8_t)(255 * fminf(cover, 1));
}

static void draw_shape(const struct canvas *canvas, const struct shape *s)
{
	const struct point *p = s->p;
	const int x0 = (int)fmaxf(fminf(fminf(p[0].x, p[1].x), p[2].x), 0);
	const int y0 = (int)fmaxf(fminf(fminf(p[0].y, p[1].y), p[2].y), 0);
	const int x1 = (int)fminf(fmaxf(fmaxf(p[0].x, p[1].x), p[2].x), (float)canvas->width - 1);
	const int y1 = (int)fminf(fmaxf(fmaxf(p[0].y, p[1].y), p[2].y), (float)canvas->height - 1);
	for (int y = y0; y <= y1; y++)
		for (int x = x0; x <= x1; x++)
			draw_pixel(canvas, s, x, y);
}

static void draw_face(const struct canvas *canvas, uint32_t f, bool edges)
{
	const struct face *face = &canvas->face[f];
	const bool front = dot(face->normal, minus(canvas->eye, face->corner[0])) > 0;
	struct shape s = {.face = f, .layer = front ? &canvas->front : &canvas->back};
	for (int i = 0; i < 3; i++)
		s.p[i] = project(canvas, face->corner[i]);
	for (int i = 0; i < 3; i++) {
		const struct point a = s.p[i], b = s.p[(i + 1) % 3];
		const bool drawn = face->side[i] == SIDE_CUT || (face->side[i] == SIDE_MESH && edges && front);
		s.length[i] = drawn ? fmaxf(hypotf(b.x - a.x, b.y - a.y), 1e-6f) : 0;
		s.line[i] = face->side[i] == SIDE_CUT ? 2.6f : 0.6f;
	}
	s.area = side(s.p[0], s.p[1], s.p[2].x, s.p[2].y);
	if (s.area != 0)
		draw_shape(canvas, &s);
}

/* Light ----------------------------------------------------------------------------------------------------------- */

/* The point of the scene that a pixel shows. */
static struct point scene_point(const struct canvas *canvas, int x, int y, float depth)
{
	const float w = 1 / depth;
	const float cx = (float)((x + 0.5 - canvas->cx) / canvas->focal) * w;
	const float cy = (float)((canvas->cy - y - 0.5) / canvas->focal) * w;
	const struct point r = canvas->right, u = canvas->up, f = canvas->forward, e = canvas->eye;
	return (struct point){e.x + r.x * cx + u.x * cy + f.x * w, e.y + r.y * cx + u.y * cy + f.y * w,
	                      e.z + r.z * cx + u.z * cy + f.z * w};
}

/* Points in a ball, spread by the golden angle; turned for each place of the pattern. */
static struct point ball_point(int sample, int turn)
{
	const float z = 1 - 2 * ((float)sample + 0.5f) / SAMPLES;
	const float angle = 2.3999632f * (float)sample + (float)turn * (float)(2 * PI / (PATTERN * PATTERN));
	const float reach = 0.15f + 0.85f * (float)((sample * 7 + turn * 5) % SAMPLES) / SAMPLES;
	const float ring = sqrtf(1 - z * z);
	return (struct point){reach * ring * cosf(angle), reach * ring * sinf(angle), reach * z};
}

/* How open the half space over a pixel is, 0 .. 1. What hides a point from far in front of it does not count. */
static float openness(const struct canvas *canvas, int x, int y, const struct point ball[SAMPLES])
{
	const size_t at = (size_t)y * (size_t)canvas->width + (size_t)x;
	const struct face *face = &canvas->face[canvas->front.face[at]];
	const struct point p = scene_point(canvas, x, y, canvas->front.depth[at]);
	const float r = canvas->radius_m;
	float hidden = 0;
	for (int i = 0; i < SAMPLES; i++) {
		const float flip = dot(ball[i], face->normal) < 0 ? -r : r;
		const float lift = 0.02f * r;
		const struct point q = {p.x + flip * ball[i].x + lift * face->normal.x,
		                        p.y + flip * ball[i].y + lift * face->normal.y,
		                        p.z + flip * ball[i].z + lift * face->normal.z};
		const struct point s = project(canvas, q);
		if (s.x < 0 || s.y < 0 || s.x >= (float)canvas->width || s.y >= (float)canvas->height)
			continue;
		const float depth = canvas->front.depth[(size_t)s.y * (size_t)canvas->width + (size_t)s.x];
		if (depth <= 0)
			continue;
		const float before = 1 / s.z - 1 / depth; /* m that the scene lies before the point */
		if (before > 0.02f * r)
			hidden += before < r ? 1 : r / before * (r / before);
	}
	return 1 - hidden / SAMPLES;
}

static void cast_shadows(struct canvas *canvas)
{
	struct point ball[PATTERN * PATTERN][SAMPLES];
	for (int turn = 0; turn < PATTERN * PATTERN; turn++)
		for (int i = 0; i < SAMPLES; i++)
			ball[turn][i] = ball_point(i, turn);
	for (int y = 0; y < canvas->height; y++)
		for (int x = 0; x < canvas->width; x++) {
			const size_t at = (size_t)y * (size_t)canvas->width + (size_t)x;
			if (canvas->front.face[at] != NOTHING)
				canvas->shadow[at] = openness(canvas, x, y, ball[y % PATTERN * PATTERN + x % PATTERN]);
		}
}

/* The mean over the pattern, of pixels of about the same depth. */
static float smooth_shadow(const struct canvas *canvas, int x, int y)
{
	const float depth = canvas->front.depth[(size_t)y * (size_t)canvas->width + (size_t)x];
	float sum = 0, n = 0;
	for (int v = y - PATTERN / 2; v < y + PATTERN / 2; v++)
		for (int u = x - PATTERN / 2; u < x + PATTERN / 2; u++) {
			if (u < 0 || v < 0 || u >= canvas->width || v >= canvas->height)
				continue;
			const size_t at = (size_t)v * (size_t)canvas->width + (size_t)u;
			if (canvas->front.face[at] == NOTHING || fabsf(canvas->front.depth[at] - depth) > 0.02f * depth)
				continue;
			sum += canvas->shadow[at];
			n += 1;
		}
	return n > 0 ? sum / n : 1;
}

/* What a face is made of, linear light: floors warm, walls nearly white, the rest between. */
static struct point material(const struct face *face)
{
	const struct point floor_colour = {0.64f, 0.53f, 0.40f}, wall = {0.80f, 0.80f, 0.78f},
	                   table = {0.42f, 0.52f, 0.60f};
	if (face->class == 8 || face->class == 4)
		return table;
	const float up = face->normal.z;
	return up > 0 ? mix(wall, floor_colour, up * up * up) : wall;
}

static struct point lit(const struct canvas *canvas, const struct face *face, float open)
{
	const struct point colour = material(face);
	const float sky = 0.50f + 0.08f * face->normal.z;
	const float key = fmaxf(dot(face->normal, canvas->sun), 0), fill = fmaxf(dot(face->normal, canvas->lamp), 0);
	const float shade = open * open * (0.35f + 0.65f * open);
	const float r = (sky * 0.96f + 0.52f * key + 0.16f * fill) * shade;
	const float g = (sky * 1.00f + 0.49f * key + 0.17f * fill) * shade;
	const float b = (sky * 1.07f + 0.43f * key + 0.20f * fill) * shade;
	return (struct point){colour.x * r, colour.y * g, colour.z * b};
}

static struct point background(const struct canvas *canvas, int y)
{
	const struct point top = {0.94f, 0.95f, 0.97f}, bottom = {0.80f, 0.83f, 0.87f};
	return mix(top, bottom, (float)y / (float)canvas->height);
}

static struct point pixel_colour(const struct canvas *canvas, int x, int y)
{
	static const struct point ink = {0.05f, 0.08f, 0.14f}, veil = {0.30f, 0.42f, 0.58f};
	const size_t at = (size_t)y * (size_t)canvas->width + (size_t)x;
	struct point colour = background(canvas, y);
	if (canvas->front.face[at] != NOTHING) {
		colour = lit(canvas, &canvas->face[canvas->front.face[at]], smooth_shadow(canvas, x, y));
		colour = mix(colour, ink, 0.7f * (float)canvas->front.ink[at] / 255);
	}
	if (canvas->back.face[at] != NOTHING && canvas->back.depth[at] > canvas->front.depth[at])
		colour = mix(mix(colour, veil, BACK_VEIL), ink, 0.7f * (float)canvas->back.ink[at] / 255);
	return colour;
}

static uint8_t gamma_byte(float linear)
{
	const float v = linear <= 0.0031308f ? 12.92f * linear : 1.055f * powf(linear, 1 / 2.4f) - 0.055f;
	return (uint8_t)(fminf(fmaxf(v, 0), 1) * 255 + 0.5f);
}

static void show(const struct canvas *canvas, struct picture *picture)
{
	uint8_t *out = picture->rgb;
	for (int y = 0; y < picture->height; y++)
		for (int x = 0; x < picture->width; x++) {
			struct point sum = {0, 0, 0};
			for (int i = 0; i < SUPER * SUPER; i++) {
				const struct point c =
				    pixel_colour(canvas, x * SUPER + i % SUPER, y * SUPER + i / SUPER);
				sum = (struct point){sum.x + c.x, sum.y + c.y, sum.z + c.z};
			}
			*out++ = gamma_byte(sum.x / (SUPER * SUPER));
			*out++ = gamma_byte(sum.y / (SUPER * SUPER));
			*out++ = gamma_byte(sum.z / (SUPER * SUPER));
		}
}

/* The whole ------------------------------------------------------------------------------------------------------- */

static int create_layer(struct layer *layer, size_t n)
{
	layer->depth = calloc(n, sizeof(*layer->depth));
	layer->face = malloc(n * sizeof(*layer->face));
	layer->ink = calloc(n, 1);
	if (!layer->depth || !layer->face || !layer->ink)
		return -ENOMEM;
	memset(layer->face, 0xff, n * sizeof(*layer->face)); /* NOTHING */
	return 0;
}

static void finish_layer(struct layer *layer)
{
	free(layer->depth);
	free(layer->face);
	free(layer->ink);
}

static int create_layers(struct canvas *canvas)
{
	const size_t n = (size_t)canvas->width * (size_t)canvas->height;
	canvas->shadow = calloc(n, sizeof(*canvas->shadow));
	return create_layer(&canvas->front, n) || create_layer(&canvas->back, n) || !canvas->shadow ? -ENOMEM : 0;
}

static void finish_canvas(struct canvas *canvas)
{
	finish_layer(&canvas->front);
	finish_layer(&canvas->back);
	free(canvas->face);
	free(canvas->shadow);
}

static int draw(struct canvas *canvas, const struct render_view *view)
{
	const int error = aim(canvas, view);
	if (error)
		return error;
	for (uint32_t f = 0; f < canvas->faces; f++)
		draw_face(canvas, f, view->edges);
	cast_shadows(canvas);
	return 0;
}

int render_mesh(const struct mesh *mesh, const struct render_view *view, struct picture *ret)
{
	if (view->width < 1 || view->height < 1 || view->width > RENDER_SIDE_MAX || view->height > RENDER_SIDE_MAX)
		return -EINVAL;
	struct canvas canvas = {.width = view->width * SUPER, .height = view->height * SUPER, .radius_m = 0.5f};
	struct picture picture = {.width = view->width, .height = view->height};
	int status = collect_faces(&canvas, mesh, (float)view->cut_m);
	if (!status)
		status = create_layers(&canvas);
	if (!status) {
		picture.rgb = malloc((size_t)view->width * (size_t)view->height * 3);
		status = picture.rgb ? 0 : -ENOMEM;
	}
	if (!status)
		status = draw(&canvas, view);
	if (!status) {
		show(&canvas, &picture);
		*ret = picture;
	} else {
		picture_finish(&picture);
	}
	finish_canvas(&canvas);
	return status;
}

void picture_finish(struct picture *picture)
{
	free(picture->rgb);
	*picture = (struct picture){0};
}

#define STOREY_BINS 512

/* Heights with the most area that looks up, and of that which looks down at least a man's height above it. Without such
 * a ceiling nothing hides the view. */
double render_cut_height(const struct mesh *mesh)
{
	const double bin_m = 0.1, from_m = -STOREY_BINS / 2 * bin_m;
	double up[STOREY_BINS] = {0}, down[STOREY_BINS] = {0};
	for (uint32_t t = 0; t < mesh->nt; t++) {
		struct point corner[3], normal;
		if (!mesh_triangle(mesh, t, corner, &normal) || fabsf(normal.z) < 0.8f)
			continue;
		const struct point c = cross(minus(corner[1], corner[0]), minus(corner[2], corner[0]));
		const double z = (corner[0].z + corner[1].z + corner[2].z) / 3 - from_m;
		const int bin = z < 0 ? 0 : z < bin_m * STOREY_BINS ? (int)(z / bin_m) : STOREY_BINS - 1;
		(normal.z > 0 ? up : down)[bin] += sqrtf(dot(c, c)) / 2;
	}
	int floor_bin = 0, ceiling_bin = -1;
	for (int i = 1; i < STOREY_BINS; i++)
		if (up[i] > up[floor_bin])
			floor_bin = i;
	for (int i = floor_bin + 18; i < STOREY_BINS; i++)
		if (down[i] > (ceiling_bin < 0 ? 0.05 * up[floor_bin] : down[ceiling_bin]))
			ceiling_bin = i;
	return ceiling_bin < 0 ? INFINITY : from_m + bin_m * (floor_bin + 0.75 * (ceiling_bin - floor_bin));
}

int render_png(const struct picture *picture, struct buffer *ret)
{
	png_image image = {.version = PNG_IMAGE_VERSION, .format = PNG_FORMAT_RGB};
	image.width = (png_uint_32)picture->width;
	image.height = (png_uint_32)picture->height;
	png_alloc_size_t size = PNG_IMAGE_PNG_SIZE_MAX(image);
	uint8_t *bytes = malloc(size);
	if (!bytes)
		return -ENOMEM;
	const int good = png_image_write_to_memory(&image, bytes, &size, 0, picture->rgb, 0, NULL);
	if (good)
		buffer_append(ret, bytes, size);
	free(bytes);
	return good ? ret->error : -ENOMEM;
}
