/* Feeds a kept journal into the pipeline without sockets (law L7).
 *
 *   steps CONFIG JOURNAL OUT.ply           the map at the end, meshed every seven steps on the way; prints its hash and counts
 *   steps CONFIG JOURNAL DIR STEP...       writes DIR/STEP.raw.ply, the mesh before the reduction, at each of the steps
 *                                          (ascending) */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "core/map.h"
#include "core/model.h"
#include "daemon/journal.h"

struct steps {
	struct config config;
	struct map *map;
	struct mesher *mesher;
	struct patch_store *store;
	const char *dir;
	char **wanted; /* ends with NULL */
	bool idle;     /* the look-ahead was folded after a second without a row, and no row came since */
	int pauses;    /* such seconds between rows */
};

static void mesh(struct steps *s)
{
	const struct patch_key *dirty;
	size_t n = map_take_dirty(s->map, &dirty);
	for (size_t i = 0; i < n; i++)
		patch_store_put(s->store, map_mesh_patch(s->map, s->mesher, dirty[i], NULL));
}

static void write_mesh(struct steps *s, const char *path)
{
	struct model model;
	struct buffer b = {0};
	mesh(s);
	model_weld(s->store, s->config.map.cell_m, &model);
	ply_write(&model, false, &b);
	FILE *f = fopen(path, "wb");
	if (!f || fwrite(b.data, 1, b.len, f) != b.len || fclose(f) != 0) {
		fprintf(stderr, "steps: cannot write %s\n", path);
		exit(1);
	}
	buffer_finish(&b);
	model_finish(&model);
}

static void write_step(struct steps *s, uint64_t step)
{
	char path[512];
	snprintf(path, sizeof path, "%s/%llu.raw.ply", s->dir, (unsigned long long)step);
	write_mesh(s, path);
}

static void stepped(struct steps *s)
{
	uint64_t step = map_step(s->map);
	while (s->wanted && *s->wanted && strtoull(*s->wanted, NULL, 10) < step)
		s->wanted++;
	if (s->wanted && *s->wanted && strtoull(*s->wanted, NULL, 10) == step)
		write_step(s, step);
	else if (!s->wanted && step % 7 == 0)
		mesh(s);
}

static bool take_row(void *ctx, struct row *row)
{
	struct steps *s = ctx;
	s->pauses += s->idle;
	s->idle = false;
	map_row(s->map, row);
	stepped(s);
	return true;
}

static void flush(void *ctx)
{
	struct steps *s = ctx;
	s->idle = true;
	map_flush(s->map);
	stepped(s);
}

static void read_config(const char *path, struct config *ret)
{
	static char text[1 << 20];
	struct config_error error;
	FILE *f = fopen(path, "r");
	size_t len = f ? fread(text, 1, sizeof text, f) : 0;
	if (f)
		fclose(f);
	if (config_read(text, len, path, ret, &error) < 0) {
		fprintf(stderr, "steps: %s\n", error.text);
		exit(1);
	}
}

int main(int argc, char **argv)
{
	static struct steps s;
	char error[160], hash[65];
	if (argc < 4)
		return 2;
	read_config(argv[1], &s.config);
	if (argc > 4) {
		s.dir = argv[3];
		s.wanted = argv + 4;
	}
	struct map_params params = {.cell_m = s.config.map.cell_m,
	                            .tolerance = s.config.map.tolerance,
	                            .reduce = argc == 4 && s.config.map.reduce,
	                            .lookahead = s.config.map.lookahead,
	                            .memory = s.config.map.memory};
	s.map = map_create(&params);
	s.mesher = mesher_create();
	s.store = patch_store_create();
	struct pipeline *p =
	    pipeline_create(&s.config, &(struct pipeline_sink){.ctx = &s, .row = take_row, .flush = flush});
	if (journal_feed(argv[2], p, error) < 0) {
		fprintf(stderr, "steps: %s\n", error);
		return 1;
	}
	if (argc == 4)
		write_mesh(&s, argv[3]);
	patch_store_hash(s.store, hash);
	struct pipeline_stats stats;
	pipeline_stats(p, &stats);
	printf("%s %llu profiles %llu steps %d pauses\n", hash, (unsigned long long)stats.sweep.profiles,
	       (unsigned long long)map_step(s.map), s.pauses);
	pipeline_destroy(p);
	return 0;
}
