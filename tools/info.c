/* `facet info`: what is in a file. Of a recording: how long, of which devices, channels with counts and rates, the maps in it, and
 * what of it cannot be read. Of a mesh, scan or cloud: how much, and how large. Nothing is replayed; a recording is read once
 * from end to end, so that what is said of damage is true. */
#include <argp.h>
#include <errno.h>
#include <inttypes.h>
#include <jansson.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <strings.h>
#include <time.h>

#include "core/model.h"
#include "daemon/recording.h"
#include "tools/commands.h"
#include "tools/mapped.h"
#include "tools/mesh_read.h"

#define DAMAGES_SHOWN 20
#define MAPS_SHOWN    100

struct job {
	const char *input;
	bool json;
};

enum { OPTION_JSON = 256 };

static const struct argp_option options[] = {{"json", OPTION_JSON, NULL, 0, "one JSON object", 0}, {0}};

static error_t parse_option(int key, char *arg, struct argp_state *state)
{
	struct job *job = state->input;

	switch (key) {
	case OPTION_JSON:
		job->json = true;
		return 0;
	case ARGP_KEY_ARG:
		if (job->input)
			argp_error(state, "one file at a time; '%s' is the second", arg);
		job->input = arg;
		return 0;
	case ARGP_KEY_END:
		if (!job->input)
			argp_error(state, "FILE is needed");
		return 0;
	default:
		return ARGP_ERR_UNKNOWN;
	}
}

static json_t *integer(uint64_t value)
{
	return json_integer((json_int_t)value);
}

static json_t *text_json(struct mcap_text text)
{
	json_t *json = json_stringn(text.at, text.len);

	return json ? json : json_string("(not UTF-8)");
}

/* Recordings */

struct span { /* of a channel */
	uint64_t first_ns, last_ns, bytes;
};

struct walk {
	struct span *span; /* by channel id */
	uint64_t messages, first_ns, last_ns;
	uint64_t chunks, attachments, metadata, damaged_bytes;
	json_t *damage, *facetd, *attached;
	bool statistics_agree, has_statistics;
};

static void note_message(struct walk *w, const struct mcap_item *item)
{
	struct span *span = &w->span[item->message.channel->id];
	const uint64_t t_ns = item->message.log_ns;

	span->first_ns = span->bytes + span->last_ns == 0 ? t_ns : span->first_ns;
	span->last_ns = t_ns;
	span->bytes += item->message.len;
	w->first_ns = w->messages == 0 || t_ns < w->first_ns ? t_ns : w->first_ns;
	w->last_ns = t_ns > w->last_ns ? t_ns : w->last_ns;
	w->messages++;
}

static void note_damage(struct walk *w, const struct mcap_item *item)
{
	w->damaged_bytes += item->end - item->offset;
	if (json_array_size(w->damage) < DAMAGES_SHOWN)
		json_array_append_new(w->damage, json_pack("{s:I, s:I, s:s}", "from", (json_int_t)item->offset, "to",
		                                           (json_int_t)item->end, "what", item->damage));
}

static void note_metadata(struct walk *w, const struct mcap_item *item)
{
	w->metadata++;
	for (size_t i = 0; i < item->metadata.map.n && mcap_text_is(item->metadata.name, "facetd"); i++) {
		char key[64];

		snprintf(key, sizeof(key), "%.*s", (int)(item->metadata.map.pair[i].key.len % sizeof(key)),
		         item->metadata.map.pair[i].key.at);
		json_object_set_new(w->facetd, key, text_json(item->metadata.map.pair[i].value));
	}
}

