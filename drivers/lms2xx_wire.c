/* Telegrams of the SICK LMS2xx (200, 211, 220, 221, 291).
 *
 *   02 | address | length LE16 | command | data ... [status] | crc LE16        total = length + 6, nothing is stuffed
 *        00        command, data, status                       over everything before it
 *        80+       replies: command + 0x80, status last
 *
 *   ACK 06 or NAK 15, bare, stand before the reply to a request, at a telegram's boundary only: both bytes occur
 * inside. 92 status             understood, but not now (mode, password)       90 text status   power came on A0 result
 * status      BB ok fov LE16 resolution LE16 status          BA text status B1 version[7] mode device ... @107 fov LE16
 * resolution LE16 ... status    (two layouts, the short one 6 bytes less) F4 config[32|34] status, F7 ok config status:
 * config = blanking LE16, 2 bytes, availability, measuring mode, unit ...
 *
 *   B0 | head LE16 | n x LE16 | [scan index, telegram index] | status          head: 0-9 n, 11-12 part, 13 partial,
 *   B6 | samples | head ...                                                          14-15 unit (cm, mm, dm)
 *   B7 | start LE16 | stop LE16 | head ...        BF | samples | start | stop | head ...
 *   C4 | head | n x LE16 | m LE16 (10 bit) | start | stop | m x u8 | [indices] | status
 *   F5 | parts | x | start | stop | head (0-13 n, 14-15 unit) | n x (range LE16, reflectivity LE16) | status
 *
 * Odd things: a word's meaning depends on a measuring mode that the telegram does not say (it is in F4), the mode also
 * decides where the error codes lie; some units answer from address 81; the check sum shifts once per byte and mixes in
 * the byte before, it is no CRC of the books. Lengths are judged against the command's layout as soon as the header is
 * there, so that a broken length does not swallow the telegrams behind it. */
#include "drivers/lms2xx_wire.h"

#include <assert.h>
#include <string.h>

enum { STX = 0x02, HEADER = 4, FRAME = 6 };

static uint16_t get16(const uint8_t *p)
{
	return (uint16_t)(p[0] | p[1] << 8);
}

static void put16(uint8_t *p, uint16_t v)
{
	p[0] = (uint8_t)v;
	p[1] = (uint8_t)(v >> 8);
}

uint16_t lms2xx_crc(const uint8_t *bytes, size_t len)
{
	uint16_t crc = 0;
	uint8_t before = 0;
	for (size_t i = 0; i < len; i++) {
		const bool carry = (crc & 0x8000) != 0;
		crc = (uint16_t)(crc << 1);
		if (carry)
			crc ^= 0x8005;
		crc ^= (uint16_t)(before << 8 | bytes[i]);
		before = bytes[i];
	}
	return crc;
}

/* Where the head stands in a measurement's payload, and what else it has beside its values. */
struct scan_layout {
	uint8_t command, head, stride, rest; /* rest: bytes of a telegram without values or indices */
};

static const struct scan_layout scan_layouts[] = {
    {LMS2XX_SCAN, 1, 2, 4},
    {LMS2XX_SCAN_MEAN, 2, 2, 5},
    {LMS2XX_SCAN_RANGE, 5, 2, 8},
    {LMS2XX_SCAN_RANGE_MEAN, 6, 2, 9},
    {LMS2XX_SCAN_REFLECTIVITY, 1, 2, 10},
    {LMS2XX_PARTS_REFLECTIVITY, 7, 4, 10},
};

static const struct scan_layout *scan_layout(uint8_t command)
{
	for (size_t i = 0; i < sizeof scan_layouts / sizeof scan_layouts[0]; i++)
		if (scan_layouts[i].command == command)
			return &scan_layouts[i];
	return NULL;
}

bool lms2xx_is_scan(uint8_t command)
{
	return scan_layout(command) != NULL;
}

static unsigned head_count(const struct scan_layout *layout, uint16_t head)
{
	return head & (layout->command == LMS2XX_PARTS_REFLECTIVITY ? 0x3FFF : 0x03FF);
}

/* Does a payload of `length` bytes fit a count of n? Sizes with and without the two indices. */
static bool scan_size_fits(const struct scan_layout *layout, unsigned n, size_t length)
{
	const size_t least = layout->rest + (size_t)layout->stride * n;
	if (layout->command == LMS2XX_SCAN_REFLECTIVITY)
		return length >= least && length <= least + 1023 + 2;
	return length == least || length == least + 2;
}

