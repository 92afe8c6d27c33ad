/* `facet simulate`: starts a scenario's devices and, if asked for, the program to try on them.
 *
 * COMMAND gets a process group of its own, and everything ends together: when COMMAND ends, when the scenario is over
 * (COMMAND then has two seconds to finish by itself), on SIGINT or SIGTERM. Ending is polite first: SIGTERM to COMMAND
 * while the devices still answer; when it has gone, SIGTERM to what it left behind in its group; whoever is still there
 * after a grace is killed. This process is the reaper of orphans, else a dead orphan would keep its group alive for the
 * eye of kill(). Should this process be killed itself, COMMAND gets SIGTERM from the kernel. */
#include <argp.h>
#include <errno.h>
#include <fcntl.h>
#include <ftw.h>
#include <limits.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/prctl.h>
#include <sys/stat.h>
#include <sys/wait.h>
#include <unistd.h>
#include <uv.h>

#include "config/address.h"
#include "tools/commands.h"
#include "tools/scenario.h"
#include "tools/sim_control.h"

#define AFTER_MS 2000  /* what COMMAND has after the scenario's end */
#define GRACE_MS 10000 /* from SIGTERM to SIGKILL: a daemon that writes its map needs some of it */
#define LOOK_MS  20
#define SEED     1

struct options {
	const char *scenario, *dir, *tcp, *http;
	char *more[64];
	int more_n;
	char *fault[64];
	int faults;
	enum scenario_laser laser;
	bool encoder, endless;
	enum scenario_servo servo;
	enum scenario_odometry odometry;
	char can[64]; /* --can, cut at its colon: the configuration's interface follows */
	const char *can_config, *truth, *sent;
	bool fast, usb;
	double speed;
	uint64_t seed;
	char **command; /* NULL: none */
};

struct simulation {
	uv_loop_t loop;
	uv_signal_t interrupt, terminate, child;
	uv_timer_t after, look;
	struct scenario *scenario;
	char dir[PATH_MAX];
	bool fresh;    /* made here: removed at the end */
	pid_t command; /* 0: none, or gone */
	pid_t group;
	bool ending, over;
	int64_t asked_ms; /* when the ending began */
	int signalled;    /* how far it went: 1 COMMAND, 2 its group, 3 killed */
	int status;
};

/* ---- the command line ---- */

enum {
	OPTION_SPEED = 256,
	OPTION_SEED,
	OPTION_FAULT,
	OPTION_DIR,
	OPTION_TCP,
	OPTION_HTTP,
	OPTION_SERVO,
	OPTION_LASER,
	OPTION_ENCODER,
	OPTION_USB,
	OPTION_ENDLESS,
	OPTION_ODOMETRY,
	OPTION_CAN,
	OPTION_TRUTH,
	OPTION_SENT
};

