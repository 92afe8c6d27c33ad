/* `facet watch`: asks a daemon for its status once a second and shows it: a table that is drawn over itself on a
 * terminal, a line a second in a pipe. It only reads JSON lines, so watching costs the daemon nothing but that.
 *
 * The terminal is borrowed: a second screen and a hidden cursor, given back on every way out. Signals only set a flag and
 * wake the wait between two questions. A daemon that goes away is asked again every second. */
#include <argp.h>
#include <errno.h>
#include <poll.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/ioctl.h>
#include <time.h>
#include <unistd.h>

#include <jansson.h>

#include "config/address.h"
#include "tools/client.h"
#include "tools/commands.h"

#define ANSWER_MS  2000
#define CONNECT_MS 2000
#define COLUMNS    100 /* where nobody knows */
#define DEGREES    57.29577951308232
#define FOLD       4    /* the indentation of what did not fit into a line */
#define OTHERS_MAX 2000 /* lines that may stand before an answer */

enum { OPTION_ONCE = 256, OPTION_JSON };

struct watch {
	const char *address;
	bool once, json, terminal;
	bool told; /* that events are wanted, on this connection */
	struct client *client;
	char lost[CLIENT_ERROR_MAX]; /* why there is no client; empty: not said yet */
};

static volatile sig_atomic_t stopped;

static void stop(int number)
{
	(void)number;
	stopped = 1;
}

/* Figures -------------------------------------------------------------------------------------------------------- */

static json_t *member(json_t *root, const char *path)
{
	char name[64];
	while (root && *path) {
		const size_t n = strcspn(path, ".");
		snprintf(name, sizeof(name), "%.*s", (int)n, path);
		root = json_object_get(root, name);
		path += n + (path[n] == '.');
	}
	return root;
}

static double number(json_t *root, const char *path)
{
	return json_number_value(member(root, path));
}

static const char *string(json_t *root, const char *path)
{
	const char *text = json_string_value(member(root, path));
	return text ? text : "";
}

/* 1234567 as 1,234,567. Several at once in one printf, so there are several places to put them. */
static const char *grouped(double value)
{
	static char text[8][32];
	static int next;
	char digits[24];
	char *out = text[next = (next + 1) % 8];
	const int n = snprintf(digits, sizeof(digits), "%.0f", value < 0 || value > 1e15 ? 0 : value);
	int at = 0;
	for (int i = 0; i < n; i++) {
		if (i && (n - i) % 3 == 0)
			out[at++] = ',';
		out[at++] = digits[i];
	}
	out[at] = '\0';
	return out;
}

/* Members that are not zero, as `, name value`; at most a line of them. */
static void put_counts(FILE *out, json_t *counts, const char *between)
{
	const char *name;
	json_t *value;
	json_object_foreach(counts, name, value) if (json_number_value(value) > 0)
	{
		fprintf(out, "%s%.40s %s", between, name, grouped(json_number_value(value)));
		between = ", ";
	}
}

static double reduction_percent(json_t *status)
{
	const double raw = number(status, "map_size.triangles_raw"), reduced = number(status, "map_size.triangles");
	return raw > 0 ? 100 * (1 - reduced / raw) : 0;
}

/* The table ------------------------------------------------------------------------------------------------------- */

#define SILENT_S 3.0 /* nothing came for so long: whatever its state, it does not stream */

static bool is_silent(json_t *device)
{
	return number(device, "silent") >= SILENT_S;
}

static const char *state_of(json_t *device)
{
	const bool fixed = json_is_null(member(device, "silent")) && strcmp(string(device, "state"), "streaming") == 0;
	return is_silent(device) ? "silent" : fixed ? "fixed" : string(device, "state");
}

/* What is not as it should be, one thing a line. */
static void put_complaints(FILE *out, json_t *device)
{
	if (string(device, "error")[0])
		fprintf(out, "  %.160s\n", string(device, "error"));
	if (string(device, "note")[0])
		fprintf(out, "  %.330s\n", string(device, "note"));
	if (is_silent(device) && number(device, "records") > 0)
		fprintf(out, "  nothing came for %.0f s\n", number(device, "silent"));
	else if (is_silent(device))
		fprintf(out, "  it is open, and nothing came yet: is anybody sending?\n");
}

