/* A simulated TiM on USB with orders on its standard input: what `facet simulate` is for people, for scripts that watch closely.
 *   gadget NAME SERIAL [CONTROLLER]
 * Orders, one a line: `KIND on [VALUE]`, `KIND off`, `KIND once [VALUE]`: a fault; `counts`: what the device did, what the
 * shell saw of its host. It answers each with a line, and says when a host's first request came after it was plugged in.
 * The end of the input, SIGTERM or SIGINT ends it. */
#include <errno.h>
#include <fcntl.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "tools/sim_gadget.h"

#define LOOK_MS 10
#define WALL_M  2.0f

struct program {
	uv_loop_t loop;
	uv_poll_t orders;
	uv_signal_t interrupt, terminate;
	uv_timer_t look;
	struct sim_gadget *gadget;
	struct sim_device device; /* the gadget owns it */
	uint64_t told;            /* of which plugging the first request was told */
	char line[256];
	size_t len;
};

/* A round room: its walls are as far in every direction. */
static void scan(void *ctx, struct profile *profile)
{
	(void)ctx;
	for (int i = 0; i < profile->n; i++) {
		profile->range_m[i] = WALL_M;
		profile->state[i] = BEAM_OK;
	}
}

static void on_look(uv_timer_t *timer)
{
	struct program *p = timer->data;
	struct sim_gadget_seen seen;
	sim_gadget_seen(p->gadget, &seen);
	if (seen.first_request_ns < 0 || p->told == seen.plugged)
		return;
	p->told = seen.plugged;
	printf("plugged in %llu times; first request after %lld ms\n", (unsigned long long)seen.plugged,
	       (long long)(seen.first_request_ns / 1000000));
}

static void say_counts(struct program *p)
{
	struct sim_gadget_seen seen;
	struct sim_counts counts;
	sim_gadget_seen(p->gadget, &seen);
	p->device.counts(p->device.ctx, &counts);
	printf(
	    "profiles %llu sent %llu dropped %llu corrupted %llu requests %llu enabled %llu halts %llu cleared %llu\n",
	    (unsigned long long)counts.profiles, (unsigned long long)counts.sent, (unsigned long long)counts.dropped,
	    (unsigned long long)counts.corrupted, (unsigned long long)counts.requests, (unsigned long long)seen.enabled,
	    (unsigned long long)seen.halts, (unsigned long long)seen.halts_cleared);
}

static void obey(struct program *p, const char *line)
{
	struct sim_fault fault = {.for_ns = INT64_MAX};
	char how[8] = "once";
	const int n = sscanf(line, "%40s %7s %lf", fault.kind, how, &fault.value);
	if (n < 1)
		return;
	if (strcmp(fault.kind, "counts") == 0) {
		say_counts(p);
		return;
	}
	if (strcmp(how, "once") == 0)
		fault.for_ns = 0;
	const bool known = sim_gadget_fault(p->gadget, &fault, strcmp(how, "off") != 0);
	printf("%s %s%s\n", fault.kind, how, known ? "" : ": no such fault");
}

static void finish(struct program *p)
{
	if (uv_is_closing((uv_handle_t *)&p->orders))
		return;
	uv_close((uv_handle_t *)&p->orders, NULL);
	uv_close((uv_handle_t *)&p->interrupt, NULL);
	uv_close((uv_handle_t *)&p->terminate, NULL);
	uv_close((uv_handle_t *)&p->look, NULL);
	sim_gadget_destroy(p->gadget);
}

static void on_signal(uv_signal_t *signal, int number)
{
	(void)number;
	finish(signal->data);
}

static void on_orders(uv_poll_t *handle, int status, int events)
{
	struct program *p = handle->data;
	(void)status, (void)events;
	const ssize_t n = read(STDIN_FILENO, p->line + p->len, sizeof p->line - 1 - p->len);
	if (n < 0 && errno == EAGAIN)
		return;
	if (n <= 0) {
		finish(p);
		return;
	}
	p->len += (size_t)n;
	p->line[p->len] = '\0';
	char *line = p->line;
	for (char *end; (end = strchr(line, '\n')) != NULL; line = end + 1) {
		*end = '\0';
		obey(p, line);
	}
	p->len = strlen(line);
	memmove(p->line, line, p->len);
	if (p->len == sizeof p->line - 1) /* no order is that long */
		p->len = 0;
}

static int start(struct program *p, char **argv, int argc)
{
	const struct scene room = {.scan = scan};
	const struct sim_cola_params params = {
	    .model = SIM_TIM561, .dialect = SIM_COLA_FACTORY, .serial = (uint32_t)strtoul(argv[2], NULL, 10)};
	const struct sim_gadget_params usb = {
	    .name = argv[1], .serial = argv[2], .title = "TiM561", .controller = argc > 3 ? argv[3] : NULL};
	char error[160];
	if (sim_cola_create(&params, &room, (int64_t)uv_hrtime(), &p->device) < 0)
		return -ENOMEM;
	p->gadget = sim_gadget_create(&p->loop, &p->device, &usb, error);
	if (p->gadget == NULL)
		fprintf(stderr, "gadget: %s\n", error);
	return p->gadget == NULL ? -EIO : 0;
}

int main(int argc, char **argv)
{
	static struct program program;
	struct program *p = &program;
	if (argc < 3) {
		fprintf(stderr, "usage: gadget NAME SERIAL [CONTROLLER]\n");
		return 2;
	}
	setvbuf(stdout, NULL, _IOLBF, 0);
	uv_loop_init(&p->loop);
	if (start(p, argv, argc) < 0)
		return 1;
	fcntl(STDIN_FILENO, F_SETFL, O_NONBLOCK);
	uv_poll_init(&p->loop, &p->orders, STDIN_FILENO);
	uv_signal_init(&p->loop, &p->interrupt);
	uv_signal_init(&p->loop, &p->terminate);
	uv_timer_init(&p->loop, &p->look);
	p->orders.data = p->interrupt.data = p->terminate.data = p->look.data = p;
	uv_poll_start(&p->orders, UV_READABLE, on_orders);
	uv_signal_start(&p->interrupt, on_signal, SIGINT);
	uv_signal_start(&p->terminate, on_signal, SIGTERM);
	uv_timer_start(&p->look, on_look, LOOK_MS, LOOK_MS);
	uv_run(&p->loop, UV_RUN_DEFAULT);
	uv_loop_close(&p->loop);
	return 0;
}