static const struct argp_option option_list[] = {
    {"dir", OPTION_DIR, "DIR", 0,
     "where the devices, sockets and facetd.yaml are put (default: a fresh one, removed at the end)", 0},
    {"speed", OPTION_SPEED, "X|max", 0, "max: recorded sweeps without the pace of the wire", 0},
    {"seed", OPTION_SEED, "N", 0, "of the range noise of a world (default 1)", 0},
    {"tcp", OPTION_TCP, "HOST:PORT", 0, "let the daemon listen here too, beside DIR/facetd.sock", 0},
    {"servo", OPTION_SERVO, "KIND", 0,
     "modbus (default; on a pseudo-terminal), modbus-tcp, canopen, canopen-cyclic, canopen-velocity: facetd commands "
     "it; "
     "can, encoder, inclinometer: it moves by itself and tells its angle on CAN; fixed: there is none",
     0},
    {"odometry", OPTION_ODOMETRY, "wheels|speed", OPTION_ARG_OPTIONAL,
     "wheels tell the motion on CAN (what they count, or speed and turn), and poses come once a second", 0},
    {"can", OPTION_CAN, "IFACE[:OTHER]", 0,
     "the nodes are on this CAN interface instead of DIR/can.sock, facetd on OTHER (default: the same)", 0},
    {"truth", OPTION_TRUTH, "FILE", 0,
     "where axis and robot truly were: a line a millisecond, T (ns), ANGLE, X, Y, Z, YAW", 0},
    {"sent", OPTION_SENT, "FILE", 0,
     "when profiles left the LMS2xx: a line each, SENT (of the last byte) and MEASURED (of the first beam), ns of "
     "CLOCK_MONOTONIC",
     0},
    {"laser", OPTION_LASER, "lms2xx|tim|lms1xx|lms5xx", 0,
     "which scanner: a LMS2xx on a pseudo-terminal (default), or a TiM571, LMS111, LMS511 on TCP", 0},
    {"usb", OPTION_USB, 0, 0,
     "the tim on USB instead of TCP: as root, on a kernel with a device controller (modprobe -a dummy_hcd libcomposite "
     "usb_f_fs)",
     0},
    {"encoder", OPTION_ENCODER, 0, 0, "the angle comes in the scanner's telegrams (lms1xx, lms5xx)", 0},
    {"endless", OPTION_ENDLESS, 0, 0, "the drive goes there and back again until it is ended", 0},
    {"fault", OPTION_FAULT, "SPEC", 0,
     "DEVICE: KIND [VALUE] [at TIME] [for TIME|ever], e.g. 'laser: garbage at 3s for 2s', 'can: bus-off at 3s for 2s'; "
     "may "
     "be repeated; a DEVICE or KIND that is wrong is answered with those there are",
     0},
    {"http", OPTION_HTTP, "HOST:PORT", 0, "let the daemon serve its page, snapshots and WebSockets here", 0},
    {0},
};

static void parse_speed(struct argp_state *state, const char *arg, struct options *o)
{
	char *end;

	o->fast = !strcmp(arg, "max");
	o->speed = o->fast ? 0.0 : strtod(arg, &end);
	if (!o->fast && (end == arg || *end || !(o->speed > 0.0 && o->speed <= 1000.0)))
		argp_error(state, "--speed: '%s' is neither max nor a number from 0 to 1000", arg);
}

static void parse_seed(struct argp_state *state, const char *arg, struct options *o)
{
	char *end;

	errno = 0;
	o->seed = strtoull(arg, &end, 10);
	if (end == arg || *end || errno || *arg == '-')
		argp_error(state, "--seed: '%s' is not a whole number", arg);
}

static const char *parse_loopback(struct argp_state *state, const char *option, const char *arg)
{
	char why[ADDRESS_ERROR_MAX];
	struct address address;

	if (address_parse_host(arg, &address, why) < 0 || address_check_loopback(&address, why) < 0)
		argp_error(state, "%s: %s", option, why);
	return arg;
}

static void parse_laser(struct argp_state *state, const char *arg, struct options *o)
{
	o->laser = scenario_laser(arg);
	if (o->laser == SCENARIO_LASERS)
		argp_error(state, "--laser: '%s' is none of lms2xx, tim, lms1xx, lms5xx", arg);
}

static void parse_servo(struct argp_state *state, const char *arg, struct options *o)
{
	o->servo = scenario_servo(arg);
	if (o->servo == SCENARIO_SERVOS)
		argp_error(
		    state,
		    "--servo: '%s' is none of modbus, modbus-tcp, can, canopen, canopen-cyclic, canopen-velocity, "
		    "encoder, inclinometer, fixed",
		    arg);
}

static void parse_odometry(struct argp_state *state, const char *arg, struct options *o)
{
	o->odometry = arg && !strcmp(arg, "speed") ? SCENARIO_SPEEDS : SCENARIO_WHEELS;
	if (arg && strcmp(arg, "speed") != 0 && strcmp(arg, "wheels") != 0)
		argp_error(state, "--odometry: '%s' is neither wheels nor speed", arg);
}

static void parse_can(struct argp_state *state, const char *arg, struct options *o)
{
	char *colon;

	snprintf(o->can, sizeof o->can, "%s", arg);
	colon = strchr(o->can, ':');
	if (colon)
		*colon = '\0';
	o->can_config = colon ? colon + 1 : o->can;
	if (!*o->can || strlen(o->can) > 15 || !*o->can_config || strlen(o->can_config) > 15 ||
	    strlen(arg) >= sizeof o->can || strcspn(arg, "/\"\\ \t\n,{}[]#") != strlen(arg))
		argp_error(state, "--can: '%s' is no CAN interface, like can1, nor two of them, like can1:can0", arg);
}

