/* SDO client. A transfer is a row of requests, each waiting for its answer:
 *
 *    begin --> [segment -->]* done            of up to 4 bytes the begin is all
 *
 * Segments carry no index, only a bit that toggles, and answers may come late. So an answer counts only while a request
 * is out, of its kind, at its step, and about its object; whatever else comes is counted and left. When the bit does
 * not toggle (a frame can arrive twice on a disturbed bus) or nothing comes, the node is told by an abort, which ends
 * what it thinks of the transfer, before it is begun anew. */
#include "drivers/canopen_sdo.h"

#include <assert.h>
#include <string.h>

#define SEGMENT   7
#define EXPEDITED 4

void canopen_sdo_init(struct canopen_sdo *c, int node)
{
	memset(c, 0, sizeof *c);
	c->node = node;
	c->deadline_ns = INT64_MAX;
}

/* The next step will say so. */
static void say_abort(struct canopen_sdo *c, uint32_t code)
{
	c->abort_first = code;
	c->abort_index = c->index;
	c->abort_sub = c->sub;
}

/* From the beginning of the transfer. */
static void start(struct canopen_sdo *c)
{
	c->begun = c->toggle = c->announced = c->sized = false;
	c->at = c->size = 0;
	if (!c->download)
		c->len = 0;
	c->send = true;
	c->deadline_ns = INT64_MAX;
}

static void end(struct canopen_sdo *c, bool good)
{
	c->state = good ? CANOPEN_SDO_DONE : CANOPEN_SDO_FAILED;
	c->send = false;
	c->deadline_ns = INT64_MAX;
}

static void fail(struct canopen_sdo *c, uint32_t code, bool refused)
{
	c->abort = code ? code : CANOPEN_ABORT_GENERAL;
	c->refused = refused;
	if (!refused)
		say_abort(c, code);
	end(c, false);
}

static void again(struct canopen_sdo *c, uint32_t code)
{
	if (++c->tries >= CANOPEN_SDO_TRIES) {
		fail(c, code, false);
		return;
	}
	say_abort(c, code);
	start(c);
}

static void begin(struct canopen_sdo *c, uint16_t index, uint8_t sub, bool download)
{
	if (c->state == CANOPEN_SDO_BUSY && (c->begun || !c->send))
		say_abort(c, CANOPEN_ABORT_GENERAL);
	c->state = CANOPEN_SDO_BUSY;
	c->index = index;
	c->sub = sub;
	c->download = download;
	c->abort = 0;
	c->refused = false;
	c->tries = 0;
	start(c);
}

void canopen_sdo_upload(struct canopen_sdo *c, uint16_t index, uint8_t sub)
{
	begin(c, index, sub, false);
}

void canopen_sdo_download(struct canopen_sdo *c, uint16_t index, uint8_t sub, const void *data, size_t len)
{
	assert(len <= CANOPEN_SDO_MAX);
	begin(c, index, sub, true);
	c->len = len;
	if (len)
		memcpy(c->data, data, len);
}

void canopen_sdo_write(struct canopen_sdo *c, uint16_t index, uint8_t sub, uint8_t size, uint32_t value)
{
	uint8_t data[4];

	assert(size >= 1 && size <= sizeof data);
	for (int i = 0; i < 4; i++)
		data[i] = (uint8_t)(value >> 8 * i);
	canopen_sdo_download(c, index, sub, data, size);
}

/* Bytes of the segment that begins at `at`. */
static uint8_t segment(const struct canopen_sdo *c)
{
	return (uint8_t)(c->len - c->at < SEGMENT ? c->len - c->at : SEGMENT);
}

static struct canopen_wire_sdo request(const struct canopen_sdo *c)
{
	struct canopen_wire_sdo sdo = {.index = c->index, .sub = c->sub, .toggle = c->toggle};

	if (!c->download) {
		sdo.kind = c->begun ? CANOPEN_SDO_UPLOAD_SEGMENT : CANOPEN_SDO_UPLOAD;
	} else if (c->begun) {
		sdo.kind = CANOPEN_SDO_DOWNLOAD_SEGMENT;
		sdo.len = segment(c);
		sdo.last = c->at + sdo.len == c->len;
		memcpy(sdo.data, c->data + c->at, sdo.len);
	} else {
		sdo.kind = CANOPEN_SDO_DOWNLOAD;
		sdo.sized = true;
		sdo.size = (uint32_t)c->len;
		sdo.expedited = c->len >= 1 && c->len <= EXPEDITED;
		sdo.len = sdo.expedited ? (uint8_t)c->len : 0;
		memcpy(sdo.data, c->data, sdo.len);
	}
	return sdo;
}

static struct can_frame_at frame_of(const struct canopen_sdo *c, const struct canopen_wire_sdo *sdo)
{
	uint8_t data[8];

