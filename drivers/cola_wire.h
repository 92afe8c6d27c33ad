/* SICK CoLa-A and CoLa-B: frames, and the numbers in them, for both ends of the wire. Pure. Drawn in cola_wire.c.
 *
 *   A  02 sRN LMPscancfg 03                          B  02 02 02 02 | u32 BE length | payload | XOR of the payload
 *
 * One stream may carry either (the dialect is found by trying), so one scan function frames both: a CoLa-A payload holds
 * no 02. What follows the name is a row of numbers and strings; a reader and a writer speak them in either dialect, so
 * that requests, answers and telegrams are described once. */
#ifndef FACET_DRIVERS_COLA_WIRE_H
#define FACET_DRIVERS_COLA_WIRE_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "drivers/framer.h"

#define COLA_TELEGRAM_MAX 65536 /* frame included; five echoes of an LMS5xx in CoLa-A have some 40 KB */

enum cola_dialect { COLA_A, COLA_B };

/* Reasons of refusal, beside the framer's own. */
enum cola_refusal { COLA_BAD_SUM = FRAMER_OWN, COLA_TOO_LONG, COLA_BAD_BYTE /* no text, or not a command word */ };

/* framer_scan, both directions, both dialects. */
int cola_scan_frame(void *ctx, const uint8_t *buf, size_t len, bool boundary);

/* What is inside a whole frame: the payload, from `s` on. */
enum cola_dialect cola_payload(const uint8_t *frame, size_t len, const uint8_t **ret_payload, size_t *ret_len);

/* The kinds of struct reply: the second letter of the command word decides. Its payload is the frame's, at most REPLY_MAX
 * bytes of it (a scan; nobody waits for more of one than that it came). */
enum cola_reply {
	COLA_READ,    /* sRA: value */
	COLA_WRITTEN, /* sWA */
	COLA_METHOD,  /* sAN: result */
	COLA_LATER,   /* sMA: accepted, the result comes later */
	COLA_EVENT,   /* sEA: event on or off */
	COLA_DATA,    /* sSN: event data */
	COLA_ERROR,   /* sFA: code */
	COLA_OTHER,
	COLA_B_FLAG = 256 /* added where the answer came in CoLa-B */
};
int cola_reply_kind(enum cola_dialect, const uint8_t *payload, size_t len);

/* Reading what stands behind the command word. Sticky: after a failure everything reads as 0 and `failed` stays. */
struct cola_reader {
	enum cola_dialect dialect;
	const uint8_t *at, *end;
	bool failed;
};
/* At the first value of a payload "sXX NAME ..."; false: another name. `name` without blanks. */
bool cola_reader_init(struct cola_reader *, enum cola_dialect, const uint8_t *payload, size_t len, const char *name);
uint32_t cola_read_u(struct cola_reader *, int bytes); /* 1, 2 or 4; a CoLa-A token that needs more fails */
int32_t cola_read_i(struct cola_reader *, int bytes);
float cola_read_float(struct cola_reader *); /* NaN and infinity read as 0 and fail */
/* As many characters as stand there; borrowed, not terminated. */
void cola_read_chars(struct cola_reader *, size_t n, const char **ret);
/* A string with its length before it (`bytes` of length in CoLa-B; hexadecimal in CoLa-A, blanks inside allowed). */
void cola_read_string(struct cola_reader *, int bytes, const char **ret, size_t *ret_len);
bool cola_reader_done(
    const struct cola_reader *); /* nothing is left, and nothing failed; a trailing blank is nothing */

/* Writing a telegram, request or answer: begin with the words, add values, end with the frame. */
struct cola_writer {
	enum cola_dialect dialect;
	uint8_t *bytes;
	size_t cap, len;
	bool failed; /* no room */
};
/* `words`: "sWN LMDscandatacfg". The buffer is the caller's. */
void cola_writer_init(struct cola_writer *, enum cola_dialect, uint8_t *bytes, size_t cap, const char *words);
void cola_write_u(struct cola_writer *, uint32_t value, int bytes);      /* CoLa-A: hexadecimal, no leading zeros */
void cola_write_i(struct cola_writer *, int32_t value, int bytes);       /* CoLa-A: two's complement, hexadecimal */
void cola_write_decimal(struct cola_writer *, int32_t value, int bytes); /* CoLa-A: with its sign, decimal */
void cola_write_digits(struct cola_writer *, uint32_t value,
                       int bytes); /* CoLa-A: all digits, e.g. the hash F4724744 */
void cola_write_float(struct cola_writer *, float value);
void cola_write_chars(struct cola_writer *, const char *, size_t n);
void cola_write_string(struct cola_writer *, const char *, size_t n, int bytes);
size_t cola_writer_end(struct cola_writer *); /* length of the whole frame; 0: no room */

/* sFA in words: "variable unknown"; never NULL. */
const char *cola_error_text(uint32_t code);

#endif
