/* Law: over HTTP nobody gets in by default. Who asks by another's name, for another's page or without the token is refused,
 * told why, and costs no more for asking again; who may is answered. */
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <cmocka.h>

#include <arpa/inet.h>
#include <errno.h>
#include <netinet/in.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

#include "daemon/web_http.h"
#include "daemon/web_metrics.h"

#define SECRET "0123456789abcdef-secret"
#define SECOND 1000000000ll

static int64_t clock_ns;
static unsigned built;

static int64_t host_now(void *ctx)
{
	(void)ctx;
	return clock_ns;
}

static void host_status(void *ctx, struct buffer *ret)
{
	(void)ctx;
	buffer_printf(ret, "{\"class\":\"STATUS\",\"built\":%u}", ++built);
}

static void host_metrics(void *ctx, struct buffer *ret)
{
	(void)ctx;
	buffer_printf(ret, "facetd_up 1\n");
}

static struct config config;
static struct web_host host = {.server = {.now = host_now, .status = host_status}, .metrics = host_metrics};
static struct web_site site;
static struct sockaddr_storage here;

static int begin(void **state)
{
	struct sockaddr_in *v4 = (struct sockaddr_in *)&here;

	(void)state;
	config_default(&config);
	memset(&here, 0, sizeof(here));
	v4->sin_family = AF_INET;
	v4->sin_addr.s_addr = htonl(0x7f000001);
	buffer_finish(&site.status);
	site = (struct web_site){.config = &config, .host = &host, .loopback = true};
	snprintf(site.secret, sizeof(site.secret), "%s", SECRET);
	clock_ns = 100 * SECOND;
	built = 0;
	return 0;
}

static int end(void **state)
{
	(void)state;
	buffer_finish(&site.status);
	return 0;
}

static struct web_request request(const char *method, const char *path)
{
	return (struct web_request){.method = method, .path = path, .host = "127.0.0.1:7880", .from = &here};
}

/* The code of the refusal; 0: admitted. */
static int admit(const struct web_request *r, struct web_rights *ret_rights, char log[160])
{
	struct web_answer answer = {0};
	struct web_rights rights = {0};
	char line[160];
	int code = web_site_admit(&site, r, &rights, &answer, log ? log : line) ? 0 : answer.code;

	if (code) /* a refusal is a sentence */
		assert_true(answer.len > 10 && ((const char *)answer.bytes)[answer.len - 1] == '\n');
	if (ret_rights)
		*ret_rights = rights;
	web_answer_finish(&answer);
	return code;
}

static int admit_host(const char *name)
{
	struct web_request r = request("GET", "/status.json");

	r.host = name;
	return admit(&r, NULL, NULL);
}

static void on_loopback_only_its_own_names_are_good(void **state)
{
	(void)state;
	assert_int_equal(admit_host("localhost"), 0);
	assert_int_equal(admit_host("LocalHost:8080"), 0);
	assert_int_equal(admit_host("127.0.0.1:7880"), 0);
	assert_int_equal(admit_host("127.1.2.3"), 0);
	assert_int_equal(admit_host("[::1]:7880"), 0);
	assert_int_equal(admit_host(NULL), 403);
	assert_int_equal(admit_host(""), 403);
	assert_int_equal(admit_host("evil.example:7880"), 403);
	assert_int_equal(admit_host("localhost.evil.example"), 403);
	assert_int_equal(admit_host("127.0.0.1.evil.example"), 403);
	assert_int_equal(admit_host("localhost:80@evil"), 403);
	assert_int_equal(admit_host("localhost/"), 403);
	assert_int_equal(admit_host("[::1"), 403);
	assert_int_equal(admit_host("[::1]x"), 403);
	assert_int_equal(admit_host("localhost:8a"), 403);
	snprintf(config.listen.origin[0], CONFIG_TEXT_MAX, "https://robot.example:8443");
	config.listen.origins = 1;
	assert_int_equal(admit_host("robot.example"), 0);
	assert_int_equal(admit_host("robot.example.evil"), 403);
}

static void a_name_that_is_configured_is_our_own(void **state)
{
	(void)state;
	snprintf(config.listen.http, CONFIG_TEXT_MAX, "[::1]:9");
	assert_int_equal(admit_host("[::1]:9"), 0);
	assert_int_equal(admit_host("other"), 403);
	/* Beyond loopback the token decides, not the name. */
	snprintf(config.listen.http, CONFIG_TEXT_MAX, "0.0.0.0:9");
	assert_int_equal(admit_host("any.name.example"), 0);
	assert_int_equal(admit_host("no name"), 403);
}