	canopen_wire_put_request(sdo, data);
	return can_wire_frame(CANOPEN_SDO_REQUEST + (uint32_t)c->node, data, sizeof data);
}

bool canopen_sdo_step(struct canopen_sdo *c, int64_t t_ns, struct can_frame_at *ret)
{
	struct canopen_wire_sdo sdo;

	if (c->state == CANOPEN_SDO_BUSY && !c->send && t_ns >= c->deadline_ns)
		again(c, CANOPEN_ABORT_TIMEOUT);
	if (c->abort_first) {
		sdo = (struct canopen_wire_sdo){
		    .kind = CANOPEN_SDO_ABORT, .index = c->abort_index, .sub = c->abort_sub, .abort = c->abort_first};
		c->abort_first = 0;
		*ret = frame_of(c, &sdo);
		return true;
	}
	if (!c->send)
		return false;
	sdo = request(c);
	c->send = false;
	c->deadline_ns = t_ns + CANOPEN_SDO_TIMEOUT_NS;
	*ret = frame_of(c, &sdo);
	return true;
}

int64_t canopen_sdo_deadline(const struct canopen_sdo *c)
{
	return c->abort_first || c->send ? INT64_MIN : c->deadline_ns;
}

static void upload_begun(struct canopen_sdo *c, const struct canopen_wire_sdo *sdo)
{
	c->sized = sdo->sized;
	if (sdo->expedited) {
		c->len = sdo->len;
		memcpy(c->data, sdo->data, sdo->len);
		end(c, true);
		return;
	}
	c->begun = c->send = true;
	c->announced = sdo->sized;
	c->size = sdo->size;
	if (c->announced && c->size > CANOPEN_SDO_MAX)
		fail(c, CANOPEN_ABORT_MEMORY, false);
}

static void upload_segment(struct canopen_sdo *c, const struct canopen_wire_sdo *sdo)
{
	const size_t most = c->announced ? c->size : CANOPEN_SDO_MAX;

	if (sdo->toggle != c->toggle) {
		again(c, CANOPEN_ABORT_TOGGLE);
		return;
	}
	if (sdo->len == 0 && !sdo->last) { /* and so on for ever */
		fail(c, CANOPEN_ABORT_LENGTH, false);
		return;
	}
	if (sdo->len > most - c->len) {
		fail(c, c->announced ? CANOPEN_ABORT_LENGTH : CANOPEN_ABORT_MEMORY, false);
		return;
	}
	memcpy(c->data + c->len, sdo->data, sdo->len);
	c->len += sdo->len;
	c->toggle = !c->toggle;
	c->send = true;
	if (sdo->last && c->announced && c->len < c->size)
		fail(c, CANOPEN_ABORT_LENGTH, false);
	else if (sdo->last)
		end(c, true);
	c->sized |= sdo->last;
}

static void download_begun(struct canopen_sdo *c)
{
	if (c->len >= 1 && c->len <= EXPEDITED)
		end(c, true);
	else
		c->begun = c->send = true;
}

static void download_segment(struct canopen_sdo *c, const struct canopen_wire_sdo *sdo)
{
	if (sdo->toggle != c->toggle) {
		again(c, CANOPEN_ABORT_TOGGLE);
		return;
	}
	c->at += segment(c);
	c->toggle = !c->toggle;
	c->send = true;
	if (c->at == c->len)
		end(c, true);
}

bool canopen_sdo_answer(struct canopen_sdo *c, const uint8_t *bytes, size_t len)
{
	struct canopen_wire_sdo sdo;
	const bool waits = c->state == CANOPEN_SDO_BUSY && !c->send;

	if (!waits || !canopen_wire_parse_answer(bytes, len, &sdo)) {
		c->ignored++;
		return false;
	}
	const bool ours = sdo.index == c->index && sdo.sub == c->sub;

	if (sdo.kind == CANOPEN_SDO_ABORT && ours) {
		fail(c, sdo.abort, true);
	} else if (sdo.kind == CANOPEN_SDO_UPLOAD && ours && !c->download && !c->begun) {
		upload_begun(c, &sdo);
	} else if (sdo.kind == CANOPEN_SDO_DOWNLOAD && ours && c->download && !c->begun) {
		download_begun(c);
	} else if (sdo.kind == CANOPEN_SDO_UPLOAD_SEGMENT && !c->download && c->begun) {
		upload_segment(c, &sdo);
	} else if (sdo.kind == CANOPEN_SDO_DOWNLOAD_SEGMENT && c->download && c->begun) {
		download_segment(c, &sdo);
	} else {
		c->ignored++;
		return false;
	}
	return true;
}

uint32_t canopen_sdo_number(const struct canopen_sdo *c, uint8_t size)
{
	return canopen_wire_number(c->data, c->len < size ? c->len : size);
}
