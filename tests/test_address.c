/* Law: an address is taken whole or refused with a sentence; nobody outside loopback gets in by default (D11). */
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <cmocka.h>
#include <arpa/inet.h>
#include <errno.h>
#include <netinet/in.h>
#include <sys/un.h>
#include <unistd.h>

#include "config/address.h"

#define ANY (ADDRESS_UNIX | ADDRESS_TCP | ADDRESS_UDP)

static void good_addresses_are_read_and_written_alike(void **state)
{
	(void)state;
	static const char *const texts[] = {"unix:/run/facetd/facetd.sock", "unix:here", "tcp:127.0.0.1:7878",
	                                    "tcp:[::1]:0", "udp:localhost:65535"};
	for (size_t i = 0; i < sizeof(texts) / sizeof(texts[0]); i++) {
		struct address address;
		char error[ADDRESS_ERROR_MAX], text[ADDRESS_TEXT_MAX];
		assert_int_equal(address_parse(texts[i], ANY, &address, error), 0);
		address_print(&address, text);
		assert_string_equal(text, texts[i]);
		assert_int_equal(address_check_loopback(&address, error), 0);
	}
}

static void a_websocket_is_a_host_a_port_and_what_may_be_asked(void **state)
{
	(void)state;
	static const struct {
		const char *text, *host, *target, *printed;
		uint16_t port;
	} good[] = {{"ws://127.0.0.1", "127.0.0.1", "/", "ws://127.0.0.1:7880/", 7880},
	            {"ws://robot:80/native", "robot", "/native", "ws://robot:80/native", 80},
	            {"ws://[::1]:9/?token=ab", "::1", "/?token=ab", "ws://[::1]:9/", 9},
	            {"ws://robot?token=ab", "robot", "/?token=ab", "ws://robot:7880/", 7880}};
	static const char *const bad[] = {"ws://",
	                                  "ws:///native",
	                                  "ws://robot:x/",
	                                  "ws://robot/a b",
	                                  "ws://robot/a\r\nHost: b",
	                                  "ws://robot/#token=ab",
	                                  "ws:127.0.0.1",
	                                  "wss://robot/"};
	struct address address;
	char text[ADDRESS_TEXT_MAX], error[ADDRESS_ERROR_MAX];
	for (size_t i = 0; i < sizeof(good) / sizeof(good[0]); i++) {
		assert_int_equal(address_parse(good[i].text, ADDRESS_UNIX | ADDRESS_WS, &address, error), 0);
		assert_int_equal(address.kind, ADDRESS_WS);
		assert_string_equal(address.host, good[i].host);
		assert_string_equal(address.target, good[i].target);
		assert_int_equal(address.port, good[i].port);
		address_print(&address, text);
		assert_string_equal(text, good[i].printed); /* without what is secret */
	}
	for (size_t i = 0; i < sizeof(bad) / sizeof(bad[0]); i++)
		assert_int_equal(address_parse(bad[i], ADDRESS_UNIX | ADDRESS_WS, &address, error), -EINVAL);
	assert_non_null(strstr(error, "ssh -L"));
	snprintf(text, sizeof(text), "ws://robot/%0310d", 0);
	assert_int_equal(address_parse(text, ADDRESS_WS, &address, error), 0);
	snprintf(text, sizeof(text), "ws://robot/%0320d", 0);
	assert_int_equal(address_parse(text, ADDRESS_WS, &address, error), -EINVAL);
}

static void a_missing_tcp_port_is_7878(void **state)
{
	(void)state;
	struct address address;
	char error[ADDRESS_ERROR_MAX];
	assert_int_equal(address_parse("tcp:localhost", ANY, &address, error), 0);
	assert_int_equal(address.port, 7878);
	assert_int_equal(address_parse("udp:localhost", ANY, &address, error), -EINVAL);
}

static void bad_addresses_are_refused_with_what_to_write(void **state)
{
	(void)state;
	static const struct {
		const char *text, *part;
	} bad[] = {
	    {"", "unix:PATH or tcp:HOST:PORT"},
	    {"/run/facetd.sock", "unix:PATH"},
	    {"unix:", "a path is missing"},
	    {"tcp:", "a host is needed"},
	    {"tcp::7878", "a host is needed"},
	    {"tcp:host:port", "is not a port"},
	    {"tcp:host:", "is not a port"},
	    {"tcp:host:65536", "is not a port"},
	    {"tcp:host:-1", "is not a port"},
	    {"tcp:host:1 ", "is not a port"},
	    {"tcp:[::1", "closing ]"},
	    {"tcp:[::1]7878", "a colon"},
	    {"udp:127.0.0.1:1", "is not an address"},
	    {"ws://127.0.0.1:7880/", "is not an address"},
	    {"wss://robot/", "is not an address"},
	    {"tcp:a\nb:1:2", "is not a port"},
	};
	for (size_t i = 0; i < sizeof(bad) / sizeof(bad[0]); i++) {
		struct address address;
		char error[ADDRESS_ERROR_MAX] = "";
		assert_int_equal(address_parse(bad[i].text, ADDRESS_UNIX | ADDRESS_TCP, &address, error), -EINVAL);
		if (!strstr(error, bad[i].part) || strchr(error, '\n'))
			fail_msg("'%s' gave '%s'", bad[i].text, error);
	}
}