/* Its clock against ours, and what became of its telegrams, by reason. */
static void put_details(FILE *out, json_t *device)
{
	const bool stamps = member(device, "timing.drift_ppm") != NULL;
	const char *name;
	json_t *value;
	bool counted = false;
	if (stamps)
		fprintf(out, "  clock %+.1f ppm, offset %.6f s", number(device, "timing.drift_ppm"),
		        number(device, "timing.offset"));
	json_object_foreach(member(device, "counters"), name, value) counted |= json_number_value(value) > 0;
	if (counted)
		put_counts(out, member(device, "counters"), stamps ? "; " : "  ");
	if (stamps || counted)
		fputc('\n', out);
	if (member(device, "sigma.position"))
		fprintf(out, "  place within %.3f m, heading within %.2f degrees (sigma); jumps %s\n",
		        number(device, "sigma.position"), number(device, "sigma.heading") * DEGREES,
		        grouped(number(device, "jumps")));
}

static void put_device(FILE *out, json_t *device)
{
	char rate[32], jitter[32] = "-", lost[32] = "-";
	const double expected = number(device, "timing.expected");
	const int n = snprintf(rate, sizeof(rate), "%.1f", number(device, "rate"));
	if (expected > 0)
		snprintf(rate + n, sizeof(rate) - (size_t)n, " of %.1f", expected);
	if (member(device, "timing.jitter_ms"))
		snprintf(jitter, sizeof(jitter), "%.2f/%.2f", number(device, "timing.jitter_ms.p50"),
		         number(device, "timing.jitter_ms.p99"));
	if (member(device, "timing.drift_ppm"))
		snprintf(lost, sizeof(lost), "%s", grouped(number(device, "timing.lost")));
	fprintf(out, "%-11.31s %-6.12s %-11.16s %14s %16s %6s %9s\n", string(device, "name"), string(device, "driver"),
	        state_of(device), rate, jitter, lost, grouped(number(device, "records")));
	put_complaints(out, device);
	put_details(out, device);
}

static void put_devices(FILE *out, json_t *status)
{
	size_t i;
	json_t *device;
	fprintf(out, "%-11s %-6s %-11s %14s %16s %6s %9s\n", "DEVICE", "DRIVER", "STATE", "RATE Hz", "JITTER ms p50/99",
	        "LOST", "RECORDS");
	json_array_foreach(member(status, "devices"), i, device) put_device(out, device);
}

static void put_map(FILE *out, json_t *status)
{
	const double mb = 1048576;
	fprintf(out, "rows       %s applied, %s not applied, %.1f a second", grouped(number(status, "rows.applied")),
	        grouped(number(status, "rows.not_applied")), number(status, "rows.rate"));
	put_counts(out, member(status, "rows.dropped"), "; dropped: ");
	fprintf(out, "\nmap        step %s, cell %g cm, %s patches in %s blocks%s\n", grouped(number(status, "step")),
	        100 * number(status, "cell"), grouped(number(status, "map_size.patches")),
	        grouped(number(status, "map_size.blocks")), json_is_true(member(status, "paused")) ? ", PAUSED" : "");
	fprintf(out, "triangles  %s raw, %s reduced (%.1f %% fewer)\n",
	        grouped(number(status, "map_size.triangles_raw")), grouped(number(status, "map_size.triangles")),
	        reduction_percent(status));
	fprintf(out, "memory     %.1f of %.0f MB", number(status, "memory.used") / mb,
	        number(status, "memory.cap") / mb);
	if (number(status, "memory.refused_blocks") > 0)
		fprintf(out, ", FULL: %s blocks refused", grouped(number(status, "memory.refused_blocks")));
	fprintf(out, "\nqueue      %s of %s rows\n", grouped(number(status, "queue.length")),
	        grouped(number(status, "queue.cap")));
	fprintf(out, "latency    p50 %.1f ms, p99 %.1f ms from a profile's last byte until its changes can be sent\n",
	        number(status, "latency_ms.p50"), number(status, "latency_ms.p99"));
}