static int admit_origin(const char *method, bool upgrade, const char *origin)
{
	struct web_request r = request(method, "/native");

	r.origin = origin;
	r.upgrade = upgrade;
	return admit(&r, NULL, NULL);
}

static void other_pages_open_no_websockets_and_change_nothing(void **state)
{
	static const char *const others[] = {"http://evil.example",
	                                     "null",
	                                     "http://127.0.0.1:7881",
	                                     "https://127.0.0.1:7880",
	                                     "http://127.0.0.1",
	                                     "file://",
	                                     "",
	                                     "http://127.0.0.1:7880.evil"};

	(void)state;
	for (size_t i = 0; i < sizeof(others) / sizeof(others[0]); i++) {
		assert_int_equal(admit_origin("GET", true, others[i]), 403);
		assert_int_equal(admit_origin("POST", false, others[i]), 403);
		assert_int_equal(admit_origin("GET", false, others[i]),
		                 0); /* a browser does not let it read the answer */
	}
	assert_int_equal(admit_origin("GET", true, NULL), 0); /* no browser */
	assert_int_equal(admit_origin("GET", true, "http://127.0.0.1:7880"), 0);
	config.listen.has_tls = true;
	assert_int_equal(admit_origin("GET", true, "http://127.0.0.1:7880"), 403);
	assert_int_equal(admit_origin("GET", true, "https://127.0.0.1:7880"), 0);
	snprintf(config.listen.origin[0], CONFIG_TEXT_MAX, "https://app.example");
	config.listen.origins = 1;
	assert_int_equal(admit_origin("GET", true, "https://app.example"), 0);
	assert_int_equal(admit_origin("GET", true, "https://app.example.evil"), 403);
}

static void a_listed_page_is_told_that_it_may_read(void **state)
{
	struct web_request r = request("GET", "/planes.json");
	struct web_answer answer = {0};
	struct web_rights rights;
	char log[160];

	(void)state;
	snprintf(config.listen.origin[0], CONFIG_TEXT_MAX, "https://app.example");
	config.listen.origins = 1;
	r.origin = "https://app.example";
	assert_true(web_site_admit(&site, &r, &rights, &answer, log));
	assert_string_equal(answer.allow_origin, "https://app.example");
	web_answer_finish(&answer);
	r.origin = "http://127.0.0.1:7880";
	assert_true(web_site_admit(&site, &r, &rights, &answer, log));
	assert_null(answer.allow_origin);
	web_answer_finish(&answer);
}

static void rights_come_with_the_token_and_with_nothing_else(void **state)
{
	struct web_request r = request("GET", "/native");
	struct web_rights rights;

	(void)state;
	r.upgrade = true;
	assert_int_equal(admit(&r, &rights, NULL), 0);
	assert_false(rights.may_change || rights.may_play);
	host.replays = true;
	assert_int_equal(admit(&r, &rights, NULL), 0);
	assert_true(!rights.may_change && rights.may_play);
	host.replays = false;
	r.token = SECRET;
	assert_int_equal(admit(&r, &rights, NULL), 0);
	assert_true(rights.may_change && rights.may_play);
	r.token = NULL;
	r.authorization = "Bearer " SECRET;
	assert_int_equal(admit(&r, &rights, NULL), 0);
	assert_true(rights.may_change);
	r.authorization = "bearer   " SECRET;
	assert_int_equal(admit(&r, &rights, NULL), 0);
	r.authorization = "Basic " SECRET;
	assert_int_equal(admit(&r, &rights, NULL), 401);
	assert_false(rights.may_change);
	r.authorization = "Bearer " SECRET "x";
	r.token = SECRET; /* the wrong one counts */
	assert_int_equal(admit(&r, &rights, NULL), 401);
}

