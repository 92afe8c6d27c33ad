/* Patches as entities of a scene.
 *
 *   SceneUpdate   deletions = 1, entities = 2
 *   SceneEntity   timestamp = 1, frame_id = 2, id = 3, lifetime = 4, frame_locked = 5, metadata = 6, triangles = 12
 *   Deletion      timestamp = 1, type = 2 (0: the id, 1: all), id = 3
 *   TriangleList  pose = 1, points = 2, color = 3, indices = 5 (packed fixed32)
 *   Pose          position = 1 (x 1, y 2, z 3), orientation = 2 (x 1, y 2, z 3, w 4)
 *
 * An entity replaces the one of the same id, so a patch's key is its id and a new version needs no deletion. Colours per
 * vertex would cost 38 bytes each; one list a class costs as many numbers as one list for all.
 *
 * Positions are global lattice points times the unit, so both neighbours of a border write the same number. Protobuf has
 * them as the doubles that files have; JSON in steps of 0.1 mm, written here: printf would be a third of the cost of
 * a client, and asks the locale. `frame_locked`, because the map is where its frame is now, not where it was then. */
#include "core/scene.h"

#include <assert.h>
#include <errno.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "core/protobuf.h"

#define PATCH_LATTICE (PATCH_SIDE * LATTICE)
#define POINT_BYTES   27 /* three doubles with their tags */

/* Told apart also by who sees no red or no green: lightness differs with the colour. */
static const double colours[SCENE_CLASSES][3] = {
    {0.66, 0.70, 0.76}, /* unknown */
    {0.36, 0.55, 0.42}, /* floor */
    {0.90, 0.90, 0.86}, /* ceiling */
    {0.80, 0.70, 0.52}, /* wall */
    {0.56, 0.33, 0.20}, /* door */
    {0.45, 0.72, 0.92}, /* window */
    {0.87, 0.62, 0.16}, /* ramp */
    {0.78, 0.38, 0.50}, /* stair */
    {0.50, 0.40, 0.68}, /* table */
};

const double *scene_colour(uint8_t class)
{
	return colours[class < SCENE_CLASSES ? class : 0];
}

void scene_id(struct patch_key key, char ret[SCENE_ID_MAX])
{
	snprintf(ret, SCENE_ID_MAX, "%d,%d,%d", key.x, key.y, key.z);
}

static void put_text(struct buffer *b, const char *text)
{
	buffer_append(b, text, strlen(text));
}

/* The triangles of one class, with the vertices they use in the order of their first use. */
struct part {
	const struct patch *patch;
	double unit_m; /* of the lattice */
	uint8_t class;
	uint32_t points, triangles;
	uint32_t *place;  /* [nv] of a vertex among the points, or UINT32_MAX */
	uint32_t *vertex; /* [points] */
};

static uint8_t class_of(const struct patch_run *run)
{
	return run->class < SCENE_CLASSES ? run->class : 0;
}

static void gather_run(struct part *part, uint32_t first, uint32_t n)
{
	for (uint32_t t = first; t < first + n; t++) {
		for (int c = 0; c < 3; c++) {
			const uint32_t v = part->patch->triangle[t][c];

			if (part->place[v] != UINT32_MAX)
				continue;
			part->place[v] = part->points;
			part->vertex[part->points++] = v;
		}
	}
	part->triangles += n;
}

/* False where the patch has nothing of this class. */
static bool gather(struct part *part, uint8_t class)
{
	uint32_t first = 0;

	part->class = class;
	part->points = part->triangles = 0;
	memset(part->place, 0xff, part->patch->nv * sizeof(*part->place));
	for (uint32_t r = 0; r < part->patch->nruns; r++) {
		if (class_of(&part->patch->run[r]) == class)
			gather_run(part, first, part->patch->run[r].triangles);
		first += part->patch->run[r].triangles;
	}
	return part->triangles > 0;
}

static int64_t lattice(const struct part *part, uint32_t point, int axis)
{
	const int32_t key[3] = {part->patch->key.x, part->patch->key.y, part->patch->key.z};

	return (int64_t)key[axis] * PATCH_LATTICE + part->patch->vertex[part->vertex[point]][axis];
}

/* Of all runs in the order in which they are told: the triangles of a part. */
typedef void triangle_writer(struct buffer *, const struct part *, const uint32_t triangle[3], bool first);

static void put_triangles(struct buffer *b, const struct part *part, triangle_writer *write)
{
	uint32_t t = 0;
	bool first = true;

	for (uint32_t r = 0; r < part->patch->nruns; r++) {
		const uint32_t end = t + part->patch->run[r].triangles;

		for (; t < end; t++) {
			if (class_of(&part->patch->run[r]) != part->class)
				continue;
			write(b, part, part->patch->triangle[t], first);
			first = false;
		}
	}
}

/* JSON */

