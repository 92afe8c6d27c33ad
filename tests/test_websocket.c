/* Law: what a WebSocket brings is what was said, however it is cut and framed; a server that breaks RFC 6455 is refused by name
 * before a length of its is believed; and what we say is what the RFC wants of a client. */
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include <cmocka.h>
#include <errno.h>

#include "tools/libfacet_websocket.h"

static const uint8_t mask[4] = {0x37, 0xfa, 0x21, 0x3d};

/* Hears `text` in pieces of `piece` bytes, each at the end of memory of its own; -errno or what it left. */
static ssize_t hear(const void *text, size_t len, size_t piece, struct buffer *ret, struct buffer *answers, char *error)
{
	struct websocket ws = {0};
	ssize_t kept = 0;
	for (size_t at = 0; at < len && kept >= 0; at += piece) {
		const size_t n = len - at < piece ? len - at : piece;
		uint8_t *place = malloc(n + 1);
		assert_non_null(place);
		memcpy(place + 1, (const uint8_t *)text + at, n);
		kept = websocket_hear(&ws, place, n, mask, answers, error);
		assert_true(kept <= (ssize_t)n + 1);
		if (kept > 0)
			buffer_append(ret, place, (size_t)kept);
		free(place);
	}
	return kept;
}

static void messages_in_pieces_of_any_size_are_one_stream(void **state)
{
	(void)state;
	/* binary "ab" in two pieces with a ping within, text "hi", an empty text, binary "c", a text in three pieces */
	static const uint8_t said[] = "\x02\x01"
	                              "a"
	                              "\x89\x03"
	                              "yes"
	                              "\x80\x01"
	                              "b"
	                              "\x81\x02"
	                              "hi"
	                              "\x81\x00"
	                              "\x82\x01"
	                              "c"
	                              "\x01\x01"
	                              "x"
	                              "\x00\x00"
	                              "\x80\x01"
	                              "y";
	for (size_t piece = 1; piece < sizeof(said); piece++) {
		struct buffer got = {0}, answers = {0};
		char error[WEBSOCKET_ERROR_MAX];
		assert_true(hear(said, sizeof(said) - 1, piece, &got, &answers, error) >= 0);
		assert_int_equal(got.len, 10);
		assert_memory_equal(got.data, "abhi\n\ncxy\n", 10);
		assert_int_equal(answers.len, 9); /* the pong repeats what it was asked */
		assert_int_equal(answers.data[0], 0x8a);
		assert_int_equal(answers.data[1], 0x83);
		assert_int_equal(answers.data[6], 'y' ^ mask[0]);
		buffer_finish(&got);
		buffer_finish(&answers);
	}
}

static void a_close_gives_its_reason_after_what_was_said_before(void **state)
{
	(void)state;
	static const uint8_t said[] = "\x82\x01"
	                              "a"
	                              "\x88\x07\x03\xf5"
	                              "l\x1bsts";
	struct websocket ws = {0};
	struct buffer answers = {0};
	char error[WEBSOCKET_ERROR_MAX];
	uint8_t place[sizeof(said)];
	memcpy(place + 1, said, sizeof(said) - 1);
	assert_int_equal(websocket_hear(&ws, place, sizeof(said) - 1, mask, &answers, error), 1);
	assert_int_equal(place[0], 'a');
	assert_true(ws.closed);
	assert_int_equal(ws.code, 1013);
	assert_string_equal(ws.reason, "l?sts");
	assert_int_equal(answers.len, 8);
	assert_int_equal(answers.data[0], 0x88);
	assert_int_equal(websocket_hear(&ws, place, 1, mask, &answers, error), -ECONNRESET);
	assert_string_equal(error, "l?sts");
	buffer_finish(&answers);
}

