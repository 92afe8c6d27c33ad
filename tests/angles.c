/* Compares the angles in a kept list of the daemon (`facetd --journal`) with where the axis truly was.
 *
 *   angles JOURNAL CONFIG DEVICE TRUTH             TRUTH: lines "T ANGLE ...", CLOCK_REALTIME in ns and rad
 *   angles --beams LASER JOURNAL CONFIG DEVICE TRUTH   and at the time of each beam of this scanner, between two angles
 *   angles --sequence JOURNAL CONFIG DEVICE TRUTH  one by one, times against the first one's: what a player played
 *
 * Prints `key value` a line: angles, rate_hz, error_p50_deg, error_p99_deg, error_max_deg, and of beams the same with beam_
 * before it and beams_apart: those without an angle within 50 ms on either side. With --sequence: wrong, late_p99_ms. Status 2:
 * something could not be read. Records are decoded by the drivers themselves; log time is CLOCK_REALTIME unless the clock was
 * set, which ends this. */
#include <fcntl.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <unistd.h>

#include "core/trig.h"
#include "drivers/driver.h"

#define APART_NS 50000000 /* angles farther from each other have nothing to say of a beam between them */

struct samples {
	size_t n, cap;
	struct sample {
		int64_t t_ns;
		double rad;
	} * item;
};

static struct samples angles, truth, beams; /* beams: their times */
static const char *laser;
static struct config config;
static struct decoder *decoder[CONFIG_DEVICES_MAX];
static const struct driver *driver[CONFIG_DEVICES_MAX];
static int servo = -1, scanner = -1;

static void stop(const char *what, const char *more)
{
	fprintf(stderr, "angles: %s%s\n", what, more);
	exit(2);
}

static void add(struct samples *s, int64_t t_ns, double rad)
{
	if (s->n == s->cap)
		s->item = realloc(s->item, (s->cap = s->cap * 2 + 1024) * sizeof *s->item);
	if (!s->item)
		stop("out of memory", "");
	s->item[s->n++] = (struct sample){t_ns, rad};
}

static void on_tilt(void *ctx, int device, const struct tilt *tilt)
{
	(void)ctx;
	if (device == servo)
		add(&angles, tilt->t_ns, tilt->angle_rad);
}

static void on_profile(void *ctx, int device, const struct profile *p)
{
	(void)ctx;
	if (device != scanner)
		return;
	for (int k = 0; k < p->n; k++)
		add(&beams,
		    p->t_ns + (int64_t)(k / p->interlace) * p->beam_ns + (int64_t)(k % p->interlace) * p->turn_ns, 0);
}

static void on_pose(void *ctx, int device, const struct pose *pose)
{
	(void)ctx;
	(void)device;
	(void)pose;
}

static void *map_file(const char *path, size_t *ret_len)
{
	int fd = open(path, O_RDONLY | O_CLOEXEC);
	struct stat st;
	void *bytes;

	if (fd < 0 || fstat(fd, &st) < 0 || st.st_size == 0)
		stop("cannot read ", path);
	bytes = mmap(NULL, (size_t)st.st_size, PROT_READ, MAP_PRIVATE, fd, 0);
	if (bytes == MAP_FAILED)
		stop("cannot map ", path);
	close(fd);
	*ret_len = (size_t)st.st_size;
	return bytes;
}

static void read_config(const char *path, const char *device)
{
	struct config_error error;
	size_t len;
	char *text = map_file(path, &len);

	if (config_read(text, len, path, &config, &error) < 0)
		stop(error.text, "");
	for (int i = 0; i < config.devices; i++) {
		driver[i] = driver_find(config.device[i].driver);
		decoder[i] = driver[i]->decoder_create(&config.device[i], i);
		if (strcmp(config.device[i].name, device) == 0)
			servo = i;
		if (laser && strcmp(config.device[i].name, laser) == 0)
			scanner = i;
	}
	if (servo < 0 || (laser && scanner < 0))
		stop("the configuration has no such device: ", servo < 0 ? device : laser);
}

/* The layout is told in daemon/journal.c; a list that was cut ends at its last whole entry. */
static void read_journal(const char *path)
{
	const struct record_sink sink = {.profile = on_profile, .tilt = on_tilt, .pose = on_pose};
	const uint8_t *b;
	size_t len;
	uint32_t n;

	b = map_file(path, &len);
	if (len < 8 || memcmp(b, "FACETJ2\n", 8) != 0)
		stop("no kept list: ", path);
	for (size_t at = 8; at < len;) {
		struct record r = {0};

		if (b[at] == 1 && len - at >= 5) {
			memcpy(&n, b + at + 1, 4);
			at += 5 + (size_t)n;
			continue;
		}
		if (b[at] != 2) {
			at += 9; /* a tick, a row, a clock */
			continue;
		}
		if (len - at < 23)
			break;
		memcpy(&r.log_ns, b + at + 1, 8);
		memcpy(&r.t_ns, b + at + 9, 8);
		r.device = b[at + 17];
		r.direction = (enum direction)b[at + 18];
		memcpy(&n, b + at + 19, 4);
		r.len = n;
		r.bytes = b + at + 23;
		if (n > len - at - 23 || r.device >= config.devices)
			break;
		if (r.device == servo || r.device == scanner)
			driver[r.device]->decode(decoder[r.device], &r, &sink);
		at += 23 + (size_t)n;
	}
}

