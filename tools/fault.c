/* Sentences that order faults, and their plan (fault.h). The words between the colon and `at` or `for` are the kind, but for
 * a number at their end, which is its value. */
#include "tools/fault.h"

#include <ctype.h>
#include <errno.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "config/units.h"

#define WORDS_MAX 16

/* Without a duration the others happen once, to what comes next, or are settings that stay. */
static const struct {
	const char *kind;
	int64_t for_ns;
} durations[] = {{"unplug", 1000000000},  {"garbage", 1000000000}, {"silence", 1000000000},   {"stall", 1000000000},
                 {"refuse", 1000000000},  {"timeout", 1000000000}, {"busy", 1000000000},      {"error", 1000000000},
                 {"split", INT64_MAX},    {"jitter", INT64_MAX},   {"wander", INT64_MAX},     {"drift", INT64_MAX},
                 {"bus-off", 1000000000}, {"warning", 1000000000}, {"passive", 1000000000},   {"errors", 1000000000},
                 {"full", 1000000000},    {"down", 1000000000},    {"deleted", 1000000000},   {"frozen", 1000000000},
                 {"off", 1000000000},     {"silent", 1000000000},  {"heartbeat", 1000000000}, {"no pdo", 1000000000},
                 {"stuck", 1000000000},   {"rtr", INT64_MAX},      {"extended", INT64_MAX},   {"fd", INT64_MAX},
                 {"slip", INT64_MAX},     {"blocked", INT64_MAX},  {"slow", INT64_MAX}};

/* What a value may be; kinds that are not here take any, or none. A value of 0 is one that was not given. */
static const struct {
	const char *kind;
	double min, max;
} bounds[] = {{"corrupt", 0, 1},       {"crc", 0, 1},
              {"lost", 0, 1},          {"duplicate", 0, 1},
              {"merge", 1, 100},       {"gap", 0, 10000},
              {"jitter", 0, 10000},    {"late", 0, 10000},
              {"wander", 0, 10},       {"drift", -100000, 100000},
              {"sfa", 1, 26},          {"baud", 9600, 500000},
              {"mode", 0, 15},         {"permanent baud", 9600, 500000},
              {"encoders", 1, 3},      {"echoes", 1, 5},
              {"scale", 0.001, 1000},  {"clock step", -4294, 4294},
              {"clock wrap", 0, 4294}, {"counter wrap", 0, 65535},
              {"drop", 0, 1},          {"errors", 1, 100000},
              {"slip", -1, 10},        {"slow", 0, 1},
              {"jump", -1000, 1000},   {"power cycle", 0, 1000},
              {"emcy", 0, 65535},      {"fault", 0, 65535}};

static int refuse(char error[FAULT_ERROR_MAX], const char *text, const char *why)
{
	snprintf(error, FAULT_ERROR_MAX, "'%.200s': %s; write DEVICE: KIND [VALUE] [at TIME] [for TIME|ever]", text,
	         why);
	return -EINVAL;
}

static bool parse_time(const char *word, int64_t *ret_ns)
{
	double seconds;
	if (units_parse(word, DIMENSION_TIME, &seconds) < 0 || !(seconds >= 0.0 && seconds <= 1e6))
		return false;
	*ret_ns = (int64_t)(seconds * 1e9 + 0.5);
	return true;
}

static bool parse_number(const char *word, double *ret)
{
	char *end;
	const double value = strtod(word, &end);
	if (end == word || *end != '\0' || !(value > -1e12 && value < 1e12))
		return false;
	*ret = value;
	return true;
}

static void add_word(struct sim_fault *fault, const char *word)
{
	const size_t len = strlen(fault->kind);
	snprintf(fault->kind + len, sizeof fault->kind - len, "%s%s", len > 0 ? " " : "", word);
}

/* From `at` or `for` on: pairs of a word and a time. */
static const char *parse_times(char **word, int n, struct sim_fault *fault, bool *ret_for)
{
	for (int i = 0; i < n; i += 2) {
		const bool at = strcmp(word[i], "at") == 0;
		if (!at && strcmp(word[i], "for") != 0)
			return "behind the times there is more";
		if (i + 1 == n)
			return at ? "`at` wants a time, like 3s" : "`for` wants a time, like 2s, or ever";
		if (!at && strcmp(word[i + 1], "ever") == 0)
			fault->for_ns = INT64_MAX;
		else if (!parse_time(word[i + 1], at ? &fault->at_ns : &fault->for_ns))
			return "a time is a number with ms, s or min, like 500ms";
		*ret_for |= !at;
	}
	return NULL;
}

static const char *parse_words(char **word, int n, struct sim_fault *fault)
{
	int kind = 0;
	bool lasts = false;
	while (kind < n && strcmp(word[kind], "at") != 0 && strcmp(word[kind], "for") != 0)
		kind++;
	const char *why = parse_times(word + kind, n - kind, fault, &lasts);
	if (why != NULL)
		return why;
	if (kind > 1 && parse_number(word[kind - 1], &fault->value))
		kind--;
	for (int i = 0; i < kind; i++)
		add_word(fault, word[i]);
	if (kind == 0)
		return "which kind of fault?";
	for (size_t i = 0; i < sizeof durations / sizeof durations[0] && !lasts; i++)
		if (strcmp(durations[i].kind, fault->kind) == 0)
			fault->for_ns = durations[i].for_ns;
	return NULL;
}

