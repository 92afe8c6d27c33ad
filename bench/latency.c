/* From the last byte of a profile to the COMMIT that brings its row, decoded in a client (design's definition of latency).
 *
 *   facet simulate hall --servo can --endless --sent FILE -- sh -c "build/facetd & build/bench/latency FILE [SECONDS]"
 *
 *   simulator   SENT      when the write of a profile's last byte began     } FILE, CLOCK_MONOTONIC
 *               MEASURED  the time of its first beam                        }
 *   libfacet    COMMIT    facet_wait has answered: the same clock
 *
 * A COMMIT names its step, the number of rows applied, and its patches the time of the newest of them. That time tells
 * which profile the row is: two are a turn of the mirror (13.3 ms) apart, and the daemon's idea of a profile's time is off by
 * much less (printed). So a figure's own error is that of two readings of one clock, and what the client needs to be woken:
 * microseconds on a machine with a core to spare, and part of what is measured where there is none.
 *
 * Rows wait for `map.lookahead` later ones by design. Beyond the look-ahead, a row's latency begins with the last byte of
 * the profile that released it: so many later, or the newest there was, at the end of a sweep. */
#include <inttypes.h>
#include <jansson.h>
#include <math.h>
#include <stdbool.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#include "tools/facet.h"

#define SETTLE_NS   INT64_C(5000000000) /* devices start, and a map's beginning is another thing than a map that grows */
#define ASKED_NS    INT64_C(500000000)  /* after a question, what was not read meanwhile */
#define LOOKAHEAD   2
#define TURN_NS     (INT64_C(40000000) / 3)
#define PROFILES    (1 << 20)
#define COMMITS     (1 << 20)
#define ROWS        (1 << 20)
#define BINS        12
#define FIRST_BIN_S 0.0005 /* every further one begins at twice that */

struct profile_sent {
	int64_t sent_ns, measured_ns;
};

struct commit {
	int64_t t_ns, newest_ns; /* newest_ns: of its patches; 0: it has none */
	uint64_t step;
	size_t patches; /* changed and removed */
	bool reset;
};

struct figures {
	double *whole_s, *beyond_s; /* [n] of rows */
	double *off_s;              /* [n] by so much the daemon's time of the batch's newest row is off, either way */
	size_t n;
	double *dirty;          /* [batches - joined] patches of a batch of one row */
	size_t batches, joined; /* joined: batches of several rows */
	size_t unknown, early;  /* rows: of no profile; released by the end of a sweep */
	size_t unsteady;        /* batches that are not as many rows as profiles after the one before */
};

static int64_t clock_ns(clockid_t id)
{
	struct timespec t;

	clock_gettime(id, &t);
	return (int64_t)t.tv_sec * 1000000000 + t.tv_nsec;
}

static _Noreturn void give_up(const char *what, const char *why)
{
	fprintf(stderr, "latency: %s: %s\n", what, why);
	exit(1);
}

static void *room(size_t n, size_t size)
{
	void *p = calloc(n, size);

	if (!p)
		give_up("memory", "there is none");
	return p;
}

/* The client */

static struct facet *open_facet(void)
{
	char error[FACET_ERROR_MAX];
	struct facet *facet = NULL;

	for (int i = 0; !facet && i < 600; i++) {
		const struct timespec wait = {.tv_nsec = 100000000};

		facet = facet_open(NULL, 1000, error);
		if (!facet)
			nanosleep(&wait, NULL);
	}
	if (!facet)
		give_up("the daemon", error);
	return facet;
}

static void note_commit(const struct facet *facet, const struct facet_event *event, struct commit *ret)
{
	*ret = (struct commit){.t_ns = clock_ns(CLOCK_MONOTONIC),
	                       .step = event->step,
	                       .patches = event->changed + event->removed,
	                       .reset = event->reset};
	for (size_t i = 0; i < event->changed; i++) {
		struct facet_patch_info info;

		facet_patch_info(facet_changed(facet, i), &info);
		if (info.t_last_ns > ret->newest_ns)
			ret->newest_ns = info.t_last_ns;
	}
}

static size_t follow(struct facet *facet, int64_t until_ns, struct commit *commit)
{
	size_t n = 0;

	while (clock_ns(CLOCK_MONOTONIC) < until_ns && n < COMMITS) {
		struct facet_event event;
		int r = facet_wait(facet, 200, &event);

		if (r < 0)
			give_up("the daemon", facet_error(facet));
		if (r > 0 && event.kind == FACET_COMMIT)
			note_commit(facet, &event, &commit[n++]);
	}
	return n;
}