static void a_server_that_breaks_the_rules_is_refused_by_name(void **state)
{
	(void)state;
	static const struct {
		const char *frame;
		size_t len;
		const char *part;
	} bad[] = {
	    {"\xc2\x00", 2, "reserved bits"},
	    {"\x82\x81\0\0\0\0a", 7, "masked"},
	    {"\x83\x00", 2, "no known kind"},
	    {"\x8b\x00", 2, "no known kind"},
	    {"\x89\x7e\x00\x7e", 4, "too long"},
	    {"\x09\x00", 2, "in pieces"},
	    {"\x80\x00", 2, "without a beginning"},
	    {"\x02\x00\x82\x00", 4, "inside another"},
	    {"\x82\x7e\x00\x7d", 4, "impossible length"},
	    {"\x82\x7f\0\0\0\0\0\0\xff\xff", 10, "impossible length"},
	    {"\x82\x7f\x80\0\0\0\0\0\0\0", 10, "impossible length"},
	};
	for (size_t i = 0; i < sizeof(bad) / sizeof(bad[0]); i++)
		for (size_t piece = 1; piece <= bad[i].len; piece++) {
			struct buffer got = {0}, answers = {0};
			char error[WEBSOCKET_ERROR_MAX] = "";
			assert_int_equal(hear(bad[i].frame, bad[i].len, piece, &got, &answers, error), -EPROTO);
			if (!strstr(error, bad[i].part))
				fail_msg("%zu: '%s'", i, error);
			buffer_finish(&got);
			buffer_finish(&answers);
		}
}

static void a_promise_of_any_length_costs_nothing(void **state)
{
	(void)state;
	struct buffer got = {0}, answers = {0};
	char error[WEBSOCKET_ERROR_MAX];
	assert_int_equal(hear("\x82\x7f\x7f\xff\xff\xff\xff\xff\xff\xff"
	                      "ab",
	                      12, 12, &got, &answers, error),
	                 2);
	assert_memory_equal(got.data, "ab", 2);
	buffer_finish(&got);
	buffer_finish(&answers);
}

/* A server's view of what we say. */
static void what_we_say_is_masked_and_of_the_shortest_length(void **state)
{
	(void)state;
	static const struct {
		size_t len;
		uint8_t first, head;
	} sizes[] = {
	    {0, 0x80, 6}, {125, 0x80 | 125, 6}, {126, 0x80 | 126, 8}, {65535, 0x80 | 126, 8}, {65536, 0x80 | 127, 14}};
	uint8_t *data = calloc(1, 65536);
	for (size_t i = 0; i < sizeof(sizes) / sizeof(sizes[0]); i++) {
		struct buffer b = {0};
		for (size_t k = 0; k < sizes[i].len; k++)
			data[k] = (uint8_t)k;
		websocket_put(&b, WEBSOCKET_BINARY, mask, data, sizes[i].len);
		assert_int_equal(b.len, sizes[i].head + sizes[i].len);
		assert_int_equal(b.data[0], 0x82);
		assert_int_equal(b.data[1], sizes[i].first);
		assert_memory_equal(b.data + sizes[i].head - 4, mask, 4);
		for (size_t k = 0; k < sizes[i].len; k++)
			assert_int_equal(b.data[sizes[i].head + k] ^ mask[k % 4], (uint8_t)k);
		buffer_finish(&b);
	}
	free(data);
}

/* The key and its answer are those of RFC 6455, section 1.3. */
static const uint8_t key[16] = "the sample nonce";
#define ACCEPT "Sec-WebSocket-Accept: s3pPLMBiTxaQ9kYGzzhZRbK+xOo=\r\n"
#define OPENED "HTTP/1.1 101 Switching Protocols\r\nUpgrade: websocket\r\n"