static void put_clients(FILE *out, json_t *status)
{
	size_t i;
	json_t *client;
	fprintf(out, "clients    %zu\n", json_array_size(member(status, "clients")));
	json_array_foreach(member(status, "clients"), i, client)
	{
		fprintf(out, "  %-8.16s %.80s", string(client, "kind"), string(client, "address"));
		if (strcmp(string(client, "kind"), "native") == 0)
			fprintf(out, ", step %s", grouped(number(client, "step")));
		if (number(client, "behind") > 0)
			fprintf(out, ", %s behind", grouped(number(client, "behind")));
		if (number(client, "aborts") > 0)
			fprintf(out, ", %s batches given up", grouped(number(client, "aborts")));
		fprintf(out, ", %.1f MB\n", number(client, "bytes") / 1e6);
	}
}

static void put_table(FILE *out, const struct watch *watch, json_t *status)
{
	const int up = (int)number(status, "uptime");
	fprintf(out, "facetd %s at %s, map %.8s generation %.0f, up %d:%02d:%02d\n\n", string(status, "version"),
	        client_address(watch->client), string(status, "map"), number(status, "generation"), up / 3600,
	        up / 60 % 60, up % 60);
	put_devices(out, status);
	fputc('\n', out);
	put_map(out, status);
	put_clients(out, status);
}

/* One line for logs and pipes. */
static void put_line(FILE *out, json_t *status)
{
	size_t i;
	json_t *device;
	fprintf(out, "step %.0f patches %.0f triangles %.0f of %.0f memory %.1fMB latency %.1f/%.1fms clients %zu",
	        number(status, "step"), number(status, "map_size.patches"), number(status, "map_size.triangles"),
	        number(status, "map_size.triangles_raw"), number(status, "memory.used") / 1048576,
	        number(status, "latency_ms.p50"), number(status, "latency_ms.p99"),
	        json_array_size(member(status, "clients")));
	json_array_foreach(member(status, "devices"), i, device)
	    fprintf(out, " %.31s:%.16s:%.1fHz", string(device, "name"), state_of(device), number(device, "rate"));
	fputc('\n', out);
}

/* The terminal ----------------------------------------------------------------------------------------------------- */

static void terminal_begin(const struct watch *watch)
{
	if (watch->terminal)
		fputs("\033[?1049h\033[?25l", stdout);
}

static void terminal_end(const struct watch *watch)
{
	if (watch->terminal) {
		fputs("\033[?25h\033[?1049l", stdout);
		fflush(stdout);
	}
}

static void terminal_size(int *ret_columns, int *ret_rows)
{
	struct winsize size;
	const bool known = ioctl(STDOUT_FILENO, TIOCGWINSZ, &size) == 0 && size.ws_col > 0 && size.ws_row > 1;
	*ret_columns = known ? size.ws_col : COLUMNS;
	*ret_rows = known ? size.ws_row : 24;
}

/* How much of a line fits: what is longer goes on in the next one, from a blank on where there is one. */
static int fitting(const char *text, int len, int width)
{
	if (len <= width)
		return len;
	for (int i = width; i > width / 2; i--)
		if (text[i] == ' ')
			return i;
	return width;
}

/* Bytes that could steer the terminal are left out. The edge itself stays free: not every terminal clears behind it. */
static void terminal_line(const char *text, int len, int indent)
{
	fprintf(stdout, "%*s", indent, "");
	for (int i = 0; i < len; i++)
		fputc((unsigned char)text[i] < ' ' || text[i] == 127 ? '?' : text[i], stdout);
	fputs("\033[K\n", stdout);
}

/* Draws over what is there, folded at the right edge and cut at the lower one. */
static void terminal_draw(const char *text)
{
	int columns, rows, indent = 0;
	terminal_size(&columns, &rows);
	fputs("\033[H", stdout);
	for (int row = 1; *text && row < rows; row++) {
		const int len = (int)strcspn(text, "\n");
		const int n = fitting(text, len, columns - 1 > indent ? columns - 1 - indent : 1);
		terminal_line(text, n, indent);
		indent = n < len && columns > 4 * FOLD ? FOLD : 0;
		text += n;
		text += n < len ? *text == ' ' : *text == '\n';
	}
	fputs("\033[J", stdout);
	fflush(stdout);
}