static void note_item(struct walk *w, const struct mcap_item *item)
{
	switch (item->kind) {
	case MCAP_MESSAGE:
		note_message(w, item);
		break;
	case MCAP_CHUNK:
		w->chunks++;
		break;
	case MCAP_ATTACHMENT:
		w->attachments++;
		json_array_append_new(w->attached, json_pack("{s:o, s:I}", "name", text_json(item->attachment.name),
		                                             "bytes", (json_int_t)item->attachment.len));
		break;
	case MCAP_METADATA:
		note_metadata(w, item);
		break;
	case MCAP_STATISTICS:
		w->has_statistics = true;
		w->statistics_agree = item->statistics.messages == w->messages &&
		                      item->statistics.chunks == w->chunks &&
		                      item->statistics.start_ns == w->first_ns && item->statistics.end_ns == w->last_ns;
		break;
	case MCAP_DAMAGED:
		note_damage(w, item);
		break;
	default:
		break;
	}
}

static json_t *channels_json(const struct mcap_reader *reader, const struct walk *w)
{
	json_t *list = json_array();

	for (struct mcap_channel *c = mcap_reader_channel(reader, 0); c; c = mcap_reader_channel(reader, c->id + 1u)) {
		const struct span *span = &w->span[c->id];
		const double seconds = (double)(span->last_ns - span->first_ns) / 1e9;

		json_array_append_new(list, json_pack("{s:o, s:o, s:o, s:I, s:I, s:f}", "topic", text_json(c->topic),
		                                      "encoding", text_json(c->encoding), "schema",
		                                      c->schema ? text_json(c->schema->name) : json_null(), "messages",
		                                      (json_int_t)c->messages, "bytes", (json_int_t)span->bytes, "rate",
		                                      seconds > 0 ? (double)(c->messages - 1) / seconds : 0));
	}
	return list;
}

/* What the events of a recording say: the maps in it, rows not applied, devices, and whether it was ended in order. */
struct told {
	json_t *maps, *devices;
	uint64_t skips, records, ticks;
	bool ended;
};

static void note_begin(struct told *told, const struct recording_begin *begin)
{
	char map[33];

	for (int i = 0; i < 16; i++)
		snprintf(map + 2 * i, 3, "%02x", begin->map_id[i]);
	if (json_array_size(told->maps) < MAPS_SHOWN)
		json_array_append_new(told->maps,
		                      json_pack("{s:s, s:I, s:b, s:f, s:I}", "map", map, "generation",
		                                (json_int_t)begin->generation, "whole", begin->whole, "begins",
		                                (double)begin->log_ns / 1e9, "snapshot", (json_int_t)begin->len));
}

static void note_record(struct told *told, const struct recording_event *event)
{
	json_t *device = json_object_get(told->devices, event->device);

	if (!device && json_object_size(told->devices) < CONFIG_DEVICES_MAX) {
		device = json_pack("{s:i, s:i, s:i}", "received", 0, "written", 0, "opened", 0);
		json_object_set_new(told->devices, event->device, device);
	}
	static const char *const what[] = {"received", "written", "opened"};
	json_t *count = json_object_get(device, what[event->record.direction]);

	json_integer_set(count, json_integer_value(count) + 1);
	told->records++;
}

static int hear(const struct mapped *file, struct told *told)
{
	struct recording_reader *reader;
	struct recording_event event;
	char error[160];
	int r = recording_reader_create(file->data, file->len, &reader, error);

	if (r < 0)
		return r == -EINVAL ? 0 : r; /* an MCAP file of others */
	while ((r = recording_reader_next(reader, &event)) == 1) {
		told->skips += event.kind == RECORDING_SKIP;
		told->ticks += event.kind == RECORDING_TICK;
		told->ended |= event.kind == RECORDING_END;
		if (event.kind == RECORDING_BEGIN)
			note_begin(told, &event.begin);
		if (event.kind == RECORDING_RECORD)
			note_record(told, &event);
	}
	recording_reader_destroy(reader);
	return r;
}

static const char *utc(uint64_t t_ns, char ret[40])
{
	const time_t seconds = (time_t)(t_ns / 1000000000);
	struct tm tm;

	strftime(ret, 40, "%Y-%m-%d %H:%M:%S UTC", gmtime_r(&seconds, &tm));
	return ret;
}