static void a_unix_path_of_108_bytes_is_refused_one_of_107_fits(void **state)
{
	(void)state;
	struct address address;
	struct sockaddr_storage to;
	socklen_t len;
	char text[200], error[ADDRESS_ERROR_MAX];
	snprintf(text, sizeof(text), "unix:%0107d", 0);
	assert_int_equal(address_parse(text, ANY, &address, error), 0);
	assert_int_equal(address_sockaddr(&address, &to, &len), 0);
	assert_string_equal(((struct sockaddr_un *)&to)->sun_path, text + 5);
	assert_int_equal(len, sizeof(struct sockaddr_un));
	snprintf(text, sizeof(text), "unix:%0108d", 0);
	assert_int_equal(address_parse(text, ANY, &address, error), -EINVAL);
	assert_non_null(strstr(error, "108 bytes"));
}

static void a_host_longer_than_any_is_refused(void **state)
{
	(void)state;
	struct address address;
	char text[400], error[ADDRESS_ERROR_MAX];
	snprintf(text, sizeof(text), "tcp:%0300d:1", 0);
	assert_int_equal(address_parse(text, ANY, &address, error), -EINVAL);
}

static void only_loopback_is_loopback(void **state)
{
	(void)state;
	static const char *const outside[] = {
	    "tcp:0.0.0.0:1",        "tcp:128.0.0.1:1", "tcp:[::]:1", "tcp:robot:1", "tcp:127.0.0.1.example.org:1",
	    "tcp:126.255.255.255:1"};
	for (size_t i = 0; i < sizeof(outside) / sizeof(outside[0]); i++) {
		struct address address;
		char error[ADDRESS_ERROR_MAX];
		assert_int_equal(address_parse(outside[i], ANY, &address, error), 0);
		assert_int_equal(address_check_loopback(&address, error), -EINVAL);
		assert_non_null(strstr(error, "ssh -L"));
	}
}

static void numbers_become_socket_addresses_without_a_name_server(void **state)
{
	(void)state;
	struct address address;
	struct sockaddr_storage to;
	socklen_t len;
	char error[ADDRESS_ERROR_MAX];
	assert_int_equal(address_parse("tcp:localhost:80", ANY, &address, error), 0);
	assert_int_equal(address_sockaddr(&address, &to, &len), 0);
	assert_int_equal(((struct sockaddr_in *)&to)->sin_port, htons(80));
	assert_int_equal(((struct sockaddr_in *)&to)->sin_addr.s_addr, htonl(INADDR_LOOPBACK));
	assert_int_equal(address_parse("tcp:[::1]:80", ANY, &address, error), 0);
	assert_int_equal(address_sockaddr(&address, &to, &len), 0);
	assert_int_equal(to.ss_family, AF_INET6);
	assert_int_equal(address_parse("tcp:robot:80", ANY, &address, error), 0);
	assert_int_equal(address_sockaddr(&address, &to, &len), -EINVAL);
}

static void the_default_is_the_environment_then_the_users_then_the_systems(void **state)
{
	(void)state;
	char text[ADDRESS_TEXT_MAX], dir[] = "/tmp/address.XXXXXX", path[64];
	setenv("FACETD", "tcp:127.0.0.1:9", 1);
	assert_string_equal(address_default(text), "tcp:127.0.0.1:9");
	unsetenv("FACETD");
	assert_non_null(mkdtemp(dir));
	setenv("XDG_RUNTIME_DIR", dir, 1);
	assert_string_equal(address_default(text), "unix:/run/facetd/facetd.sock");
	struct sockaddr_un un = {.sun_family = AF_UNIX};
	snprintf(un.sun_path, sizeof(un.sun_path), "%s/facetd.sock", dir);
	const int fd = socket(AF_UNIX, SOCK_STREAM, 0);
	assert_int_equal(bind(fd, (struct sockaddr *)&un, sizeof(un)), 0);
	snprintf(path, sizeof(path), "unix:%s", un.sun_path);
	assert_string_equal(address_default(text), path);
	close(fd);
	unlink(un.sun_path);
	rmdir(dir);
}

int main(void)
{
	const struct CMUnitTest tests[] = {
	    cmocka_unit_test(good_addresses_are_read_and_written_alike),
	    cmocka_unit_test(a_websocket_is_a_host_a_port_and_what_may_be_asked),
	    cmocka_unit_test(a_missing_tcp_port_is_7878),
	    cmocka_unit_test(bad_addresses_are_refused_with_what_to_write),
	    cmocka_unit_test(a_unix_path_of_108_bytes_is_refused_one_of_107_fits),
	    cmocka_unit_test(a_host_longer_than_any_is_refused),
	    cmocka_unit_test(only_loopback_is_loopback),
	    cmocka_unit_test(numbers_become_socket_addresses_without_a_name_server),
	    cmocka_unit_test(the_default_is_the_environment_then_the_users_then_the_systems),
	};
	return cmocka_run_group_tests(tests, NULL, NULL);
}