/* Only the form is judged here: what a device can do wrong is known when there is one. */
static void parse_fault(struct argp_state *state, char *arg, struct options *o)
{
	char why[FAULT_ERROR_MAX];
	struct sim_fault fault;

	if (fault_parse(arg, &fault, why) < 0)
		argp_error(state, "--fault: %s", why);
	if (o->faults == (int)(sizeof o->fault / sizeof *o->fault))
		argp_error(state, "--fault: too many of them");
	o->fault[o->faults++] = arg;
}

static void take_argument(struct argp_state *state, char *arg, struct options *o)
{
	if (!o->scenario)
		o->scenario = arg;
	else if (strncmp(o->scenario, "profiles:", 9) != 0)
		argp_error(state, "'%s' is one word too many; a COMMAND comes after --", arg);
	else if (o->more_n == (int)(sizeof o->more / sizeof *o->more))
		argp_error(state, "too many files");
	else
		o->more[o->more_n++] = arg;
}

static error_t parse_option(int key, char *arg, struct argp_state *state)
{
	struct options *o = state->input;

	switch (key) {
	case OPTION_SPEED:
		parse_speed(state, arg, o);
		return 0;
	case OPTION_SEED:
		parse_seed(state, arg, o);
		return 0;
	case OPTION_DIR:
		o->dir = arg;
		return 0;
	case OPTION_TCP:
		o->tcp = parse_loopback(state, "--tcp", arg);
		return 0;
	case OPTION_SERVO:
		parse_servo(state, arg, o);
		return 0;
	case OPTION_ODOMETRY:
		parse_odometry(state, arg, o);
		return 0;
	case OPTION_CAN:
		parse_can(state, arg, o);
		return 0;
	case OPTION_TRUTH:
		o->truth = arg;
		return 0;
	case OPTION_SENT:
		o->sent = arg;
		return 0;
	case OPTION_FAULT:
		parse_fault(state, arg, o);
		return 0;
	case OPTION_LASER:
		parse_laser(state, arg, o);
		return 0;
	case OPTION_USB:
		o->usb = true;
		return 0;
	case OPTION_ENCODER:
		o->encoder = true;
		return 0;
	case OPTION_ENDLESS:
		o->endless = true;
		return 0;
	case OPTION_HTTP:
		o->http = parse_loopback(state, "--http", arg);
		return 0;
	case ARGP_KEY_ARG:
		take_argument(state, arg, o);
		return 0;
	case ARGP_KEY_NO_ARGS:
		argp_error(state, "which scenario? building, hall, uos:DIR or profiles:FILE.csv");
		return 0;
	default:
		return ARGP_ERR_UNKNOWN;
	}
}

static const struct argp argp = {
    .options = option_list,
    .parser = parse_option,
    .args_doc = "SCENARIO [FILE.csv...] [-- COMMAND...]",
    .doc =
        "Simulated devices, and what to try on them.\v"
        "SCENARIO is a built-in world, `building` or `hall`, in which a robot drives with a sweeping scanner; or "
        "recorded "
        "sweeps that are played through the same devices: uos:DIR (scanNNN.3d with scanNNN.pose beside it) or "
        "profiles:FILE.csv... (with its .pose beside it). Playback is paced by its reader and never skips a line.\n\n"
        "COMMAND runs with FACETD_CONFIG set to the configuration that reaches the devices and FACETD to the address "
        "of the "
        "daemon. Everything ends when either ends. Faults are ordered while it runs at DIR/simulator.sock: a sentence "
        "as "
        "for --fault or `status` a line, or the same as JSON, {\"fault\": \"laser: unplug for 2s\"}; each is answered "
        "with one line. Some that there are (docs/simulators.md has them all):\n\n"
        "  laser:     garbage, silence, stall, corrupt, lost, jitter, power, unplug\n"
        "  servo:     silence, lost, busy, late, fault, stuck, slow, restart (modbus); heartbeat, silent, off, power "
        "cycle, emcy, "
        "fault, stuck, limit, sdo abort, no pdo (canopen); silence, gap, invalid, short, wrong id (can)\n"
        "  can:       bus-off, warning, passive, errors, drop, late, rtr, extended, fd, full, down, deleted\n"
        "  odometry:  silence, slip, blocked, power, gap, invalid\n"
        "  pose:      silence, jump\n\n"
        "  facet simulate building -- build/facetd\n"
        "  facet simulate building --servo canopen --odometry -- build/facetd\n"
        "  facet simulate hall --laser tim --endless --fault 'laser: unplug at 10s for 2s' -- build/facetd",
};