static void without_a_secret_no_token_is_right(void **state)
{
	(void)state;
	assert_int_equal(web_token_judge("", "Bearer ", NULL), WEB_SHOWN_WRONG);
	assert_int_equal(web_token_judge("", NULL, ""), WEB_SHOWN_NONE);
	assert_int_equal(web_token_judge("", NULL, "x"), WEB_SHOWN_WRONG);
	assert_int_equal(web_token_judge(SECRET, NULL, NULL), WEB_SHOWN_NONE);
	assert_int_equal(web_token_judge(SECRET, "", SECRET), WEB_SHOWN_RIGHT);
	assert_int_equal(web_token_judge(SECRET, NULL, "0123456789abcdef-secre"), WEB_SHOWN_WRONG);
}

static void beyond_loopback_only_the_page_is_shown_to_strangers(void **state)
{
	struct web_request r = request("GET", "/status.json");

	(void)state;
	site.loopback = false;
	assert_int_equal(admit(&r, NULL, NULL), 401);
	r.path = "/";
	assert_int_equal(admit(&r, NULL, NULL), 0);
	r.upgrade = true; /* a WebSocket at that path */
	assert_int_equal(admit(&r, NULL, NULL), 401);
	r.token = SECRET;
	assert_int_equal(admit(&r, NULL, NULL), 0);
}

static void a_guesser_is_kept_out_for_a_minute_and_logged_twice(void **state)
{
	struct web_request wrong = request("GET", "/status.json"), right = wrong, none = wrong;
	char log[160];
	int lines = 0;

	(void)state;
	wrong.token = "0123456789abcdef-wrong";
	right.token = SECRET;
	for (int i = 0; i < WEB_WRONG_MAX; i++) {
		assert_int_equal(admit(&wrong, NULL, log), 401);
		assert_null(strstr(log, "wrong\n"));
		assert_null(strstr(log, "0123456789"));
		lines += log[0] != '\0';
	}
	assert_int_equal(lines, 2);
	assert_int_equal(admit(&wrong, NULL, log), 429);
	assert_int_equal(log[0], 0);
	assert_int_equal(admit(&right, NULL, NULL), 429);
	assert_int_equal(admit(&none, NULL, NULL), 0); /* on loopback, reading */
	clock_ns += WEB_WRONG_NS - 1;
	assert_int_equal(admit(&right, NULL, NULL), 429);
	clock_ns += 1;
	assert_int_equal(admit(&right, NULL, NULL), 0);
	assert_int_equal(admit(&wrong, NULL, log), 401); /* begins anew */
	assert_true(log[0] != '\0');
	assert_int_equal(admit(&right, NULL, NULL), 0);
}

static struct sockaddr_storage v6(uint8_t net, uint8_t machine)
{
	struct sockaddr_storage a = {.ss_family = AF_INET6};

	((struct sockaddr_in6 *)&a)->sin6_addr.s6_addr[0] = 0x20;
	((struct sockaddr_in6 *)&a)->sin6_addr.s6_addr[7] = net;
	((struct sockaddr_in6 *)&a)->sin6_addr.s6_addr[15] = machine;
	return a;
}

static void a_network_counts_as_one_and_the_table_is_bounded(void **state)
{
	struct web_strangers strangers = {0};
	struct sockaddr_storage from;

	(void)state;
	for (uint8_t i = 0; i < WEB_WRONG_MAX; i++) {
		from = v6(1, i);
		web_strangers_note(&strangers, &from, SECOND);
	}
	from = v6(1, 200);
	assert_int_equal(web_strangers_wait_s(&strangers, &from, SECOND), 60);
	from = v6(2, 200);
	assert_int_equal(web_strangers_wait_s(&strangers, &from, SECOND), 0);
	for (int i = 0; i < 1000; i++) {
		from = v6((uint8_t)(i % 251), (uint8_t)i);
		web_strangers_note(&strangers, &from, 2 * SECOND + i);
	}
	from = v6(1, 1); /* quiet for longest: forgotten, or noted anew */
	assert_true(web_strangers_wait_s(&strangers, &from, 3 * SECOND) <= 60);
}

/* Answers */

static int answer_to(const char *method, const char *path, struct web_answer *ret)
{
	struct web_request r = request(method, path);

	memset(ret, 0, sizeof(*ret));
	web_site_answer(&site, &r, ret);
	assert_true(web_answer_ready(ret));
	return ret->code;
}