int fault_parse(const char *text, struct sim_fault *ret, char error[FAULT_ERROR_MAX])
{
	char copy[256], *word[WORDS_MAX], *rest, *at;
	const char *colon = strchr(text, ':');
	struct sim_fault fault = {0};
	int n = 0;
	if (colon == NULL)
		return refuse(error, text, "no colon behind the device");
	if (colon == text || (size_t)(colon - text) >= sizeof fault.device)
		return refuse(error, text, "no device before the colon");
	if (strlen(text) >= sizeof copy)
		return refuse(error, text, "too long");
	memcpy(fault.device, text, (size_t)(colon - text));
	snprintf(copy, sizeof copy, "%s", colon + 1);
	for (at = strtok_r(copy, " \t\r\n", &rest); at != NULL; at = strtok_r(NULL, " \t\r\n", &rest)) {
		if (n == WORDS_MAX)
			return refuse(error, text, "too many words");
		word[n++] = at;
	}
	const char *why = parse_words(word, n, &fault);
	if (why != NULL)
		return refuse(error, text, why);
	*ret = fault;
	return 0;
}

static void list(char *ret, size_t cap, const char *word)
{
	const size_t len = strlen(ret);
	snprintf(ret + len, cap - len, "%s%s", len > 0 ? ", " : "", word);
}

static bool list_kinds(const struct fault_target *target, const char *kind, char *ret, size_t cap)
{
	for (int i = 0; i < 2 && target->kinds[i] != NULL; i++) {
		if (sim_fault_index(target->kinds[i], kind) >= 0)
			return true;
		for (int k = 0; target->kinds[i][k] != NULL; k++)
			list(ret, cap, target->kinds[i][k]);
	}
	return false;
}

static int check_value(const struct sim_fault *fault, char error[FAULT_ERROR_MAX])
{
	for (size_t i = 0; i < sizeof bounds / sizeof bounds[0]; i++) {
		if (strcmp(bounds[i].kind, fault->kind) != 0 || fault->value == 0 ||
		    (fault->value >= bounds[i].min && fault->value <= bounds[i].max))
			continue;
		snprintf(error, FAULT_ERROR_MAX, "'%s %g': its value is %g .. %g", fault->kind, fault->value,
		         bounds[i].min, bounds[i].max);
		return -EINVAL;
	}
	return 0;
}

int fault_check(const struct sim_fault *fault, const struct fault_target *target, int targets,
                char error[FAULT_ERROR_MAX])
{
	char known[FAULT_ERROR_MAX - 150] = "";
	for (int i = 0; i < targets; i++) {
		if (strcmp(target[i].device, fault->device) != 0)
			continue;
		if (list_kinds(&target[i], fault->kind, known, sizeof known))
			return check_value(fault, error);
		snprintf(error, FAULT_ERROR_MAX, "'%s': %s has no such fault; it has %s", fault->kind, fault->device,
		         known);
		return -EINVAL;
	}
	for (int i = 0; i < targets; i++)
		list(known, sizeof known, target[i].device);
	snprintf(error, FAULT_ERROR_MAX, "'%s': no such device; there is %s", fault->device, known);
	return -EINVAL;
}

int fault_plan_add(struct fault_plan *plan, const struct sim_fault *fault, int64_t begin_ns)
{
	if (plan->n == FAULT_ORDERS_MAX)
		return -ENOSPC;
	plan->order[plan->n++] = (struct fault_order){.fault = *fault, .at_ns = begin_ns + fault->at_ns};
	return 0;
}

/* -1: nothing waits. Of two at the same time the one ordered first. */
static int earliest(const struct fault_plan *plan)
{
	int first = -1;
	for (int i = 0; i < plan->n; i++)
		if (first < 0 || plan->order[i].at_ns < plan->order[first].at_ns)
			first = i;
	return first;
}

bool fault_plan_next(struct fault_plan *plan, int64_t t_ns, struct sim_fault *ret, bool *ret_on)
{
	const int i = earliest(plan);
	if (i < 0 || plan->order[i].at_ns > t_ns)
		return false;
	struct fault_order *order = &plan->order[i];
	*ret = order->fault;
	*ret_on = !order->on;
	if (!order->on && order->fault.for_ns > 0 && order->fault.for_ns < INT64_MAX) {
		order->on = true;
		order->at_ns += order->fault.for_ns;
		return true;
	}
	memmove(order, order + 1, (size_t)(plan->n - i - 1) * sizeof *order);
	plan->n--;
	return true;
}

int64_t fault_plan_deadline(const struct fault_plan *plan)
{
	const int i = earliest(plan);
	return i < 0 ? INT64_MAX : plan->order[i].at_ns;
}

void fault_print_counts(const struct sim_counts *c, char *ret, size_t cap)
{
	snprintf(ret, cap,
	         "profiles %llu, sent %llu, corrupted %llu, dropped %llu, garbage %llu bytes, requests %llu, replies "
	         "%llu, power cycles %llu, connections %llu",
	         (unsigned long long)c->profiles, (unsigned long long)c->sent, (unsigned long long)c->corrupted,
	         (unsigned long long)c->dropped, (unsigned long long)c->garbage, (unsigned long long)c->requests,
	         (unsigned long long)c->replies, (unsigned long long)c->power_cycles,
	         (unsigned long long)c->reconnects);
}