static void refuse(const char *why)
{
	fprintf(stderr, "facet: simulate: %s\n", why);
	exit(2);
}

static void check_can(const struct options *o)
{
	const struct scenario_params params = {.servo = o->servo, .odometry = o->odometry};

	if (*o->can && !scenario_uses_can(&params))
		refuse("--can: nothing here is on a CAN bus; choose a --servo that is, or --odometry");
}

/* What does not go together. */
static void check(const struct options *o)
{
	bool world = scenario_is_world(o->scenario);

	if (world && o->speed != 1.0)
		refuse(
		    "a world moves continuously and the daemon's clock is real: --speed is for recorded sweeps (uos:, "
		    "profiles:)");
	if (!world && o->laser != SCENARIO_LMS2XX)
		refuse("recorded sweeps are played by a LMS2xx, which waits for its reader: --laser is for worlds");
	if (!world && o->servo != SCENARIO_MODBUS && o->servo != SCENARIO_MODBUS_TCP)
		refuse("recorded sweeps are paced by the answers of a servo behind Modbus: other kinds of --servo are "
		       "for worlds");
	if (!world && (o->odometry != SCENARIO_NO_ODOMETRY || o->truth))
		refuse("in recorded sweeps nothing moves by itself: --odometry and --truth are for worlds");
	if (o->sent && o->laser != SCENARIO_LMS2XX)
		refuse("--sent: only the LMS2xx tells when its bytes left");
	if (!world && o->endless)
		refuse("recorded sweeps end: --endless is for worlds");
	if (o->usb && o->laser != SCENARIO_TIM)
		refuse("--usb: only the TiM has a USB port: --laser tim");
	if (o->encoder && o->laser != SCENARIO_LMS1XX && o->laser != SCENARIO_LMS5XX)
		refuse("--encoder: only lms1xx and lms5xx have inputs for one");
	if (o->encoder && o->servo == SCENARIO_FIXED)
		refuse("--encoder: a scanner that is fixed has nothing to count; choose another --servo");
	check_can(o);
}

/* What is behind `--` is COMMAND's and never looked at. */
static void parse(int argc, char **argv, struct options *ret)
{
	int own = 1;

	while (own < argc && strcmp(argv[own], "--") != 0)
		own++;
	*ret = (struct options){.speed = 1.0, .seed = SEED};
	argp_parse(&argp, own, argv, 0, NULL, ret);
	if (own < argc && !argv[own + 1]) {
		fprintf(stderr, "facet: simulate: which COMMAND behind --?\n");
		exit(2);
	}
	if (own < argc)
		ret->command = argv + own + 1;
	check(ret);
}

/* ---- the directory ---- */

static int prepare_dir(struct simulation *s, const char *wanted)
{
	const char *base = getenv("XDG_RUNTIME_DIR");
	char made[PATH_MAX];

	if (wanted && mkdir(wanted, 0755) < 0 && errno != EEXIST)
		return -errno;
	if (wanted)
		return realpath(wanted, s->dir) ? 0 : -errno;
	if (!base || access(base, W_OK) < 0)
		base = getenv("TMPDIR");
	snprintf(made, sizeof made, "%.3000s/facet-XXXXXX", base && access(base, W_OK) == 0 ? base : "/tmp");
	if (!mkdtemp(made) || !realpath(made, s->dir))
		return -errno;
	s->fresh = true;
	return 0;
}

static int remove_entry(const char *path, const struct stat *st, int kind, struct FTW *ftw)
{
	(void)st;
	(void)kind;
	(void)ftw;
	return remove(path);
}

