/* Laws L1 and L2: the core uses of libm only what every machine computes alike, and holds no clock, thread, file or global. */
#include <dlfcn.h>
#include <setjmp.h>
#include <stdbool.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <cmocka.h>

/* Calls `judge` with every line that nm says of libcore.a; how many lines. */
static int nm_lines(const char *options, void (*judge)(const char *line))
{
	const char *build = getenv("FACET_BUILD");
	char command[512], line[4096];
	FILE *pipe;
	int n = 0;

	snprintf(command, sizeof(command), "nm %s '%s/libcore.a' 2>/dev/null", options, build ? build : "build");
	pipe = popen(command, "r");
	assert_non_null(pipe);
	while (fgets(line, sizeof(line), pipe)) {
		line[strcspn(line, "\n")] = 0;
		judge(line);
		n++;
	}
	pclose(pipe);
	return n;
}

static int faults;
static bool instrumented;

static bool one_of(const char *name, const char *const *list)
{
	for (; *list; list++)
		if (strcmp(name, *list) == 0)
			return true;
	return false;
}

/* An undefined symbol's name, or NULL: "                 U sqrt". */
static const char *undefined_name(const char *line)
{
	const char *u = strstr(line, " U ");

	return u ? u + 3 : NULL;
}

static void judge_libm(const char *line)
{
	static const char *const allowed[] = {"sqrt", "floor", "ceil", "rint", "fabs", "ldexp", NULL};
	static void *libm;
	const char *name = undefined_name(line);
	Dl_info from;
	void *symbol;

	if (!libm)
		libm = dlopen("libm.so.6", RTLD_NOW);
	assert_non_null(libm);
	symbol = name ? dlsym(libm, name) : NULL;
	if (!symbol || !dladdr(symbol, &from) || !strstr(from.dli_fname, "libm") || one_of(name, allowed))
		return;
	printf("%s is libm's and not one of the functions that are exact everywhere\n", name);
	faults++;
}

static void judge_system(const char *line)
{
	static const char *const forbidden[] = {"time",           "clock",       "clock_gettime",
	                                        "gettimeofday",   "open",        "openat",
	                                        "read",           "write",       "socket",
	                                        "fopen",          "fopen64",     "printf",
	                                        "__printf_chk",   "puts",        "putchar",
	                                        "fputs",          "fprintf",     "fwrite",
	                                        "stdout",         "stderr",      "perror",
	                                        "syslog",         "exit",        "abort",
	                                        "getenv",         "rand",        "random",
	                                        "sleep",          "nanosleep",   "usleep",
	                                        "pthread_create", "thrd_create", "pthread_mutex_lock",
	                                        "strtod",         "setlocale",   NULL};
	const char *name = undefined_name(line);

	if (!name || !one_of(name, forbidden))
		return;
	printf("%s does not belong into the core\n", name);
	faults++;
}

static void judge_globals(const char *line)
{
	const char *section = strrchr(line, '|');

	if (strncmp(line, "__asan", 6) == 0 || strncmp(line, "__tsan", 6) == 0 || strncmp(line, "__llvm", 6) == 0 ||
	    strncmp(line, "__sanitizer", 11) == 0 || strncmp(line, "__prof", 6) == 0)
		instrumented = true;
	if (!section || (strcmp(section, "|.data") && strcmp(section, "|.bss") && strncmp(section, "|.tbss", 6)))
		return;
	printf("a variable outside of functions' frames: %s\n", line);
	faults++;
}

static void of_libm_the_core_uses_only_exact_functions(void **state)
{
	(void)state;
	faults = 0;
	assert_true(nm_lines("-u", judge_libm) > 50);
	assert_int_equal(faults, 0);
}

static void the_core_has_no_clock_file_thread_or_log(void **state)
{
	(void)state;
	faults = 0;
	assert_true(nm_lines("-u", judge_system) > 50);
	assert_int_equal(faults, 0);
}

static void the_core_has_no_variable_that_outlives_a_call(void **state)
{
	(void)state;
	faults = 0;
	assert_true(nm_lines("-f sysv", judge_globals) > 50);
	if (!instrumented) /* sanitizers add their own */
		assert_int_equal(faults, 0);
}

int main(void)
{
	const struct CMUnitTest tests[] = {
	    cmocka_unit_test(of_libm_the_core_uses_only_exact_functions),
	    cmocka_unit_test(the_core_has_no_clock_file_thread_or_log),
	    cmocka_unit_test(the_core_has_no_variable_that_outlives_a_call),
	};

	if (system("command -v nm >/dev/null") != 0) {
		printf("nm (binutils) is not here\n");
		return 77;
	}
	return cmocka_run_group_tests(tests, NULL, NULL);
}
