/* How a row is played: the device streams (or is about to be opened), counters and log are looked at, the faults are
 * ordered and taken back when they are over, then five quiet seconds; the difference is the row. Whatever the fault, no
 * row of points may come from anything but what the scanner measured, and every telegram that left whole must have
 * become a profile or a count. */
#include "tests/matrix.h"

#include <math.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdio.h>
#include <string.h>

#include <cmocka.h>

#define AFTER_NS  (5 * RIG_SECOND)
#define BEFORE_NS (3 * RIG_SECOND)
#define TEXT_MAX  600
#define TOLERATED 9
#define WATCH_NS  (2 * RIG_MS)   /* how often the drive is looked at */
#define STANDS_NS (150 * RIG_MS) /* no turn of a sweep takes so long */

static const struct matrix_bench *the_bench;
static struct rig *the_rig; /* also of a row that failed */

struct play {
	const struct matrix_bench *bench;
	const struct matrix_row *row;
	struct rig *rig;
	int64_t begin_ns, end_ns, again_ns;
	size_t logged; /* before */
	uint64_t losses;
	int device;
	struct decoder_counters before, after;
	/* The drive: since when it has stood, or moved; when it came to stand first, and moved for good last; -1: never. */
	int64_t still_ns, stood_ns, moved_ns;
};

/* The time goes on, and the drive is looked at meanwhile. */
static void run(struct play *p, int64_t for_ns)
{
	const int64_t until_ns = rig_now(p->rig) + for_ns;

	if (!p->bench->speed) {
		rig_run(p->rig, for_ns);
		return;
	}
	while (rig_now(p->rig) < until_ns) {
		const int64_t now_ns = rig_now(p->rig);
		const bool moves = fabs(p->bench->speed(p->rig)) > 1e-3;

		if (moves && p->still_ns >= 0 && now_ns - p->still_ns >= STANDS_NS)
			p->moved_ns = now_ns;
		p->still_ns = moves ? -1 : p->still_ns < 0 ? now_ns : p->still_ns;
		if (p->stood_ns < 0 && p->still_ns >= 0 && now_ns - p->still_ns >= STANDS_NS)
			p->stood_ns = p->still_ns;
		rig_run(p->rig, until_ns - now_ns < WATCH_NS ? until_ns - now_ns : WATCH_NS);
	}
}

static int64_t wait_data(struct play *p, int64_t limit_ns)
{
	const int64_t begin_ns = rig_now(p->rig);
	struct rig_view view;

	while (rig_now(p->rig) - begin_ns < limit_ns) {
		run(p, RIG_MS);
		rig_view(p->rig, p->bench->device, &view);
		if (view.state == SUPERVISOR_STREAMING && view.last_data_ns > begin_ns)
			return view.last_data_ns - begin_ns;
	}
	return -1;
}

static void see_counters(const struct play *p, struct decoder_counters *ret)
{
	rig_counters(p->rig, p->bench->device, ret);
}

static bool among(const char *const *names, const char *name)
{
	for (; names && *names; names++)
		if (strcmp(*names, name) == 0)
			return true;
	return false;
}

static void order_faults(const struct play *p)
{
	for (int i = 0; i < MATRIX_FAULTS && p->row->fault[i].kind; i++) {
		const struct matrix_fault *f = &p->row->fault[i];
		bool known = f->for_ns == 0 ? rig_once(p->rig, p->bench->device, f->kind, f->value)
		                            : rig_fault(p->rig, p->bench->device, f->kind, f->value, true);

		if (!known)
			fail_msg("%s: nobody knows the fault \"%s\"", p->row->name, f->kind);
	}
}

/* Runs until each is over, and takes it back; those for ever stay. */
static void outlast_faults(struct play *p)
{
	for (;;) {
		int64_t next_ns = INT64_MAX, now_ns = rig_now(p->rig) - p->begin_ns;

		for (int i = 0; i < MATRIX_FAULTS && p->row->fault[i].kind; i++)
			if (p->row->fault[i].for_ns > now_ns && p->row->fault[i].for_ns < next_ns)
				next_ns = p->row->fault[i].for_ns;
		if (next_ns == INT64_MAX)
			break;
		run(p, next_ns - now_ns);
		for (int i = 0; i < MATRIX_FAULTS && p->row->fault[i].kind; i++)
			if (p->row->fault[i].for_ns == next_ns)
				rig_fault(p->rig, p->bench->device, p->row->fault[i].kind, p->row->fault[i].value,
				          false);
	}
	p->end_ns = rig_now(p->rig);
}