/* ---- ending ---- */

static int64_t now_ms(struct simulation *s)
{
	return (int64_t)uv_now(&s->loop);
}

static bool group_is_gone(const struct simulation *s)
{
	return s->group == 0 || (kill(-s->group, 0) < 0 && errno == ESRCH);
}

static void finish(struct simulation *s)
{
	uv_timer_stop(&s->look);
	s->over = true;
	uv_stop(&s->loop);
}

/* One step further on the way from a polite word to SIGKILL. */
static void press(struct simulation *s)
{
	int64_t waited_ms = now_ms(s) - s->asked_ms;

	if (s->signalled < 1 && s->command) {
		kill(s->command, SIGTERM);
		s->signalled = 1;
	}
	if (s->signalled < 2 && s->group && (!s->command || waited_ms > GRACE_MS / 2)) {
		kill(-s->group, SIGTERM);
		s->signalled = 2;
	}
	if (s->signalled < 3 && s->group && waited_ms > GRACE_MS) {
		kill(-s->group, SIGKILL);
		s->signalled = 3;
	}
}

static void on_look(uv_timer_t *timer)
{
	struct simulation *s = timer->data;

	if (!s->command && group_is_gone(s)) {
		finish(s);
		return;
	}
	press(s);
}

static void begin_ending(struct simulation *s)
{
	if (s->ending)
		return;
	s->ending = true;
	s->asked_ms = now_ms(s);
	uv_timer_stop(&s->after);
	uv_timer_start(&s->look, on_look, 0, LOOK_MS);
}

static void on_signal(uv_signal_t *handle, int number)
{
	struct simulation *s = handle->data;

	if (!s->ending)
		s->status = 128 + number;
	begin_ending(s);
}

static void on_child(uv_signal_t *handle, int number)
{
	struct simulation *s = handle->data;
	int status;
	pid_t pid;

	(void)number;
	while ((pid = waitpid(-1, &status, WNOHANG)) > 0) {
		if (pid != s->command)
			continue; /* an orphan of COMMAND's */
		s->command = 0;
		if (!s->ending)
			s->status = WIFEXITED(status) ? WEXITSTATUS(status) : 128 + WTERMSIG(status);
		begin_ending(s);
	}
}

static void on_after(uv_timer_t *timer)
{
	begin_ending(timer->data);
}

static void on_ended(void *ctx, const char *said)
{
	struct simulation *s = ctx;

	puts(said);
	uv_timer_start(&s->after, on_after, AFTER_MS, 0);
}

/* ---- COMMAND ---- */

static void run_command(const struct simulation *s, char **command, pid_t parent)
{
	char config[PATH_MAX + 16], address[PATH_MAX + 24];
	sigset_t none;

	setpgid(0, 0);
	prctl(PR_SET_PDEATHSIG, SIGTERM);
	if (getppid() != parent)
		_exit(1);
	sigemptyset(&none);
	sigprocmask(SIG_SETMASK, &none, NULL);
	if (isatty(STDIN_FILENO)) { /* a background group must not read the terminal */
		int null = open("/dev/null", O_RDONLY);

		if (null >= 0)
			dup2(null, STDIN_FILENO);
	}
	snprintf(config, sizeof config, "%s/facetd.yaml", s->dir);
	snprintf(address, sizeof address, "unix:%s/facetd.sock", s->dir);
	setenv("FACETD_CONFIG", config, 1);
	setenv("FACETD", address, 1);
	execvp(command[0], command);
	fprintf(stderr, "facet: simulate: %s: %s\n", command[0], strerror(errno));
	_exit(127);
}

static int start_command(struct simulation *s, char **command)
{
	pid_t parent = getpid(), pid = fork();

	if (pid < 0)
		return -errno;
	if (pid == 0)
		run_command(s, command, parent);
	setpgid(pid, pid); /* whoever of the two comes first */
	s->command = s->group = pid;
	return 0;
}

/* ---- the whole ---- */