/* Payload sizes of what is no measurement; 0, 0: any. */
static void reply_sizes(uint8_t command, size_t *ret_min, size_t *ret_max)
{
	static const struct {
		uint8_t command;
		uint16_t min, max;
	} sizes[] = {
	    {LMS2XX_POWER_ON, 2, 80},      {LMS2XX_RESET_DONE, 2, 2},       {LMS2XX_REJECTED, 2, 3},
	    {LMS2XX_MODE_REPLY, 3, 3},     {LMS2XX_STATUS_REPLY, 140, 170}, {LMS2XX_ERRORS_REPLY, 2, 256},
	    {LMS2XX_TYPE_REPLY, 2, 80},    {LMS2XX_VARIANT_REPLY, 7, 7},    {LMS2XX_KEEP_BAUD_REPLY, 2, 8},
	    {LMS2XX_CONFIG_REPLY, 34, 36}, {LMS2XX_CONFIG_WRITTEN, 35, 37},
	};
	*ret_min = 1;
	*ret_max = LMS2XX_PAYLOAD_MAX;
	for (size_t i = 0; i < sizeof sizes / sizeof sizes[0]; i++) {
		if (sizes[i].command == command) {
			*ret_min = sizes[i].min;
			*ret_max = sizes[i].max;
		}
	}
}

/* 0 so far so good (or not enough to say), else minus the reason. */
static int judge_size(const uint8_t *buf, size_t len, size_t length)
{
	if (len <= HEADER)
		return 0;
	const struct scan_layout *layout = scan_layout(buf[HEADER]);
	if (layout != NULL) {
		if (length < layout->rest)
			return -LMS2XX_BAD_SIZE;
		if (len < (size_t)HEADER + layout->head + 2)
			return 0;
		const unsigned n = head_count(layout, get16(buf + HEADER + layout->head));
		return scan_size_fits(layout, n, length) ? 0 : -LMS2XX_BAD_SIZE;
	}
	size_t min, max;
	reply_sizes(buf[HEADER], &min, &max);
	return length >= min && length <= max ? 0 : -LMS2XX_BAD_SIZE;
}

static int scan_end(const uint8_t *buf, size_t len, size_t length)
{
	if (len < length + FRAME)
		return FRAMER_MORE;
	if (lms2xx_crc(buf, length + HEADER) != get16(buf + length + HEADER))
		return -LMS2XX_BAD_CRC;
	return (int)(length + FRAME);
}

int lms2xx_scan_device(void *ctx, const uint8_t *buf, size_t len, bool boundary)
{
	(void)ctx;
	if (boundary && (buf[0] == LMS2XX_ACK || buf[0] == LMS2XX_NAK))
		return 1;
	if (buf[0] != STX || (len > 1 && buf[1] < 0x80))
		return -FRAMER_NO_START;
	if (len < HEADER)
		return FRAMER_MORE;
	const size_t length = get16(buf + 2);
	if (length == 0)
		return -LMS2XX_BAD_SIZE;
	if (length > LMS2XX_PAYLOAD_MAX)
		return -LMS2XX_TOO_LONG;
	const int r = judge_size(buf, len, length);
	return r < 0 ? r : scan_end(buf, len, length);
}

int lms2xx_scan_host(void *ctx, const uint8_t *buf, size_t len, bool boundary)
{
	(void)ctx;
	(void)boundary;
	if (buf[0] != STX || (len > 1 && buf[1] >= 0x80))
		return -FRAMER_NO_START;
	if (len < HEADER)
		return FRAMER_MORE;
	const size_t length = get16(buf + 2);
	if (length == 0)
		return -LMS2XX_BAD_SIZE;
	if (length > LMS2XX_REQUEST_MAX)
		return -LMS2XX_TOO_LONG;
	return scan_end(buf, len, length);
}

size_t lms2xx_encode(uint8_t address, const uint8_t *payload, size_t len, uint8_t *ret)
{
	assert(len > 0 && len <= LMS2XX_PAYLOAD_MAX);
	ret[0] = STX;
	ret[1] = address;
	put16(ret + 2, (uint16_t)len);
	memmove(ret + HEADER, payload, len);
	put16(ret + HEADER + len, lms2xx_crc(ret, HEADER + len));
	return len + FRAME;
}