static void begin(struct play *p)
{
	const char *device = p->bench->device;
	struct rig_view view;

	p->rig = the_rig = p->bench->make(p->row);
	p->device = rig_find(p->rig, device);
	if (!p->row->from_start) {
		rig_start(p->rig);
		if (p->bench->points && rig_wait_data(p->rig, p->bench->points, 30 * RIG_SECOND) < 0)
			fail_msg("%s: %s does not stream at first", p->row->name, p->bench->points);
		if (rig_wait_data(p->rig, device, p->bench->setup_ns) < 0)
			fail_msg("%s: it does not stream at first", p->row->name);
		rig_run(p->rig, BEFORE_NS);
	}
	see_counters(p, &p->before);
	p->logged = rig_logged(p->rig);
	rig_view(p->rig, device, &view);
	p->losses = view.line.losses;
	rig_mark(p->rig, device);
	p->begin_ns = rig_now(p->rig);
	order_faults(p);
	if (p->row->from_start)
		rig_start(p->rig);
}

/* What was seen */

static int64_t moved(const struct play *p, int i)
{
	return (int64_t)(p->after.counter[i].count - p->before.counter[i].count);
}

static void check_counters(const struct play *p)
{
	for (int i = 0; i < p->after.n; i++) {
		const char *name = p->after.counter[i].name;
		int64_t least = 0, most = among(p->bench->tolerated, name) ? TOLERATED : 0;

		if (among(p->bench->quiet, name))
			continue;
		for (int k = 0; k < MATRIX_COUNTERS && p->row->counted[k].name; k++)
			if (strcmp(p->row->counted[k].name, name) == 0) {
				least = p->row->counted[k].least;
				most = p->row->counted[k].most;
			}
		if (moved(p, i) < least || moved(p, i) > most)
			fail_msg("%s: counted %s %lld, not %lld to %lld", p->row->name, name, (long long)moved(p, i),
			         (long long)least, (long long)most);
	}
	for (int k = 0; k < MATRIX_COUNTERS && p->row->counted[k].name; k++)
		if (rig_count(p->rig, p->bench->device, p->row->counted[k].name) < 0)
			fail_msg("%s: there is no counter %s", p->row->name, p->row->counted[k].name);
}

/* The devices' own lines since the row began, one behind the other. */
static void print_log(const struct play *p, char text[TEXT_MAX])
{
	text[0] = 0;
	for (size_t i = p->logged; i < rig_logged(p->rig); i++) {
		const struct rig_log *line = rig_log(p->rig, i);
		size_t len = strlen(text);

		if (line && line->device == p->device)
			snprintf(text + len, TEXT_MAX - len, "%s%s", len ? " / " : "", line->text);
	}
}

static void check_log(const struct play *p)
{
	char text[TEXT_MAX];

	print_log(p, text);
	if (p->row->from_start && strcmp(text, "streaming") == 0)
		text[0] = 0;
	if (p->row->log ? !strstr(text, p->row->log) : text[0] != 0)
		fail_msg("%s: the log says \"%s\"", p->row->name, text);
}

/* Nothing is said twice, but that it streams. */
static void check_said_once(const struct play *p)
{
	for (size_t i = p->logged; i < rig_logged(p->rig); i++)
		for (size_t k = p->logged; k < i; k++) {
			const struct rig_log *one = rig_log(p->rig, i), *other = rig_log(p->rig, k);

			if (one && other && one->device == p->device && other->device == p->device &&
			    strcmp(one->text, "streaming") != 0 && strcmp(one->text, other->text) == 0)
				fail_msg("%s: said twice: \"%s\"", p->row->name, one->text);
		}
}

/* Times are those of the row's begin and end. */
static void check_drive(const struct play *p)
{
	const int64_t stood_ns = p->stood_ns < 0 ? -1 : p->stood_ns - p->begin_ns;
	const bool stands = p->still_ns >= 0 && rig_now(p->rig) - p->still_ns >= STANDS_NS;

	if (!p->bench->speed)
		return;
	if (p->row->drive == DRIVE_GOES_ON && !p->row->from_start && stood_ns >= 0)
		fail_msg("%s: the drive stood after %lld ms", p->row->name, (long long)(stood_ns / RIG_MS));
	if ((p->row->drive == DRIVE_RESUMES || p->row->drive == DRIVE_HALTS) && stood_ns < 0)
		fail_msg("%s: the drive never stood", p->row->name);
	if (p->row->stands_ns > 0 && (stood_ns < 0 || stood_ns > p->row->stands_ns))
		fail_msg("%s: the drive stood after %lld ms", p->row->name, (long long)(stood_ns / RIG_MS));
	if (stands != (p->row->drive == DRIVE_HALTS))
		fail_msg("%s: the drive %s at the end", p->row->name, stands ? "stands" : "moves");
	if (p->row->sweeps_ns > 0 && p->moved_ns - p->end_ns > p->row->sweeps_ns)
		fail_msg("%s: the drive moved %lld ms after its end", p->row->name,
		         (long long)((p->moved_ns - p->end_ns) / RIG_MS));
}