/* The loop --------------------------------------------------------------------------------------------------------- */

static void show_status(const struct watch *watch, const char *line, json_t *status)
{
	char *text = NULL;
	size_t len;
	if (watch->json) {
		puts(line);
		fflush(stdout);
		return;
	}
	FILE *out = open_memstream(&text, &len);
	if (!out)
		return;
	if (watch->terminal || watch->once)
		put_table(out, watch, status);
	else
		put_line(out, status);
	fclose(out);
	if (watch->terminal)
		terminal_draw(text);
	else
		fputs(text, stdout);
	free(text);
	fflush(stdout);
}

/* Says once why there is nothing to show. */
static void show_loss(struct watch *watch, const char *why)
{
	char text[CLIENT_ERROR_MAX + 64];
	if (watch->client) {
		client_close(watch->client);
		watch->client = NULL;
		watch->told = false;
	}
	if (strcmp(watch->lost, why) == 0)
		return;
	snprintf(watch->lost, sizeof(watch->lost), "%s", why);
	if (watch->terminal) {
		const int first = (int)strcspn(why, ";"); /* what to do stands in a line of its own */
		snprintf(text, sizeof(text), "%.*s\n%s\n\nTrying again every second; Ctrl-C ends.\n", first, why,
		         why[first] ? why + first + 2 : "");
		terminal_draw(text);
	} else {
		fprintf(stderr, "facet: %s%s\n", why, watch->once ? "" : "; trying again every second");
	}
}

/* As JSON, and for longer than one answer, events are shown as they come: between two answers they wait in the socket. */
static bool shows_events(const struct watch *watch)
{
	return watch->json && !watch->once;
}

static bool is_event(const char *class)
{
	static const char *const events[] = {"DEVICE", "CLOCK", "JUMP", "MAP", "SAVED"};
	for (size_t i = 0; i < sizeof(events) / sizeof(events[0]); i++)
		if (strcmp(class, events[i]) == 0)
			return true;
	return false;
}

/* The next line that is a status or an error; a greeting and events may stand before it. NULL with a sentence. */
static json_t *read_answer(struct watch *watch, const char **ret_line, char error[CLIENT_ERROR_MAX])
{
	for (int i = 0; i < OTHERS_MAX; i++) {
		const int status = client_line(watch->client, ANSWER_MS, ret_line, error);
		if (status == 0)
			snprintf(error, CLIENT_ERROR_MAX, "%s: no answer within %d s", client_address(watch->client),
			         ANSWER_MS / 1000);
		if (status <= 0)
			return NULL;
		json_t *json = json_loads(*ret_line, 0, NULL);
		const char *class = string(json, "class");
		if (strcmp(class, "STATUS") == 0)
			return json;
		if (strcmp(class, "ERROR") == 0 || !class[0]) {
			const char *why = string(json, "error");
			snprintf(error, CLIENT_ERROR_MAX, "%s: %s", client_address(watch->client),
			         why[0] ? why : "what answers there is not facetd");
			json_decref(json);
			return NULL;
		}
		if (shows_events(watch) && is_event(class)) {
			puts(*ret_line);
			fflush(stdout);
		}
		json_decref(json);
	}
	snprintf(error, CLIENT_ERROR_MAX, "%s: no status among many answers", client_address(watch->client));
	return NULL;
}

/* Asks and shows. 0, or -errno with a sentence. */
static int ask(struct watch *watch, char error[CLIENT_ERROR_MAX])
{
	const char *line;
	if (!watch->client)
		watch->client = client_open(watch->address, CONNECT_MS, error);
	if (!watch->client)
		return -ENOTCONN;
	/* Who watches is told every second without asking: asked for as well, answers would gather in the socket. */
	if (shows_events(watch) && !watch->told && client_say(watch->client, "?WATCH={\"enable\":true}", error))
		return -ENOTCONN;
	const int status = shows_events(watch) && watch->told ? 0 : client_say(watch->client, "?STATUS", error);
	if (status)
		return status;
	watch->told = true;
	json_t *json = read_answer(watch, &line, error);
	if (!json)
		return -EPROTO;
	watch->lost[0] = '\0';
	show_status(watch, line, json);
	json_decref(json);
	return 0;
}