static int64_t rows_not_applied(void)
{
	struct facet *facet = open_facet();
	struct facet_event event;
	json_int_t rows = -1;

	facet_say(facet, "?STATUS");
	while (rows < 0 && facet_wait(facet, 60000, &event) > 0 && event.kind == FACET_JSON) {
		json_t *json = json_loadb(event.text, event.len, 0, NULL), *value;

		value = json_object_get(json_object_get(json, "rows"), "not_applied");
		rows = value ? json_integer_value(value) : -1;
		json_decref(json);
	}
	facet_close(facet);
	if (rows < 0)
		give_up("the daemon", "gives no STATUS");
	return rows;
}

/* What the simulator wrote */

static size_t read_sent(const char *path, struct profile_sent *ret)
{
	FILE *file = fopen(path, "re");
	char line[128];
	size_t n = 0;

	if (!file)
		give_up(path, "cannot be read; it is what `facet simulate --sent` writes");
	while (n < PROFILES && fgets(line, sizeof(line), file))
		if (sscanf(line, "%" SCNd64 " %" SCNd64, &ret[n].sent_ns, &ret[n].measured_ns) == 2)
			n++;
	fclose(file);
	return n;
}

/* The profile measured nearest to a time; `n` where there is none within half a turn. */
static size_t profile_at(const struct profile_sent *profile, size_t n, int64_t t_ns)
{
	size_t low = 0, high = n;

	while (low < high) {
		size_t middle = low + (high - low) / 2;

		if (profile[middle].measured_ns < t_ns - TURN_NS / 2)
			low = middle + 1;
		else
			high = middle;
	}
	return low < n && profile[low].measured_ns <= t_ns + TURN_NS / 2 ? low : n;
}

/* Judging */

static void note_row(struct figures *f, const struct profile_sent *profile, size_t profiles, size_t at, int64_t t_ns)
{
	size_t released = at + LOOKAHEAD;

	while (released > at && (released >= profiles || profile[released].sent_ns > t_ns))
		released--;
	f->early += released < at + LOOKAHEAD;
	if (f->n == ROWS - 1)
		give_up("memory", "more rows than there is room for");
	f->whole_s[f->n] = (double)(t_ns - profile[at].sent_ns) * 1e-9;
	f->beyond_s[f->n++] = (double)(t_ns - profile[released].sent_ns) * 1e-9;
}

/* `c` brings the rows since `before`; `last`: the profile of the newest row before. */
static void note_batch(struct figures *f, const struct profile_sent *profile, size_t profiles, const struct commit *c,
                       uint64_t before, int64_t realtime_ns, size_t *last)
{
	const size_t rows = (size_t)(c->step - before);
	const size_t at = c->newest_ns ? profile_at(profile, profiles, c->newest_ns - realtime_ns) : profiles;

	if (rows == 0)
		return;
	f->joined += rows > 1;
	f->batches++;
	if (rows == 1)
		f->dirty[f->batches - f->joined - 1] = (double)c->patches;
	if (at == profiles || at + 1 < rows) {
		f->unknown += rows;
		*last = profiles;
		return;
	}
	f->unsteady += *last != profiles && at - *last != rows;
	*last = at;
	for (size_t i = rows; i-- > 0;) {
		f->off_s[f->n] = 1e-9 * fabs((double)(c->newest_ns - realtime_ns - profile[at].measured_ns));
		note_row(f, profile, profiles, at - i, c->t_ns);
	}
}

static int compare(const void *a, const void *b)
{
	double x = *(const double *)a, y = *(const double *)b;

	return x < y ? -1 : x > y;
}

static double share(const double *sorted, size_t n, double part)
{
	size_t at = (size_t)(part * (double)n);

	return sorted[at < n ? at : n - 1];
}

static void print_latency(const char *name, double *value_s, size_t n)
{
	qsort(value_s, n, sizeof(*value_s), compare);
	printf("    %-21s p50 %.2f ms, p90 %.2f, p99 %.2f, max %.2f\n", name, 1e3 * share(value_s, n, 0.5),
	       1e3 * share(value_s, n, 0.9), 1e3 * share(value_s, n, 0.99), 1e3 * value_s[n - 1]);
}

static void count_bins(const double *value_s, size_t n, size_t ret[BINS])
{
	memset(ret, 0, BINS * sizeof(*ret));
	for (size_t i = 0; i < n; i++) {
		double end_s = FIRST_BIN_S;
		int bin = 0;

		for (; bin < BINS - 1 && value_s[i] >= end_s; bin++)
			end_s *= 2;
		ret[bin]++;
	}
}