bool lms2xx_decode_scan(const uint8_t *payload, size_t len, struct lms2xx_scan *ret)
{
	const struct scan_layout *layout = len > 0 ? scan_layout(payload[0]) : NULL;
	if (layout == NULL || len < layout->rest)
		return false;
	const uint16_t head = get16(payload + layout->head);
	const unsigned n = head_count(layout, head);
	if (!scan_size_fits(layout, n, len))
		return false;
	struct lms2xx_scan scan = {.command = payload[0],
	                           .unit = (uint8_t)(head >> 14),
	                           .n = (uint16_t)n,
	                           .stride = layout->stride,
	                           .value = payload + layout->head + 2,
	                           .status = payload[len - 1]};
	size_t bare = layout->rest + (size_t)layout->stride * n;
	switch (scan.command) {
	case LMS2XX_SCAN_REFLECTIVITY:
		scan.start = get16(scan.value + 2 * n + 2);
		scan.stop = get16(scan.value + 2 * n + 4);
		scan.amplitudes = get16(scan.value + 2 * n) & 0x03FF;
		scan.amplitude = scan.value + 2 * n + 6;
		bare += scan.amplitudes;
		break;
	case LMS2XX_SCAN_RANGE:
	case LMS2XX_SCAN_RANGE_MEAN:
	case LMS2XX_PARTS_REFLECTIVITY:
		scan.start = get16(payload + layout->head - 4);
		scan.stop = get16(payload + layout->head - 2);
		break;
	}
	if (len != bare && len != bare + 2)
		return false;
	if (scan.command == LMS2XX_SCAN_MEAN || scan.command == LMS2XX_SCAN_RANGE_MEAN)
		scan.samples = payload[1];
	if (scan.command != LMS2XX_PARTS_REFLECTIVITY) {
		scan.partial = (head & 0x2000) != 0;
		scan.part = scan.partial ? head >> 11 & 3 : 0;
	}
	scan.indexed = len == bare + 2;
	if (scan.indexed) {
		scan.scan_index = payload[len - 3];
		scan.telegram_index = payload[len - 2];
	}
	*ret = scan;
	return true;
}

size_t lms2xx_encode_scan(const struct lms2xx_scan *scan, uint8_t *ret)
{
	const struct scan_layout *layout = scan_layout(scan->command);
	assert(layout != NULL && layout->stride == 2 && scan->n <= LMS2XX_BEAMS_MAX);
	uint8_t payload[LMS2XX_PAYLOAD_MAX];
	size_t len = layout->head;
	payload[0] = scan->command;
	if (scan->command == LMS2XX_SCAN_RANGE) {
		put16(payload + 1, scan->start);
		put16(payload + 3, scan->stop);
	}
	const unsigned part = scan->partial ? 0x2000u | (scan->part & 3u) << 11 : 0;
	put16(payload + len, (uint16_t)(scan->n | part | (unsigned)scan->unit << 14));
	len += 2;
	for (unsigned i = 0; i < scan->n; i++, len += 2)
		memcpy(payload + len, scan->value + (size_t)i * scan->stride, 2);
	if (scan->indexed) {
		payload[len++] = scan->scan_index;
		payload[len++] = scan->telegram_index;
	}
	payload[len++] = scan->status;
	return lms2xx_encode(0x80, payload, len, ret);
}

int lms2xx_range_bits(int mode)
{
	switch (mode) {
	case 0x00:
	case 0x01:
	case 0x02:
		return 13;
	case 0x03:
	case 0x04:
		return 14;
	case 0x05:
	case 0x06:
		return 15;
	case 0x0F:
		return 16;
	default:
		return 0;
	}
}

/* Error codes count down from the largest number the range bits hold. */
enum { CODE_NO_ECHO = 0, CODE_DAZZLED = 1, CODE_OVERFLOW = 2, CODE_WEAK = 4, CODE_CHANNEL = 5, CODE_BEYOND_MAX = 8 };

enum beam_state lms2xx_range(uint16_t word, int mode, uint16_t *ret_range)
{
	const uint32_t max = (1u << lms2xx_range_bits(mode)) - 1;
	const uint32_t range = word & max;
	if (mode == 0x00 && (word & 0x8000) != 0)
		return BEAM_DAZZLED;
	if (range < max - CODE_BEYOND_MAX) {
		*ret_range = (uint16_t)range;
		return BEAM_OK;
	}
	switch (max - range) {
	case CODE_NO_ECHO:
		return BEAM_NO_ECHO;
	case CODE_DAZZLED:
		return BEAM_DAZZLED;
	case CODE_OVERFLOW:
		return BEAM_OVERFLOW;
	case CODE_WEAK:
		return BEAM_WEAK;
	case CODE_CHANNEL:
		return BEAM_CHANNEL_ERROR;
	case CODE_BEYOND_MAX:
		return BEAM_BEYOND_MAX;
	default:
		return BEAM_RESERVED;
	}
}