static void read_truth(const char *path)
{
	FILE *file = fopen(path, "re");
	char line[256];
	long long t_ns;
	double rad;

	if (!file)
		stop("cannot read ", path);
	while (fgets(line, sizeof line, file))
		if (sscanf(line, "%lld %lf", &t_ns, &rad) == 2)
			add(&truth, t_ns, rad);
	fclose(file);
}

/* Of samples in the order of their times; false: none on both sides, or too far apart. */
static bool between(const struct samples *s, int64_t t_ns, double *ret_rad)
{
	size_t low = 0, high = s->n;

	while (low < high) {
		const size_t middle = (low + high) / 2;

		if (s->item[middle].t_ns <= t_ns)
			low = middle + 1;
		else
			high = middle;
	}
	if (low == 0 || low == s->n || s->item[low].t_ns - s->item[low - 1].t_ns > APART_NS)
		return false;
	const struct sample *a = &s->item[low - 1], *b = &s->item[low];

	*ret_rad = a->rad + (b->rad - a->rad) * (double)(t_ns - a->t_ns) / (double)(b->t_ns - a->t_ns);
	return true;
}

static int compare(const void *a, const void *b)
{
	const double x = *(const double *)a, y = *(const double *)b;

	return x < y ? -1 : x > y;
}

static void print_errors(const char *prefix, double *error, size_t n)
{
	qsort(error, n, sizeof *error, compare);
	printf("%serrors %zu\n", prefix, n);
	if (n == 0)
		return;
	printf("%serror_p50_deg %.5f\n%serror_p99_deg %.5f\n%serror_max_deg %.5f\n", prefix, error[n / 2] / TRIG_DEG,
	       prefix, error[n * 99 / 100] / TRIG_DEG, prefix, error[n - 1] / TRIG_DEG);
}

static void compare_times(void)
{
	double *error = calloc(angles.n + beams.n + 1, sizeof *error), is, was;
	size_t n = 0, apart = 0;

	for (size_t i = 0; i < angles.n; i++)
		if (between(&truth, angles.item[i].t_ns, &was))
			error[n++] = fabs(angles.item[i].rad - was);
	print_errors("", error, n);
	n = 0;
	for (size_t i = 0; i < beams.n; i++) {
		if (!between(&truth, beams.item[i].t_ns, &was))
			continue;
		if (between(&angles, beams.item[i].t_ns, &is))
			error[n++] = fabs(is - was);
		else
			apart++;
	}
	if (laser) {
		print_errors("beam_", error, n);
		printf("beams_apart %zu\n", apart);
	}
	free(error);
}

static void compare_sequence(void)
{
	const size_t n = angles.n < truth.n ? angles.n : truth.n;
	double *late = calloc(n + 1, sizeof *late);
	size_t wrong = angles.n > truth.n ? angles.n - truth.n : truth.n - angles.n;

	for (size_t i = 0; i < n; i++) {
		wrong += fabs(angles.item[i].rad - truth.item[i].rad) > 1e-7;
		late[i] = fabs((double)(angles.item[i].t_ns - angles.item[0].t_ns) -
		               (double)(truth.item[i].t_ns - truth.item[0].t_ns));
	}
	qsort(late, n, sizeof *late, compare);
	printf("wrong %zu\nlate_p99_ms %.3f\n", wrong, n ? late[n * 99 / 100] / 1e6 : 0);
	free(late);
}

int main(int argc, char **argv)
{
	bool sequence = false;

	if (argc > 1 && strcmp(argv[1], "--sequence") == 0) {
		sequence = true;
		argv++;
		argc--;
	} else if (argc > 2 && strcmp(argv[1], "--beams") == 0) {
		laser = argv[2];
		argv += 2;
		argc -= 2;
	}
	if (argc != 5)
		stop("usage: angles [--sequence | --beams LASER] JOURNAL CONFIG DEVICE TRUTH", "");
	read_config(argv[2], argv[3]);
	read_journal(argv[1]);
	read_truth(argv[4]);
	printf("angles %zu\n", angles.n);
	if (angles.n > 1)
		printf("rate_hz %.2f\n",
		       (double)(angles.n - 1) * 1e9 / (double)(angles.item[angles.n - 1].t_ns - angles.item[0].t_ns));
	if (sequence)
		compare_sequence();
	else
		compare_times();
	return 0;
}