/* Decimal digits of `value`; how many. */
static size_t put_digits(char *at, uint64_t value)
{
	char digits[20];
	size_t n = 0;

	do {
		digits[n++] = (char)('0' + value % 10);
		value /= 10;
	} while (value > 0);
	for (size_t i = 0; i < n; i++)
		at[i] = digits[n - 1 - i];
	return n;
}

/* Tenths of a millimetre as metres: "-1.25", "0", "3.0001". */
static size_t put_metres(char *at, int64_t tenths_mm)
{
	uint64_t magnitude = tenths_mm < 0 ? (uint64_t)-tenths_mm : (uint64_t)tenths_mm;
	unsigned fraction = (unsigned)(magnitude % 10000);
	size_t n = 0;

	if (tenths_mm < 0)
		at[n++] = '-';
	n += put_digits(at + n, magnitude / 10000);
	if (fraction == 0)
		return n;
	at[n++] = '.';
	for (unsigned place = 1000; fraction > 0 && place > 0; place /= 10) {
		at[n++] = (char)('0' + fraction / place);
		fraction %= place;
	}
	return n;
}

static void put_json_point(struct buffer *b, const struct part *part, uint32_t point)
{
	static const char name[3][7] = {"{\"x\":", ",\"y\":", ",\"z\":"};
	char text[128];
	size_t n = 0;

	if (point > 0)
		text[n++] = ',';
	for (int axis = 0; axis < 3; axis++) {
		memcpy(text + n, name[axis], 5);
		n += 5;
		n += put_metres(text + n, (int64_t)rint((double)lattice(part, point, axis) * part->unit_m * 1e4));
	}
	text[n++] = '}';
	buffer_append(b, text, n);
}

static void put_json_triangle(struct buffer *b, const struct part *part, const uint32_t triangle[3], bool first)
{
	char text[40];
	size_t n = 0;

	for (int c = 0; c < 3; c++) {
		if (!first || c > 0)
			text[n++] = ',';
		n += put_digits(text + n, part->place[triangle[c]]);
	}
	buffer_append(b, text, n);
}

static void put_json_time(struct buffer *b, int64_t t_ns)
{
	const int64_t second_ns = 1000000000, seconds = t_ns / second_ns - (t_ns % second_ns < 0);

	buffer_printf(b, "{\"sec\":%lld,\"nsec\":%lld}", (long long)seconds, (long long)(t_ns - seconds * second_ns));
}

static void put_json_part(struct buffer *b, const struct part *part)
{
	const double *colour = scene_colour(part->class);

	put_text(b, "{\"pose\":{\"position\":{\"x\":0,\"y\":0,\"z\":0},"
	            "\"orientation\":{\"x\":0,\"y\":0,\"z\":0,\"w\":1}},\"points\":[");
	for (uint32_t p = 0; p < part->points; p++)
		put_json_point(b, part, p);
	buffer_printf(b, "],\"color\":{\"r\":%.2f,\"g\":%.2f,\"b\":%.2f,\"a\":1},\"colors\":[],\"indices\":[",
	              colour[0], colour[1], colour[2]);
	put_triangles(b, part, put_json_triangle);
	put_text(b, "]}");
}

static void put_json_entity(struct buffer *b, struct part *part)
{
	char id[SCENE_ID_MAX];
	bool first = true;

	scene_id(part->patch->key, id);
	put_text(b, "{\"timestamp\":");
	put_json_time(b, part->patch->t_last_ns);
	buffer_printf(b,
	              ",\"frame_id\":\"" SCENE_FRAME
	              "\",\"id\":\"%s\",\"lifetime\":{\"sec\":0,\"nsec\":0},\"frame_locked\":true,"
	              "\"metadata\":[{\"key\":\"version\",\"value\":\"%llu\"}],"
	              "\"arrows\":[],\"cubes\":[],\"spheres\":[],\"cylinders\":[],\"lines\":[],\"triangles\":[",
	              id, (unsigned long long)part->patch->version);
	for (uint8_t class = 0; class < SCENE_CLASSES; class ++) {
		if (!gather(part, class))
			continue;
		if (!first)
			put_text(b, ",");
		put_json_part(b, part);
		first = false;
	}
	put_text(b, "],\"texts\":[],\"models\":[]}");
}

/* Protobuf */

static void put_protobuf_point(struct buffer *b, const struct part *part, uint32_t point)
{
	uint8_t bytes[2 + POINT_BYTES] = {2 << 3 | 2, POINT_BYTES};

	for (int axis = 0; axis < 3; axis++) {
		const double value = (double)lattice(part, point, axis) * part->unit_m;

		bytes[2 + axis * 9] = (uint8_t)((axis + 1) << 3 | 1);
		memcpy(bytes + 3 + axis * 9, &value, 8);
	}
	buffer_append(b, bytes, sizeof(bytes));
}