/* Whole telegrams are decoded, or left out for a reason that is counted. */
static void check_account(const struct play *p, const struct rig_view *view)
{
	uint64_t accounted = view->profiles + view->lost_profiles;

	for (int i = 0; i < p->after.n; i++)
		if (among(p->bench->left_out, p->after.counter[i].name))
			accounted += p->after.counter[i].count;
	if (accounted != view->sent.sent)
		fail_msg("%s: %llu telegrams were sent, %llu decoded, %llu lost on the way", p->row->name,
		         (unsigned long long)view->sent.sent, (unsigned long long)view->profiles,
		         (unsigned long long)view->lost_profiles);
}

static void check_points(const struct play *p)
{
	struct rig_points points;
	double astray;

	rig_points(p->rig, p->bench->points ? p->bench->points : p->bench->device, &points);
	astray = (double)(points.points - points.near) / (double)(points.points ? points.points : 1);
	if ((points.unknown_rows > 0 && p->row->astray <= 0) || astray > (p->row->astray > 0 ? p->row->astray : 0.001))
		fail_msg("%s: %llu of %llu rows were never measured, %llu of %llu points lie where their beams ended",
		         p->row->name, (unsigned long long)points.unknown_rows, (unsigned long long)points.rows,
		         (unsigned long long)points.near, (unsigned long long)points.points);
}

/* What is ordered once has no end: the pause tells all. */
static int64_t again_limit(const struct matrix_row *row)
{
	return row->again_ns ? row->again_ns : row->pause_ns ? row->pause_ns : 20 * RIG_SECOND;
}

static void check_flow(const struct play *p, const struct rig_view *view)
{
	if (p->row->pause_ns == 0)
		return;
	if (view->state != SUPERVISOR_STREAMING || rig_now(p->rig) - view->last_data_ns > RIG_SECOND)
		fail_msg("%s: it does not stream at the end", p->row->name);
	if (view->longest_pause_ns > p->row->pause_ns)
		fail_msg("%s: %lld ms without a profile", p->row->name, (long long)(view->longest_pause_ns / RIG_MS));
	if (p->again_ns < 0 || p->again_ns > again_limit(p->row))
		fail_msg("%s: data %lld ms after its end", p->row->name, (long long)(p->again_ns / RIG_MS));
}

/* Whoever is there again is asked within 2 s, whatever its driver needs then. */
static void check_first_request(const struct play *p, const struct rig_view *view)
{
	static const char *const away[] = {"unplug", "refuse", "hang", NULL};
	int64_t end_ns = p->end_ns;

	if (!p->row->fault[0].kind || !among(away, p->row->fault[0].kind) || p->row->fault[0].for_ns == 0)
		return;
	if (view->first_request_ns < end_ns || view->first_request_ns > end_ns + 2 * RIG_SECOND)
		fail_msg("%s: the first request came %lld ms after it was there again", p->row->name,
		         (long long)((view->first_request_ns - end_ns) / RIG_MS));
}

static void check(const struct play *p)
{
	struct rig_view view;
	uint64_t losses;

	rig_view(p->rig, p->bench->device, &view);
	losses = view.line.losses - p->losses;
	check_flow(p, &view);
	check_first_request(p, &view);
	check_counters(p);
	check_log(p);
	check_said_once(p);
	check_drive(p);
	check_account(p, &view);
	check_points(p);
	if (p->row->losses >= 0 && losses != (uint64_t)p->row->losses)
		fail_msg("%s: lost %llu times", p->row->name, (unsigned long long)losses);
	if (p->row->check)
		p->row->check(p->rig, p->row);
}

/* The line of the table */

