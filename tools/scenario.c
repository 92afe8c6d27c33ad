/* Joins simulated devices and a stage: the scanner on DIR/laser (or on TCP), the servo on DIR/servo (or on TCP, or on a CAN
 * bus: scenario_motion.c), poses at 100 Hz to DIR/pose.sock (at 1 Hz where the wheels tell the motion), and
 * DIR/facetd.yaml, which reaches them all and lets the daemon listen on DIR/facetd.sock. Faults are ordered at
 * DIR/simulator.sock.
 *
 * A pose goes out with the time it is true for, in CLOCK_REALTIME as it is then, as any localisation would stamp it: a
 * wall clock that is set is followed. A datagram that nobody takes (no daemon yet, its queue full) is not sent again: the
 * next one is newer. */
#include "tools/scenario.h"

#include <errno.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <sys/un.h>
#include <unistd.h>

#include "config/address.h"
#include "core/trig.h"
#include "daemon/wall_clock.h"
#include "drivers/pose_line.h"
#include "tools/output.h"
#include "tools/scenario_motion.h"
#include "tools/scenario_sent.h"
#include "tools/scenario_truth.h"
#include "tools/sim_control.h"
#include "tools/sim_gadget.h"

#define POSE_MS  10
#define RARE_NS  INT64_C(1000000000) /* between poses beside an odometry */
#define JUMP_M   0.5
#define LASER_BD 9600 /* as from the factory */
#define MODE_15  0x05

/* Of scanners with CoLa. */
static const enum sim_cola_model_id models[SCENARIO_LASERS] = {[SCENARIO_LMS2XX] = SIM_COLA_MODELS,
                                                               [SCENARIO_TIM] = SIM_TIM571,
                                                               [SCENARIO_LMS1XX] = SIM_LMS111,
                                                               [SCENARIO_LMS5XX] = SIM_LMS511};

struct scenario {
	struct scenario_params params;
	struct stage stage;
	struct scenario_motion *motion;
	struct scenario_truth *truth; /* NULL: not asked for */
	struct scenario_sent *sent;   /* likewise */
	struct sim_device laser;      /* the shell's; to be asked what it did */
	struct sim_pty *laser_pty;
	struct sim_tcp *laser_tcp;
	struct sim_gadget *laser_usb;
	struct sim_control *control;
	struct fault_target target[2 + SCENARIO_MOTION_TARGETS];
	bool mute;       /* a fault: poses are not sent */
	double jump_m;   /* another: they are so far off, along x */
	int64_t pose_ns; /* the next one is due */
	uv_timer_t *timer;
	int pose_fd;
	struct sockaddr_un pose_address;
	int64_t realtime_ns; /* CLOCK_REALTIME - CLOCK_MONOTONIC, as it was seen last */
	bool ended;
};

bool scenario_is_world(const char *name)
{
	return strncmp(name, "uos:", 4) != 0 && strncmp(name, "profiles:", 9) != 0;
}

/* ---- the configuration ---- */

static int write_yaml(const struct scenario *s, char error[SCENARIO_ERROR_MAX])
{
	char yaml[SCENARIO_YAML_MAX], path[128];
	struct output_error why;
	int n = scenario_yaml(&s->params, s->stage.sweeps, scenario_motion_port(s->motion),
	                      s->laser_tcp ? sim_tcp_port(s->laser_tcp) : 0, yaml, sizeof yaml);

	if (n < 0) {
		snprintf(error, SCENARIO_ERROR_MAX, "the configuration has no room for these names");
		return n;
	}
	snprintf(path, sizeof path, "%.110s/facetd.yaml", s->params.dir);
	n = output_write(path, yaml, (size_t)n, &why);
	if (n < 0)
		snprintf(error, SCENARIO_ERROR_MAX, "%.290s", why.text);
	return n;
}

/* ---- running ---- */

static void send_pose(struct scenario *s, int64_t now_ns)
{
	struct pose pose = s->stage.pose(s->stage.ctx, now_ns);
	char line[POSE_LINE_MAX];
	int n;

	pose.t_ns = now_ns + s->realtime_ns;
	pose.position_m.x += s->jump_m;
	n = pose_line_print(&pose, line, sizeof line);
	if (n > 0 &&
	    sendto(s->pose_fd, line, (size_t)n, MSG_DONTWAIT | MSG_NOSIGNAL, (struct sockaddr *)&s->pose_address,
	           sizeof s->pose_address) == n &&
	    s->stage.pose_sent)
		s->stage.pose_sent(s->stage.ctx);
}

static void on_timer(uv_timer_t *timer)
{
	struct scenario *s = timer->data;
	int64_t now_ns = wall_clock_read(CLOCK_MONOTONIC);
	struct stage_axis axis = scenario_motion_axis(s->motion);
	int64_t offset_ns;
	char said[80];

	if (wall_clock_offset(&offset_ns))
		s->realtime_ns = offset_ns;
	if (now_ns >= s->pose_ns && !s->mute)
		send_pose(s, now_ns);
	if (now_ns >= s->pose_ns)
		s->pose_ns = s->params.odometry == SCENARIO_NO_ODOMETRY ? now_ns : now_ns + RARE_NS;
	if (s->truth)
		scenario_truth_write(s->truth, &axis, &s->stage, now_ns, s->realtime_ns);
	if (s->ended || !s->stage.ended(s->stage.ctx, now_ns, said))
		return;
	s->ended = true;
	s->params.ended(s->params.ctx, said);
}

