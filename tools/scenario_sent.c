/* The device counts the telegrams that have left it: asked after every piece of bytes, it tells which piece was the last
 * of one. A LMS2xx measures nothing while its line is busy, so that telegram is the one it measured last. */
#include "tools/scenario_sent.h"

#include <errno.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

struct scenario_sent {
	FILE *file;
	struct scene scene; /* the real one */
	const struct sim_device *device;
	int64_t measured_ns;
	uint64_t left;
};

static void scan(void *ctx, struct profile *profile)
{
	struct scenario_sent *sent = ctx;

	sent->scene.scan(sent->scene.ctx, profile);
	sent->measured_ns = profile->t_ns;
}

static bool ready(void *ctx, int64_t t_ns)
{
	const struct scenario_sent *sent = ctx;

	return sent->scene.ready(sent->scene.ctx, t_ns);
}

static void taken(void *ctx, int64_t t_ns)
{
	const struct scenario_sent *sent = ctx;

	sent->scene.taken(sent->scene.ctx, t_ns);
}

static void lost(void *ctx, int64_t t_ns)
{
	const struct scenario_sent *sent = ctx;

	sent->scene.lost(sent->scene.ctx, t_ns);
}

struct scenario_sent *scenario_sent_create(const char *path, struct scene *scene, char error[SCENARIO_ERROR_MAX])
{
	struct scenario_sent *sent = calloc(1, sizeof *sent);

	if (sent)
		sent->file = fopen(path, "we");
	if (!sent || !sent->file) {
		snprintf(error, SCENARIO_ERROR_MAX, "--sent %.200s: %s", path, strerror(sent ? errno : ENOMEM));
		free(sent);
		return NULL;
	}
	setvbuf(sent->file, NULL, _IOLBF, 0); /* its reader does not wait for our end */
	sent->scene = *scene;
	*scene = (struct scene){.ctx = sent,
	                        .scan = scan,
	                        .ready = sent->scene.ready ? ready : NULL,
	                        .taken = sent->scene.taken ? taken : NULL,
	                        .lost = sent->scene.lost ? lost : NULL};
	return sent;
}

struct scenario_sent *scenario_sent_of(struct scenario_sent *sent, const struct sim_device *device)
{
	sent->device = device;
	return sent;
}

void scenario_sent_note(void *ctx, int64_t t_ns)
{
	struct scenario_sent *sent = ctx;
	struct sim_counts counts;

	sent->device->counts(sent->device->ctx, &counts);
	if (counts.sent + counts.corrupted == sent->left)
		return;
	sent->left = counts.sent + counts.corrupted;
	fprintf(sent->file, "%lld %lld\n", (long long)t_ns, (long long)sent->measured_ns);
}

void scenario_sent_destroy(struct scenario_sent *sent)
{
	if (!sent)
		return;
	fclose(sent->file);
	free(sent);
}