static json_t *recording_json(const struct mapped *file, struct mcap_reader *reader, const struct walk *w,
                              const struct told *told)
{
	json_t *json = json_object();

	json_object_set_new(json, "kind",
	                    json_string(json_object_size(w->facetd) || told->ticks ? "recording" : "mcap"));
	json_object_set_new(json, "bytes", integer(file->len));
	json_object_set_new(json, "begin_ns", integer(w->first_ns));
	json_object_set_new(json, "end_ns", integer(w->last_ns));
	json_object_set_new(json, "seconds", json_real((double)(w->last_ns - w->first_ns) / 1e9));
	json_object_set_new(json, "messages", integer(w->messages));
	json_object_set_new(json, "chunks", integer(w->chunks));
	json_object_set_new(json, "attachments", w->attached);
	json_object_set_new(json, "metadata", integer(w->metadata));
	json_object_set_new(json, "facetd", w->facetd);
	json_object_set_new(json, "maps", told->maps);
	json_object_set_new(json, "devices", told->devices);
	json_object_set_new(json, "records", integer(told->records));
	json_object_set_new(json, "ticks", integer(told->ticks));
	json_object_set_new(json, "not_applied", integer(told->skips));
	json_object_set_new(json, "ended", json_boolean(told->ended));
	json_object_set_new(json, "whole", json_boolean(mcap_reader_whole(reader) && json_array_size(w->damage) == 0));
	json_object_set_new(json, "statistics_agree",
	                    w->has_statistics ? json_boolean(w->statistics_agree) : json_null());
	json_object_set_new(json, "damaged_bytes", integer(w->damaged_bytes));
	json_object_set_new(json, "damage", w->damage);
	json_object_set_new(json, "channels", channels_json(reader, w));
	return json;
}

static const char *string(json_t *json, const char *key)
{
	const char *text = json_string_value(json_object_get(json, key));

	return text ? text : "";
}

static json_int_t number(json_t *json, const char *key)
{
	return json_integer_value(json_object_get(json, key));
}

static void print_recording(const char *path, json_t *json)
{
	char when[40];
	size_t i;
	json_t *item;
	const char *name;

	printf("%s: %s, %s, %.2f s, %" JSON_INTEGER_FORMAT " bytes, %" JSON_INTEGER_FORMAT
	       " messages in %" JSON_INTEGER_FORMAT " chunks\n",
	       path, strcmp(string(json, "kind"), "mcap") ? "a recording of facetd" : "an MCAP file",
	       utc((uint64_t)number(json, "begin_ns"), when), json_real_value(json_object_get(json, "seconds")),
	       number(json, "bytes"), number(json, "messages"), number(json, "chunks"));
	json_array_foreach(json_object_get(json, "maps"), i, item) printf(
	    "  map %s, generation %" JSON_INTEGER_FORMAT ", %s\n", string(item, "map"), number(item, "generation"),
	    json_is_true(json_object_get(item, "whole")) ? "from its beginning" : "from its middle on");
	json_object_foreach(json_object_get(json, "devices"), name, item)
	    printf("  device %s: %" JSON_INTEGER_FORMAT " records, %" JSON_INTEGER_FORMAT
	           " written, opened %" JSON_INTEGER_FORMAT " times\n",
	           name, number(item, "received"), number(item, "written"), number(item, "opened"));
	json_array_foreach(json_object_get(json, "channels"), i, item)
	    printf("  %-24s %-18s %8" JSON_INTEGER_FORMAT " messages %10" JSON_INTEGER_FORMAT " bytes %8.2f Hz\n",
	           string(item, "topic"), string(item, "encoding"), number(item, "messages"), number(item, "bytes"),
	           json_real_value(json_object_get(item, "rate")));
	if (number(json, "not_applied") > 0)
		printf("  %" JSON_INTEGER_FORMAT " rows were not applied\n", number(json, "not_applied"));
	json_array_foreach(json_object_get(json, "damage"), i, item)
	    printf("  DAMAGED from byte %" JSON_INTEGER_FORMAT " to %" JSON_INTEGER_FORMAT ": %s\n",
	           number(item, "from"), number(item, "to"), string(item, "what"));
	if (!json_is_true(json_object_get(json, "whole")))
		printf("  it was not ended in order, or is damaged: what is listed can be replayed; `facet repair %s "
		       "-o OUT.mcap` "
		       "writes a clean file\n",
		       path);
}