static void routes_are_answered_and_nothing_else_is_there(void **state)
{
	static const char *const nowhere[] = {"/x", "/status.json/", "/snapshot.", "/snapshot.exe", "//",
	                                      "",   "/status"};
	struct web_answer a;

	(void)state;
	assert_int_equal(answer_to("GET", "/planes.json", &a), 200);
	assert_true(a.len == 3 && memcmp(a.bytes, "[]\n", 3) == 0);
	web_answer_finish(&a);
	assert_int_equal(answer_to("GET", "/metrics", &a), 200);
	assert_memory_equal(a.bytes, "facetd_up 1\n", 12);
	web_answer_finish(&a);
	assert_int_equal(answer_to("GET", "/", &a), 200);
	assert_non_null(strstr(a.policy, "default-src"));
	web_answer_finish(&a);
	for (size_t i = 0; i < sizeof(nowhere) / sizeof(nowhere[0]); i++) {
		assert_int_equal(answer_to("GET", nowhere[i], &a), 404);
		web_answer_finish(&a);
	}
	assert_int_equal(answer_to("POST", "/planes.json", &a), 405);
	assert_true(a.allow_methods);
	web_answer_finish(&a);
	assert_int_equal(answer_to("HEAD", "/planes.json", &a), 200);
	assert_true(a.head && a.len == 3);
	web_answer_finish(&a);
}

static void a_status_is_built_ten_times_a_second_at_most(void **state)
{
	struct web_answer a;

	(void)state;
	for (int i = 0; i < 100; i++) {
		answer_to("GET", "/status.json", &a);
		web_answer_finish(&a);
		clock_ns += SECOND / 100;
	}
	assert_true(built >= 9 && built <= 11);
}

/* The token's file */

static int read_token(const char *text, mode_t mode, char ret[WEB_TOKEN_MAX], char error[320])
{
	char path[] = "/tmp/facet-token-XXXXXX";
	const int fd = mkstemp(path);
	int r;

	assert_true(fd >= 0 && write(fd, text, strlen(text)) == (ssize_t)strlen(text));
	fchmod(fd, mode);
	close(fd);
	r = web_token_read(path, ret, error);
	if (r < 0)
		assert_non_null(strstr(error, path));
	unlink(path);
	return r;
}

static void a_token_is_a_line_that_not_everybody_may_read(void **state)
{
	char token[WEB_TOKEN_MAX] = "", error[320];
	char longest[400];

	(void)state;
	assert_int_equal(read_token(SECRET "  \nmore\n", 0640, token, error), 0);
	assert_string_equal(token, SECRET);
	assert_int_equal(read_token(SECRET, 0600, token, error), 0);
	assert_int_equal(read_token(SECRET "\n", 0644, token, error), -EPERM);
	assert_non_null(strstr(error, "everybody"));
	assert_int_equal(read_token("short\n", 0600, token, error), -EINVAL);
	assert_int_equal(read_token("", 0600, token, error), -EINVAL);
	assert_int_equal(read_token("0123456789abcdef with blanks\n", 0600, token, error), -EINVAL);
	memset(longest, 'x', sizeof(longest) - 1);
	longest[sizeof(longest) - 1] = '\0';
	assert_int_equal(read_token(longest, 0600, token, error), -EINVAL);
	assert_int_equal(web_token_read("/nowhere/token", token, error), -ENOENT);
	assert_non_null(strstr(error, "/nowhere/token"));
	assert_true(web_token_read("/tmp", token, error) < 0);
}

int main(void)
{
#define TEST(name) cmocka_unit_test_setup_teardown(name, begin, end)
	const struct CMUnitTest tests[] = {
	    TEST(on_loopback_only_its_own_names_are_good),
	    TEST(a_name_that_is_configured_is_our_own),
	    TEST(other_pages_open_no_websockets_and_change_nothing),
	    TEST(a_listed_page_is_told_that_it_may_read),
	    TEST(rights_come_with_the_token_and_with_nothing_else),
	    TEST(without_a_secret_no_token_is_right),
	    TEST(beyond_loopback_only_the_page_is_shown_to_strangers),
	    TEST(a_guesser_is_kept_out_for_a_minute_and_logged_twice),
	    TEST(a_network_counts_as_one_and_the_table_is_bounded),
	    TEST(routes_are_answered_and_nothing_else_is_there),
	    TEST(a_status_is_built_ten_times_a_second_at_most),
	    TEST(a_token_is_a_line_that_not_everybody_may_read),
	};

	return cmocka_run_group_tests(tests, NULL, NULL);
}