static void print_histogram(const struct figures *f)
{
	size_t whole[BINS], beyond[BINS];
	double end_ms = 1e3 * FIRST_BIN_S;

	count_bins(f->whole_s, f->n, whole);
	count_bins(f->beyond_s, f->n, beyond);
	printf("    %10s %9s %9s\n", "ms", "whole", "beyond");
	for (int i = 0; i < BINS; i++, end_ms *= 2) {
		char text[16], bar[52] = "";

		snprintf(text, sizeof(text), i < BINS - 1 ? "< %g" : ">= %g", i < BINS - 1 ? end_ms : end_ms / 2);
		memset(bar, '#', (beyond[i] * 50 + f->n - 1) / f->n);
		printf("    %10s %9zu %9zu  %s\n", text, whole[i], beyond[i], bar);
	}
}

static void print_rows(struct figures *f, int64_t dropped)
{
	const size_t n = f->batches - f->joined;

	qsort(f->dirty, n, sizeof(*f->dirty), compare);
	if (n > 0)
		printf("    dirty patches a row:  median %.0f, p10 %.0f, p90 %.0f\n", share(f->dirty, n, 0.5),
		       share(f->dirty, n, 0.1), share(f->dirty, n, 0.9));
	printf("    batches: %zu, of several rows %zu; rows dropped: %" PRId64
	       "; released by the end of a sweep: %zu\n",
	       f->batches, f->joined, dropped, f->early);
	qsort(f->off_s, f->n, sizeof(*f->off_s), compare);
	printf("    how rows were found:  times off by p50 %.2f ms, p99 %.2f; no profile near: %zu, others' next to "
	       "it: %zu\n",
	       1e3 * share(f->off_s, f->n, 0.5), 1e3 * share(f->off_s, f->n, 0.99), f->unknown, f->unsteady);
}

static void print(struct figures *f, double seconds, int64_t dropped)
{
	printf("latency, last byte of a profile to its COMMIT decoded, %.0f s: n %zu rows (goal beyond the look-ahead: "
	       "p50 5 ms, p99 20)\n",
	       seconds, f->n);
	print_latency("look-ahead included:", f->whole_s, f->n);
	print_latency("beyond it:", f->beyond_s, f->n);
	print_rows(f, dropped);
	print_histogram(f);
}

/* Commits of so many seconds, and how many rows were dropped meanwhile. */
static size_t watch(struct facet *facet, double seconds, struct commit *commit, int64_t *ret_dropped)
{
	int64_t before, begin_ns;
	size_t n;

	follow(facet, clock_ns(CLOCK_MONOTONIC) + SETTLE_NS, commit);
	before = rows_not_applied();
	follow(facet, clock_ns(CLOCK_MONOTONIC) + ASKED_NS, commit);
	begin_ns = clock_ns(CLOCK_MONOTONIC);
	n = follow(facet, begin_ns + (int64_t)(seconds * 1e9), commit);
	*ret_dropped = rows_not_applied() - before;
	return n;
}

int main(int argc, char **argv)
{
	const double seconds = argc > 2 ? strtod(argv[2], NULL) : 30;
	const int64_t realtime_ns = clock_ns(CLOCK_REALTIME) - clock_ns(CLOCK_MONOTONIC);
	struct commit *commit = room(COMMITS, sizeof(*commit));
	struct profile_sent *profile = room(PROFILES, sizeof(*profile));
	struct figures f = {.whole_s = room(ROWS, sizeof(double)),
	                    .beyond_s = room(ROWS, sizeof(double)),
	                    .off_s = room(ROWS, sizeof(double)),
	                    .dirty = room(COMMITS, sizeof(double))};
	struct facet *facet;
	size_t commits, profiles, last;
	int64_t dropped;

	if (argc < 2 || !(seconds > 0))
		give_up("usage", "latency SENT_FILE [SECONDS], within `facet simulate --sent SENT_FILE`");
	facet = open_facet();
	facet_want(facet, NULL);
	commits = watch(facet, seconds, commit, &dropped);
	facet_close(facet);
	last = profiles = read_sent(argv[1], profile);
	for (size_t i = 1; i < commits; i++)
		if (!commit[i].reset)
			note_batch(&f, profile, profiles, &commit[i], commit[i - 1].step, realtime_ns, &last);
	if (f.n == 0)
		give_up("the daemon", "published no row of a known profile");
	print(&f, seconds, dropped);
	free(commit);
	free(profile);
	free(f.whole_s);
	free(f.beyond_s);
	free(f.off_s);
	free(f.dirty);
	return 0;
}