static int create_brain(struct scenario *s)
{
	const struct sim_lms2xx_params lms = {
	    .fast = s->params.fast, .baud = LASER_BD, .mode = MODE_15, .millimetres = true};
	const struct stage_axis axis = scenario_motion_axis(s->motion);
	const struct sim_cola_params cola = {.model = models[s->params.laser],
	                                     .segments = !s->params.usb,
	                                     .ticks_per_rad = 1.0 / (SCENARIO_TICK_DEG * TRIG_DEG),
	                                     .angle = s->params.encoder ? axis.angle : NULL,
	                                     .ctx = axis.ctx};
	int64_t now_ns = wall_clock_read(CLOCK_MONOTONIC);

	return s->params.laser == SCENARIO_LMS2XX ? sim_lms2xx_create(&lms, &s->stage.scene, now_ns, &s->laser)
	                                          : sim_cola_create(&cola, &s->stage.scene, now_ns, &s->laser);
}

static int start_laser(struct scenario *s, uv_loop_t *loop, char error[SCENARIO_ERROR_MAX])
{
	const struct sim_gadget_params usb = {
	    .name = "facet", .serial = "1", .title = s->params.usb ? sim_cola_model_name(models[s->params.laser]) : ""};
	char link[128];

	if (create_brain(s) < 0) {
		snprintf(error, SCENARIO_ERROR_MAX, "out of memory");
		return -ENOMEM;
	}
	snprintf(link, sizeof link, "%.110s/laser", s->params.dir);
	if (s->params.laser == SCENARIO_LMS2XX)
		s->laser_pty = sim_pty_create(loop, link, &s->laser, error);
	else if (s->params.usb)
		s->laser_usb = sim_gadget_create(loop, &s->laser, &usb, error);
	else
		s->laser_tcp = sim_tcp_create(loop, 0, &s->laser, error);
	if (s->sent && s->laser_pty)
		sim_pty_watch(s->laser_pty, scenario_sent_note, scenario_sent_of(s->sent, &s->laser));
	return s->laser_pty || s->laser_tcp || s->laser_usb ? 0 : -EIO;
}

static int start_devices(struct scenario *s, uv_loop_t *loop, char error[SCENARIO_ERROR_MAX])
{
	struct stage_axis axis;

	s->motion = scenario_motion_create(loop, &s->params, &s->stage, error);
	if (!s->motion)
		return -EIO;
	axis = scenario_motion_axis(s->motion);
	s->stage.join(s->stage.ctx, &axis, scenario_motion_servo(s->motion));
	if (s->params.truth)
		s->truth = scenario_truth_create(s->params.truth, wall_clock_read(CLOCK_MONOTONIC), error);
	if (s->params.sent)
		s->sent = scenario_sent_create(s->params.sent, &s->stage.scene, error);
	if ((s->params.truth && !s->truth) || (s->params.sent && !s->sent))
		return -EIO;
	return start_laser(s, loop, error);
}

/* ---- faults ---- */

static const char *const pose_kinds[] = {"silence", "jump", NULL};

static void order_poses(struct scenario *s, const struct sim_fault *fault, bool on)
{
	double by_m = fault->value != 0.0 ? fault->value : JUMP_M;

	if (!strcmp(fault->kind, "silence"))
		s->mute = on;
	else
		s->jump_m += on ? by_m : -by_m;
}

static bool order(void *ctx, const struct sim_fault *fault, bool on)
{
	struct scenario *s = ctx;

	if (!strcmp(fault->device, "pose"))
		order_poses(s, fault, on);
	else if (strcmp(fault->device, "laser") != 0)
		return scenario_motion_fault(s->motion, fault, on);
	else if (s->laser_pty)
		return sim_pty_fault(s->laser_pty, fault, on);
	else if (s->laser_usb)
		return sim_gadget_fault(s->laser_usb, fault, on);
	else
		return sim_tcp_fault(s->laser_tcp, fault, on);
	return true;
}

void scenario_status(const struct scenario *s, char *ret, size_t cap)
{
	struct sim_counts counts;
	size_t n = (size_t)snprintf(ret, cap, "laser: ");

	s->laser.counts(s->laser.ctx, &counts);
	fault_print_counts(&counts, ret + n, cap - n);
	n = strlen(ret);
	scenario_motion_status(s->motion, wall_clock_read(CLOCK_MONOTONIC), ret + n, cap - n);
}

static void print_status(void *ctx, char ret[SIM_CONTROL_STATUS_MAX])
{
	scenario_status(ctx, ret, SIM_CONTROL_STATUS_MAX);
}