static void the_handshake_is_that_of_the_rfc(void **state)
{
	(void)state;
	const struct address address = {.kind = ADDRESS_WS, .host = "::1", .port = 7880, .target = "/native?token=x"};
	static const char good[] = OPENED "SEC-WEBSOCKET-ACCEPT:\t s3pPLMBiTxaQ9kYGzzhZRbK+xOo= \r\n"
	                                  "Sec-WebSocket-Protocol: facetd.v1\r\n\r\n";
	struct buffer b = {0};
	char error[WEBSOCKET_ERROR_MAX];
	websocket_put_request(&b, &address, key);
	buffer_append(&b, "", 1);
	assert_non_null(strstr((char *)b.data, "GET /native?token=x HTTP/1.1\r\nHost: [::1]:7880\r\n"));
	assert_non_null(strstr((char *)b.data, "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n"));
	buffer_finish(&b);
	for (size_t len = 0; len < sizeof(good) - 1; len++)
		assert_int_equal(websocket_judge((const uint8_t *)good, len, key, error), 0);
	assert_int_equal(websocket_judge((const uint8_t *)good, sizeof(good), key, error), sizeof(good) - 1);
}

static void who_does_not_open_it_is_refused_with_what_to_do(void **state)
{
	(void)state;
	static const struct {
		const char *answer;
		int code;
		const char *part;
	} bad[] = {
	    {"SSH-2.0-OpenSSH_9.2\r\n", -EPROTO, "does not speak HTTP"},
	    {"HTTP/1.1 \r\n\r\n", -EPROTO, "no status"},
	    {"HTTP/1.0 401 Unauthorized\r\n\r\n", -EACCES, "?token=TOKEN"},
	    {"HTTP/1.1 429 Too Many Requests\r\n\r\n", -EAGAIN, "try again"},
	    {"HTTP/1.1 404 Not Found\r\n\r\n", -EPROTO, "404"},
	    {OPENED "Sec-WebSocket-Protocol: facetd.v1\r\n\r\n", -EPROTO, "not asked for"},
	    {OPENED "Sec-WebSocket-Accept: s3pPLMBiTxaQ9kYGzzhZRbK+xOp=\r\nSec-WebSocket-Protocol: facetd.v1\r\n\r\n",
	     -EPROTO, "not asked for"},
	    {OPENED ACCEPT "Sec-WebSocket-Extensions: permessage-deflate\r\nSec-WebSocket-Protocol: facetd.v1\r\n\r\n",
	     -EPROTO, "not asked for"},
	    {OPENED ACCEPT "Sec-WebSocket-Protocol: foxglove.sdk.v1\r\n\r\n", -EPROTO, "facetd.v1"},
	    {OPENED ACCEPT "\r\n", -EPROTO, "facetd.v1"},
	};
	char error[WEBSOCKET_ERROR_MAX];
	static uint8_t endless[WEBSOCKET_HEAD_MAX];
	for (size_t i = 0; i < sizeof(bad) / sizeof(bad[0]); i++) {
		const size_t len = strlen(bad[i].answer);
		uint8_t *answer = malloc(len); /* not a byte more: ASan watches */
		assert_non_null(answer);
		memcpy(answer, bad[i].answer, len);
		error[0] = '\0';
		assert_int_equal(websocket_judge(answer, len, key, error), bad[i].code);
		if (!strstr(error, bad[i].part))
			fail_msg("%zu: '%s'", i, error);
		free(answer);
	}
	memset(endless, 'x', sizeof(endless));
	memcpy(endless, "HTTP/1.1 101 ", 13);
	assert_int_equal(websocket_judge(endless, sizeof(endless) - 1, key, error), 0);
	assert_int_equal(websocket_judge(endless, sizeof(endless), key, error), -EPROTO);
}

int main(void)
{
	const struct CMUnitTest tests[] = {
	    cmocka_unit_test(messages_in_pieces_of_any_size_are_one_stream),
	    cmocka_unit_test(a_close_gives_its_reason_after_what_was_said_before),
	    cmocka_unit_test(a_server_that_breaks_the_rules_is_refused_by_name),
	    cmocka_unit_test(a_promise_of_any_length_costs_nothing),
	    cmocka_unit_test(what_we_say_is_masked_and_of_the_shortest_length),
	    cmocka_unit_test(the_handshake_is_that_of_the_rfc),
	    cmocka_unit_test(who_does_not_open_it_is_refused_with_what_to_do),
	};
	return cmocka_run_group_tests(tests, NULL, NULL);
}