static void print_faults(const struct play *p, char text[TEXT_MAX])
{
	text[0] = 0;
	for (int i = 0; i < MATRIX_FAULTS && p->row->fault[i].kind; i++) {
		const struct matrix_fault *f = &p->row->fault[i];
		size_t len = strlen(text);

		len += (size_t)snprintf(text + len, TEXT_MAX - len, "%s`%s", len ? ", " : "", f->kind);
		if (f->value != 0)
			len += (size_t)snprintf(text + len, TEXT_MAX - len, " %g", f->value);
		len += (size_t)snprintf(text + len, TEXT_MAX - len, "`");
		if (f->for_ns > 0 && f->for_ns != INT64_MAX)
			snprintf(text + len, TEXT_MAX - len, " for %g s", (double)f->for_ns * 1e-9);
	}
	if (p->row->keys && strlen(text) + strlen(p->row->keys) + 8 < TEXT_MAX)
		sprintf(text + strlen(text), "%s`%s`", text[0] ? "; " : "", p->row->keys + 2);
	if (p->row->from_start && strlen(text) + 20 < TEXT_MAX)
		strcat(text, text[0] ? ", at start" : "at start");
}

static void print_counted(const struct play *p, char text[TEXT_MAX])
{
	text[0] = 0;
	for (int i = 0; i < p->after.n; i++) {
		size_t len = strlen(text);

		if (moved(p, i) != 0 && !among(p->bench->quiet, p->after.counter[i].name))
			snprintf(text + len, TEXT_MAX - len, "%s%s %lld", len ? ", " : "", p->after.counter[i].name,
			         (long long)moved(p, i));
	}
}

static void print_drive(const struct play *p, char text[TEXT_MAX])
{
	text[0] = 0;
	if (!p->bench->speed)
		return;
	if (p->row->from_start)
		snprintf(text, TEXT_MAX, "%s | ", p->row->drive == DRIVE_HALTS ? "stands" : "sweeps");
	else if (p->stood_ns < 0)
		snprintf(text, TEXT_MAX, "goes on | ");
	else if (p->still_ns >= 0)
		snprintf(text, TEXT_MAX, "stands after %lld | ", (long long)((p->stood_ns - p->begin_ns) / RIG_MS));
	else if (p->moved_ns < p->end_ns)
		snprintf(text, TEXT_MAX, "stands after %lld, sweeps again meanwhile | ",
		         (long long)((p->stood_ns - p->begin_ns) / RIG_MS));
	else
		snprintf(text, TEXT_MAX, "stands after %lld, sweeps again after %lld | ",
		         (long long)((p->stood_ns - p->begin_ns) / RIG_MS),
		         (long long)((p->moved_ns - p->end_ns) / RIG_MS));
}

static void print_row(const struct play *p)
{
	char drive[TEXT_MAX], faults[TEXT_MAX], counted[TEXT_MAX], log[TEXT_MAX], again[40] = "";
	struct rig_view view;
	bool lasts = p->end_ns > p->begin_ns || p->row->from_start;

	rig_view(p->rig, p->bench->device, &view);
	print_faults(p, faults);
	print_counted(p, counted);
	print_log(p, log);
	print_drive(p, drive);
	if (p->row->pause_ns > 0 && lasts)
		snprintf(again, sizeof(again), "%lld", (long long)(p->again_ns / RIG_MS));
	printf("row: %s | %s | %s | %s | %s | %s | %s", p->bench->title, p->row->name, faults, p->row->does, counted,
	       log, drive);
	if (p->row->from_start)
		printf("| %s |\n", p->row->pause_ns ? again : "never");
	else
		printf("%lld | %s |\n", (long long)(view.longest_pause_ns / RIG_MS), again);
}

static void play(const struct matrix_bench *bench, const struct matrix_row *row)
{
	struct play p = {.bench = bench, .row = row, .still_ns = -1, .stood_ns = -1, .moved_ns = -1};

	begin(&p);
	outlast_faults(&p);
	p.again_ns = wait_data(&p, again_limit(row) + RIG_SECOND);
	if (p.again_ns >= 0 && row->from_start)
		p.again_ns += p.end_ns - p.begin_ns;
	run(&p, AFTER_NS);
	see_counters(&p, &p.after);
	if (!row->unlisted)
		print_row(&p);
	check(&p);
}

static void a_row(void **state)
{
	play(the_bench, *state);
}

static int end_row(void **state)
{
	(void)state;
	rig_destroy(the_rig);
	the_rig = NULL;
	return 0;
}

int matrix_run(const struct matrix_bench *bench, const struct matrix_row *rows, size_t n)
{
	struct CMUnitTest tests[MATRIX_ROWS_MAX];

	assert_true(n <= MATRIX_ROWS_MAX);
	the_bench = bench;
	for (size_t i = 0; i < n; i++)
		tests[i] = (struct CMUnitTest){.name = rows[i].name,
		                               .test_func = a_row,
		                               .teardown_func = end_row,
		                               .initial_state = (void *)&rows[i]};
	return _cmocka_run_group_tests(bench->title, tests, n, NULL, NULL);
}