static int start_control(struct scenario *s, uv_loop_t *loop, char error[SCENARIO_ERROR_MAX])
{
	char path[128], why[FAULT_ERROR_MAX];
	struct sim_control_params params = {
	    .socket = path, .target = s->target, .ctx = s, .order = order, .status = print_status};
	int r = 0, n = 0;

	const char *const *shell = s->laser_pty   ? sim_pty_fault_kinds()
	                           : s->laser_usb ? sim_gadget_fault_kinds()
	                                          : sim_tcp_fault_kinds();
	s->target[n++] = (struct fault_target){"laser", {s->laser.fault_kinds, shell}};
	n += scenario_motion_targets(s->motion, s->target + n);
	s->target[n++] = (struct fault_target){"pose", {pose_kinds, NULL}};
	params.targets = n;
	snprintf(path, sizeof path, "%.110s/simulator.sock", s->params.dir);
	s->control = sim_control_create(loop, &params, why);
	for (int i = 0; s->control && !r && i < s->params.faults; i++)
		r = sim_control_order(s->control, s->params.fault[i], why);
	if (s->control && !r)
		return 0;
	snprintf(error, SCENARIO_ERROR_MAX, "%s%.*s", r ? "--fault " : "", SCENARIO_ERROR_MAX - 20, why);
	return -EINVAL;
}

static int start_poses(struct scenario *s, uv_loop_t *loop, char error[SCENARIO_ERROR_MAX])
{
	s->pose_address.sun_family = AF_UNIX;
	snprintf(s->pose_address.sun_path, sizeof s->pose_address.sun_path, "%.90s/pose.sock", s->params.dir);
	s->pose_fd = socket(AF_UNIX, SOCK_DGRAM | SOCK_CLOEXEC, 0);
	s->timer = malloc(sizeof *s->timer);
	if (s->pose_fd < 0 || !s->timer) {
		snprintf(error, SCENARIO_ERROR_MAX, "no socket for the poses: %s", strerror(errno));
		return -EIO;
	}
	s->realtime_ns = wall_clock_first_offset();
	uv_timer_init(loop, s->timer);
	s->timer->data = s;
	uv_timer_start(s->timer, on_timer, 0, POSE_MS);
	return 0;
}

/* Paths end up in a YAML file and in sockets. */
static int check_dir(const char *dir, char error[SCENARIO_ERROR_MAX])
{
	if (strlen(dir) + strlen("/simulator.sock") >= ADDRESS_PATH_MAX) {
		snprintf(error, SCENARIO_ERROR_MAX,
		         "%.120s...: too long for a directory with sockets (their paths have less than %d bytes); give "
		         "a shorter --dir",
		         dir, ADDRESS_PATH_MAX);
		return -ENAMETOOLONG;
	}
	for (const char *c = dir; *c; c++)
		if ((unsigned char)*c < ' ' || *c == '"' || *c == '\\') {
			snprintf(
			    error, SCENARIO_ERROR_MAX,
			    "%.100s: a directory with quotes or control characters in its name; give another --dir",
			    dir);
			return -EINVAL;
		}
	return 0;
}

static int create_stage(const struct scenario_params *params, struct stage *ret, char error[SCENARIO_ERROR_MAX])
{
	int r;

	if (!scenario_is_world(params->name))
		return playback_stage(params->name, params->more, params->more_n, ret, error);
	r = drive_stage(params->name, params->seed, ret, error);
	if (!r && params->endless)
		drive_endless(ret);
	return r;
}

struct scenario *scenario_create(uv_loop_t *loop, const struct scenario_params *params, char error[SCENARIO_ERROR_MAX])
{
	struct scenario *s = calloc(1, sizeof *s);
	int r;

	if (!s) {
		snprintf(error, SCENARIO_ERROR_MAX, "out of memory");
		return NULL;
	}
	s->params = *params;
	s->pose_fd = -1;
	r = check_dir(params->dir, error);
	if (!r)
		r = create_stage(params, &s->stage, error);
	if (!r)
		r = start_devices(s, loop, error);
	if (!r)
		r = start_control(s, loop, error);
	if (!r)
		r = start_poses(s, loop, error);
	if (!r)
		r = write_yaml(s, error);
	if (!r)
		return s;
	scenario_destroy(s);
	return NULL;
}

static void free_handle(uv_handle_t *handle)
{
	free(handle);
}

void scenario_destroy(struct scenario *s)
{
	if (!s)
		return;
	if (s->timer && s->timer->data)
		uv_close((uv_handle_t *)s->timer, free_handle);
	else
		free(s->timer);
	sim_control_destroy(s->control);
	if (s->laser_pty)
		sim_pty_destroy(s->laser_pty);
	if (s->laser_tcp)
		sim_tcp_destroy(s->laser_tcp);
	if (s->laser_usb)
		sim_gadget_destroy(s->laser_usb);
	scenario_motion_destroy(s->motion);
	scenario_truth_destroy(s->truth);
	scenario_sent_destroy(s->sent);
	if (s->stage.destroy)
		s->stage.destroy(s->stage.ctx);
	if (s->pose_fd >= 0)
		close(s->pose_fd);
	free(s);
}