uint16_t lms2xx_word(enum beam_state state, double range, int mode)
{
	const uint32_t max = (1u << lms2xx_range_bits(mode)) - 1;
	switch (state) {
	case BEAM_OK:
		if (range >= 0 && range + 0.5 < max - CODE_BEYOND_MAX)
			return (uint16_t)(range + 0.5);
		return (uint16_t)(max - CODE_BEYOND_MAX);
	case BEAM_DAZZLED:
		return (uint16_t)(max - CODE_DAZZLED);
	case BEAM_OVERFLOW:
		return (uint16_t)(max - CODE_OVERFLOW);
	case BEAM_WEAK:
		return (uint16_t)(max - CODE_WEAK);
	case BEAM_CHANNEL_ERROR:
		return (uint16_t)(max - CODE_CHANNEL);
	case BEAM_BEYOND_MAX:
		return (uint16_t)(max - CODE_BEYOND_MAX);
	case BEAM_RESERVED:
		return (uint16_t)(max - 3);
	default:
		return (uint16_t)max;
	}
}

double lms2xx_unit_m(uint8_t unit)
{
	static const double unit_m[4] = {[LMS2XX_CM] = 0.01, [LMS2XX_MM] = 0.001, [LMS2XX_DM] = 0.1};
	return unit < 4 ? unit_m[unit] : 0;
}

bool lms2xx_decode_config(const uint8_t *payload, size_t len, struct lms2xx_config *ret)
{
	const size_t before = len > 0 && payload[0] == LMS2XX_CONFIG_WRITTEN ? 2 : 1;
	if (len < before + 1 || (before == 1 && payload[0] != LMS2XX_CONFIG_REPLY))
		return false;
	const size_t n = len - before - 1;
	if ((n != 32 && n != 34) || (before == 2 && payload[1] != 1))
		return false;
	*ret = (struct lms2xx_config){.len = n};
	memcpy(ret->bytes, payload + before, n);
	return true;
}

/* The divisor of the scanner's clock. */
static uint32_t word_baud(uint16_t word)
{
	switch (word) {
	case 0x8067:
		return 9600;
	case 0x8033:
		return 19200;
	case 0x8019:
		return 38400;
	case 0x8001:
		return 500000;
	default:
		return 0;
	}
}

bool lms2xx_decode_status(const uint8_t *payload, size_t len, struct lms2xx_status *ret)
{
	enum { LONG = 1 + 152 + 1, SHORT = 1 + 146 + 1, SHIFT = 6 };
	if (len < 140 || payload[0] != LMS2XX_STATUS_REPLY)
		return false;
	*ret = (struct lms2xx_status){.mode = payload[8], .device = payload[9]};
	if (len == LONG || len == SHORT) {
		const size_t shift = len == SHORT ? SHIFT : 0;
		ret->fov_deg = get16(payload + 107 - shift);
		ret->resolution_cdeg = get16(payload + 109 - shift);
		ret->baud = word_baud(get16(payload + 116 - shift));
	}
	return true;
}

bool lms2xx_decode_variant(const uint8_t *payload, size_t len, bool *ret_taken, int *ret_fov_deg,
                           int *ret_resolution_cdeg)
{
	if (len != 7 || payload[0] != LMS2XX_VARIANT_REPLY)
		return false;
	*ret_taken = payload[1] == 1;
	*ret_fov_deg = get16(payload + 2);
	*ret_resolution_cdeg = get16(payload + 4);
	return true;
}

static const struct {
	uint32_t baud;
	uint8_t mode;
} baud_modes[] = {
    {9600, LMS2XX_MODE_9600}, {19200, LMS2XX_MODE_19200}, {38400, LMS2XX_MODE_38400}, {500000, LMS2XX_MODE_500000}};

uint8_t lms2xx_baud_mode(uint32_t baud)
{
	for (size_t i = 0; i < sizeof baud_modes / sizeof baud_modes[0]; i++)
		if (baud_modes[i].baud == baud)
			return baud_modes[i].mode;
	return 0;
}

uint32_t lms2xx_mode_baud(uint8_t mode)
{
	for (size_t i = 0; i < sizeof baud_modes / sizeof baud_modes[0]; i++)
		if (baud_modes[i].mode == mode)
			return baud_modes[i].baud;
	return 0;
}