static int start_loop(struct simulation *s)
{
	int r = uv_loop_init(&s->loop);

	if (r < 0)
		return r;
	uv_signal_init(&s->loop, &s->interrupt);
	uv_signal_init(&s->loop, &s->terminate);
	uv_signal_init(&s->loop, &s->child);
	uv_timer_init(&s->loop, &s->after);
	uv_timer_init(&s->loop, &s->look);
	s->interrupt.data = s->terminate.data = s->child.data = s->after.data = s->look.data = s;
	uv_signal_start(&s->interrupt, on_signal, SIGINT);
	uv_signal_start(&s->terminate, on_signal, SIGTERM);
	uv_signal_start(&s->child, on_child, SIGCHLD);
	signal(SIGPIPE, SIG_IGN);
	prctl(PR_SET_CHILD_SUBREAPER, 1);
	return 0;
}

static void close_handle(uv_handle_t *handle, void *arg)
{
	(void)arg;
	if (!uv_is_closing(handle))
		uv_close(handle, NULL);
}

static void stop_loop(struct simulation *s)
{
	scenario_destroy(s->scenario);
	uv_run(&s->loop, UV_RUN_NOWAIT); /* what the devices closed goes first: it knows how to free itself */
	uv_walk(&s->loop, close_handle, NULL);
	uv_run(&s->loop, UV_RUN_DEFAULT);
	uv_loop_close(&s->loop);
}

static void say_where(const struct simulation *s, const struct options *o)
{
	printf("devices in %s, configuration %s/facetd.yaml\n", s->dir, s->dir);
	printf("address unix:%s/facetd.sock\n", s->dir);
	if (o->tcp)
		printf("address tcp:%s\n", o->tcp);
	if (o->http)
		printf("page http://%s/\n", o->http);
	printf("faults are ordered at %s/simulator.sock\n", s->dir);
}

static void say_status(const struct simulation *s)
{
	char status[SIM_CONTROL_STATUS_MAX];

	scenario_status(s->scenario, status, sizeof status);
	puts(status);
}

static int simulate(struct simulation *s, struct options *o)
{
	struct scenario_params params = {.name = o->scenario,
	                                 .more = o->more,
	                                 .more_n = o->more_n,
	                                 .dir = s->dir,
	                                 .fast = o->fast,
	                                 .servo = o->servo,
	                                 .odometry = o->odometry,
	                                 .can = *o->can ? o->can : NULL,
	                                 .can_config = o->can_config,
	                                 .truth = o->truth,
	                                 .sent = o->sent,
	                                 .laser = o->laser,
	                                 .encoder = o->encoder,
	                                 .usb = o->usb,
	                                 .endless = o->endless,
	                                 .fault = o->fault,
	                                 .faults = o->faults,
	                                 .tcp = o->tcp,
	                                 .http = o->http,
	                                 .seed = o->seed,
	                                 .ctx = s,
	                                 .ended = on_ended};
	char error[SCENARIO_ERROR_MAX] = "";

	s->scenario = scenario_create(&s->loop, &params, error);
	if (!s->scenario) {
		fprintf(stderr, "facet: simulate: %s\n", error);
		return 1;
	}
	say_where(s, o);
	fflush(stdout);
	if (o->command && start_command(s, o->command) < 0) {
		fprintf(stderr, "facet: simulate: %s: %s\n", o->command[0], strerror(errno));
		return 1;
	}
	while (!s->over)
		uv_run(&s->loop, UV_RUN_DEFAULT);
	say_status(s);
	return s->status;
}

int simulate_main(int argc, char **argv)
{
	static struct simulation s;
	struct options o;
	int r;

	parse(argc, argv, &o);
	setvbuf(stdout, NULL, _IOLBF, 0);
	r = prepare_dir(&s, o.dir);
	if (r < 0) {
		fprintf(stderr, "facet: simulate: %s: %s; give a --dir that can be written\n", o.dir ? o.dir : "/tmp",
		        strerror(-r));
		return 1;
	}
	r = start_loop(&s);
	if (r < 0) {
		fprintf(stderr, "facet: simulate: no event loop: %s\n", uv_strerror(r));
		return 1;
	}
	r = simulate(&s, &o);
	stop_loop(&s);
	if (s.fresh)
		nftw(s.dir, remove_entry, 8, FTW_DEPTH | FTW_PHYS);
	return r;
}