static void put_protobuf_triangle(struct buffer *b, const struct part *part, const uint32_t triangle[3], bool first)
{
	const uint32_t place[3] = {part->place[triangle[0]], part->place[triangle[1]], part->place[triangle[2]]};

	(void)first;
	buffer_append(b, place, sizeof(place));
}

static void put_protobuf_part(struct buffer *b, const struct part *part)
{
	const double *colour = scene_colour(part->class);
	const size_t begun = protobuf_begin(b, 12);
	size_t inner = protobuf_begin(b, 1), orientation;

	protobuf_head(b, 1, 0);             /* a position: zero */
	orientation = protobuf_begin(b, 2); /* one without numbers would be no rotation */
	protobuf_double(b, 4, 1);
	protobuf_end(b, orientation);
	protobuf_end(b, inner);
	for (uint32_t p = 0; p < part->points; p++)
		put_protobuf_point(b, part, p);
	inner = protobuf_begin(b, 3);
	for (unsigned c = 0; c < 3; c++)
		protobuf_double(b, c + 1, colour[c]);
	protobuf_double(b, 4, 1);
	protobuf_end(b, inner);
	protobuf_head(b, 5, (size_t)part->triangles * 12);
	put_triangles(b, part, put_protobuf_triangle);
	protobuf_end(b, begun);
}

static void put_protobuf_entity(struct buffer *b, struct part *part)
{
	const size_t begun = protobuf_begin(b, 2);
	char text[SCENE_ID_MAX];
	size_t inner;

	protobuf_time(b, 1, part->patch->t_last_ns);
	protobuf_string(b, 2, SCENE_FRAME);
	scene_id(part->patch->key, text);
	protobuf_string(b, 3, text);
	protobuf_head(b, 4, 0); /* a lifetime: zero */
	protobuf_uint(b, 5, 1);
	inner = protobuf_begin(b, 6);
	protobuf_string(b, 1, "version");
	snprintf(text, sizeof(text), "%llu", (unsigned long long)part->patch->version);
	protobuf_string(b, 2, text);
	protobuf_end(b, inner);
	for (uint8_t class = 0; class < SCENE_CLASSES; class ++)
		if (gather(part, class))
			put_protobuf_part(b, part);
	protobuf_end(b, begun);
}

/* Both */

void scene_put_entity(struct buffer *b, enum scene_encoding encoding, const struct patch *patch, double cell_m)
{
	struct part part = {.patch = patch, .unit_m = cell_m / LATTICE};

	assert(patch->nt > 0);
	part.place = malloc(2 * (size_t)patch->nv * sizeof(*part.place));
	if (!part.place) {
		b->error = -ENOMEM;
		return;
	}
	part.vertex = part.place + patch->nv;
	if (encoding == SCENE_AS_JSON)
		put_json_entity(b, &part);
	else
		put_protobuf_entity(b, &part);
	free(part.place);
}

void scene_put_deletion(struct buffer *b, enum scene_encoding encoding, const struct scene_deletion *deletion)
{
	char id[SCENE_ID_MAX] = "";
	size_t begun;

	if (!deletion->all)
		scene_id(deletion->key, id);
	if (encoding == SCENE_AS_JSON) {
		put_text(b, "{\"timestamp\":");
		put_json_time(b, deletion->t_ns);
		buffer_printf(b, ",\"type\":%d,\"id\":\"%s\"}", deletion->all, id);
		return;
	}
	begun = protobuf_begin(b, 1);
	protobuf_time(b, 1, deletion->t_ns);
	protobuf_uint(b, 2, deletion->all);
	protobuf_string(b, 3, id);
	protobuf_end(b, begun);
}

static void put_deletions(struct buffer *b, enum scene_encoding encoding, int64_t t_ns, bool all,
                          struct patch *const *patch, size_t n)
{
	struct scene_deletion deletion = {.t_ns = t_ns, .all = all};
	bool first = true;

	if (all)
		scene_put_deletion(b, encoding, &deletion);
	for (size_t i = 0; i < n && !all; i++) {
		if (patch[i]->nt > 0)
			continue;
		if (!first && encoding == SCENE_AS_JSON)
			put_text(b, ",");
		deletion.key = patch[i]->key;
		scene_put_deletion(b, encoding, &deletion);
		first = false;
	}
}

void scene_put_update(struct buffer *b, enum scene_encoding encoding, int64_t t_ns, bool all,
                      struct patch *const *patch, size_t n, double cell_m)
{
	const bool json = encoding == SCENE_AS_JSON;
	bool first = true;

	if (json)
		put_text(b, SCENE_JSON_BEGIN);
	put_deletions(b, encoding, t_ns, all, patch, n);
	if (json)
		put_text(b, SCENE_JSON_MIDDLE);
	for (size_t i = 0; i < n; i++) {
		if (patch[i]->nt == 0)
			continue;
		if (!first && json)
			put_text(b, ",");
		scene_put_entity(b, encoding, patch[i], cell_m);
		first = false;
	}
	if (json)
		put_text(b, SCENE_JSON_END);
}