static void wait_until(struct timespec *next, const sigset_t *mask)
{
	struct timespec now;
	clock_gettime(CLOCK_MONOTONIC, &now);
	if (now.tv_sec > next->tv_sec + 1) /* the machine slept: no burst of questions afterwards */
		*next = now;
	struct timespec left = {next->tv_sec - now.tv_sec, next->tv_nsec - now.tv_nsec};
	if (left.tv_nsec < 0) {
		left.tv_sec--;
		left.tv_nsec += 1000000000;
	}
	if (left.tv_sec < 0)
		left = (struct timespec){0};
	ppoll(NULL, 0, &left, mask);
}

static int run(struct watch *watch)
{
	char error[CLIENT_ERROR_MAX];
	struct sigaction action = {.sa_handler = stop};
	sigset_t signals, before;
	struct timespec next;
	int status = 0;
	sigemptyset(&signals);
	sigaddset(&signals, SIGINT);
	sigaddset(&signals, SIGTERM);
	sigaction(SIGINT, &action, NULL);
	sigaction(SIGTERM, &action, NULL);
	action.sa_handler = SIG_IGN;
	sigaction(SIGPIPE, &action, NULL);
	sigprocmask(SIG_BLOCK, &signals, &before);
	clock_gettime(CLOCK_MONOTONIC, &next);
	terminal_begin(watch);
	do {
		status = ask(watch, error);
		if (status)
			show_loss(watch, error);
		if (watch->once || ferror(stdout))
			break;
		if (shows_events(watch) && !status)
			clock_gettime(CLOCK_MONOTONIC, &next); /* the daemon has the pace */
		else
			next.tv_sec++;
		wait_until(&next, &before); /* the only place where signals come through */
	} while (!stopped);
	terminal_end(watch);
	return watch->once && status ? 1 : 0;
}

static error_t parse_option(int key, char *arg, struct argp_state *state)
{
	struct watch *watch = state->input;
	switch (key) {
	case OPTION_ONCE:
		watch->once = true;
		return 0;
	case OPTION_JSON:
		watch->json = true;
		return 0;
	case ARGP_KEY_ARG:
		if (watch->address)
			argp_error(state, "one daemon is watched at a time; '%s' is the second", arg);
		watch->address = arg;
		return 0;
	default:
		return ARGP_ERR_UNKNOWN;
	}
}

int watch_main(int argc, char **argv)
{
	static const struct argp_option options[] = {
	    {"once", OPTION_ONCE, NULL, 0, "show it once; status 1 where no daemon answers", 0},
	    {"json", OPTION_JSON, NULL, 0, "the status as JSON, one line a second, and events as they come", 0},
	    {0}};
	static const struct argp argp = {
	    options,
	    parse_option,
	    "[ADDRESS]",
	    "What a running daemon does, live.\v"
	    "ADDRESS is unix:PATH, tcp:HOST:PORT or ws://HOST:PORT/; default: $FACETD, the user's own socket, "
	    "the system's.\n\n"
	    "RATE is what came a second, of what the device says it measures; JITTER how far arrivals are behind the "
	    "least "
	    "delayed ones (median, 99 %); LOST what the device counted and nobody received, - where it does not count. "
	    "Under "
	    "a device: why it does not stream, what is not as it was wanted, its clock against ours (+ runs fast), and "
	    "what "
	    "became of its telegrams, by reason.",
	    NULL,
	    NULL,
	    NULL};
	struct watch watch = {0};
	struct address address;
	char sentence[ADDRESS_ERROR_MAX];
	argp_parse(&argp, argc, argv, 0, NULL, &watch);
	if (watch.address &&
	    address_parse(watch.address, ADDRESS_UNIX | ADDRESS_TCP | ADDRESS_WS, &address, sentence)) {
		fprintf(stderr, "facet: %s\n", sentence);
		return 2;
	}
	watch.terminal = isatty(STDOUT_FILENO) && !watch.once && !watch.json;
	const int status = run(&watch);
	client_close(watch.client);
	return status;
}