static int show(const struct job *job, json_t *json, void (*print)(const char *, json_t *))
{
	char *text = json ? json_dumps(json, JSON_COMPACT | JSON_REAL_PRECISION(15)) : NULL;

	if (text && job->json)
		puts(text);
	else if (text)
		print(job->input, json);
	else
		fprintf(stderr, "facet: %s: out of memory\n", job->input);
	free(text);
	json_decref(json);
	return text ? 0 : 1;
}

static int recording_info(const struct job *job, const struct mapped *file)
{
	struct walk w = {.span = calloc(UINT16_MAX + 1, sizeof(*w.span)),
	                 .damage = json_array(),
	                 .facetd = json_object(),
	                 .attached = json_array()};
	struct told told = {.maps = json_array(), .devices = json_object()};
	struct mcap_reader *reader = NULL;
	struct mcap_item item;
	char error[160] = "out of memory";
	int r = w.span ? mcap_reader_create(file->data, file->len, &reader, error) : -ENOMEM;

	while (r >= 0 && (r = mcap_reader_next(reader, &item)) == 1)
		note_item(&w, &item);
	if (r == 0)
		r = hear(file, &told);
	if (r == 0)
		r = show(job, recording_json(file, reader, &w, &told), print_recording);
	else
		fprintf(stderr, "facet: %s: %s\n", job->input, error);
	mcap_reader_destroy(reader);
	free(w.span);
	return r != 0;
}

/* Meshes, scans, clouds */

struct extent {
	double min[3], max[3];
	uint64_t n;
};

static void extend(struct extent *e, double x, double y, double z)
{
	const double at[3] = {x, y, z};

	for (int i = 0; i < 3; i++) {
		e->min[i] = e->n == 0 || at[i] < e->min[i] ? at[i] : e->min[i];
		e->max[i] = e->n == 0 || at[i] > e->max[i] ? at[i] : e->max[i];
	}
	e->n++;
}

static json_t *extent_json(const struct extent *e)
{
	return json_pack("{s:[f,f,f], s:[f,f,f]}", "min", e->min[0], e->min[1], e->min[2], "max", e->max[0], e->max[1],
	                 e->max[2]);
}

static json_t *cloud_json(struct cloud *cloud)
{
	struct extent extent = {.n = 0};

	for (size_t i = 0; i < cloud->n; i++)
		extend(&extent, cloud->point[i].x, cloud->point[i].y, cloud->point[i].z);
	cloud_finish(cloud);
	return json_pack("{s:s, s:I, s:o}", "kind", "cloud", "points", (json_int_t)extent.n, "extent",
	                 extent_json(&extent));
}

static json_t *mesh_json(struct mesh *mesh)
{
	static const char *const name[] = {"unknown", "floor", "ceiling", "wall", "door",
	                                   "window",  "ramp",  "stair",   "table"};
	uint64_t count[9] = {0};
	struct extent extent = {.n = 0};
	json_t *classes = json_object();

	for (uint32_t i = 0; i < mesh->nv; i++)
		extend(&extent, mesh->vertex[i][0], mesh->vertex[i][1], mesh->vertex[i][2]);
	for (uint32_t i = 0; i < mesh->nt; i++)
		count[mesh->class[i] < 9 ? mesh->class[i] : 0]++;
	for (int i = 0; i < 9; i++)
		if (count[i] > 0)
			json_object_set_new(classes, name[i], integer(count[i]));
	json_t *json = json_pack("{s:s, s:I, s:I, s:o, s:o}", "kind", "mesh", "vertices", (json_int_t)mesh->nv, "faces",
	                         (json_int_t)mesh->nt, "classes", classes, "extent", extent_json(&extent));
	mesh_finish(mesh);
	return json;
}

static json_t *scan_json(struct uos_scan *scan)
{
	uint64_t beams = 0, hits = 0;

	if (scan->rows == 0) {
		struct cloud cloud = scan->cloud;

		scan->cloud = (struct cloud){0};
		uos_finish(scan);
		return cloud_json(&cloud);
	}
	for (uint32_t i = 0; i < scan->rows; i++)
		for (uint32_t k = 0; k < scan->row[i].n; k++, beams++)
			hits += scan->row[i].state[k] == BEAM_OK;
	json_t *json = json_pack("{s:s, s:I, s:I, s:I, s:f, s:f}", "kind", "scan", "rows", (json_int_t)scan->rows,
	                         "beams", (json_int_t)beams, "in_range", (json_int_t)hits, "tilt_first",
	                         scan->row[0].tilt_rad, "tilt_last", scan->row[scan->rows - 1].tilt_rad);
	uos_finish(scan);
	return json;
}

static void print_simple(const char *path, json_t *json)
{
	const char *key;
	json_t *value;

	printf("%s: a %s\n", path, string(json, "kind"));
	json_object_foreach(json, key, value)
	{
		char *text = strcmp(key, "kind")
		                 ? json_dumps(value, JSON_COMPACT | JSON_ENCODE_ANY | JSON_REAL_PRECISION(6))
		                 : NULL;

		if (text)
			printf("  %-10s %s\n", key, text);
		free(text);
	}
}

static bool has_ending(const char *path, const char *ending)
{
	const size_t len = strlen(path), n = strlen(ending);

	return len > n && strcasecmp(path + len - n, ending) == 0;
}

/* NULL with a sentence. */
static json_t *other_json(const struct job *job, const struct mapped *file, struct parse_error *error)
{
	struct uos_scan scan;
	struct cloud cloud;
	struct mesh mesh;
	int r;

	if (has_ending(job->input, ".3d"))
		return uos_read(file->data, file->len, &scan, error) == 0 ? scan_json(&scan) : NULL;
	if (has_ending(job->input, ".ply") && mesh_read_ply(file->data, file->len, &mesh, error) == 0) {
		if (mesh.nt > 0)
			return mesh_json(&mesh);
		mesh_finish(&mesh);
	}
	if (has_ending(job->input, ".ply"))
		r = ply_read_cloud(file->data, file->len, &cloud, error);
	else if (has_ending(job->input, ".pcd"))
		r = pcd_read(file->data, file->len, &cloud, error);
	else if (has_ending(job->input, ".xyz") || has_ending(job->input, ".pts") || has_ending(job->input, ".csv"))
		r = xyz_read(file->data, file->len, &cloud, error);
	else
		r = -ENOTSUP;
	if (r == -ENOTSUP)
		snprintf(error->text, sizeof(error->text),
		         "is no recording, and its ending is none of .ply .3d .pcd .xyz .pts .csv");
	return r == 0 ? cloud_json(&cloud) : NULL;
}

static int info(const struct job *job)
{
	struct parse_error why = {0, "out of memory"};
	struct mapped file;
	char error[400];
	json_t *json;
	int status;

	if (mapped_open(job->input, &file, error) < 0) {
		fprintf(stderr, "facet: %s\n", error);
		return 1;
	}
	if (has_ending(job->input, ".mcap") || (file.len > 5 && memcmp(file.data, "\x89MCAP", 5) == 0)) {
		status = recording_info(job, &file);
	} else {
		json = other_json(job, &file, &why);
		status = json ? show(job, json, print_simple) : 1;
		if (!json)
			fprintf(stderr, "facet: %s: %s\n", job->input, why.text);
	}
	mapped_close(&file);
	return status;
}

int info_main(int argc, char **argv)
{
	static const struct argp argp = {options,
	                                 parse_option,
	                                 "FILE",
	                                 "What is in a recording, scan, cloud or mesh.\v"
	                                 "Of a cut or damaged recording it says what is whole.",
	                                 NULL,
	                                 NULL,
	                                 NULL};
	struct job job = {0};

	argp_parse(&argp, argc, argv, 0, NULL, &job);
	return info(&job);
}
