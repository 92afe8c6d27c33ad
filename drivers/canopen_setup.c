/* Set-up of a node. Each object and each PDO is a row of numbered steps; a step is a transfer, or nothing where the
 * node already is as wanted, so a node that was set up before is only read. */
#include "drivers/canopen_setup.h"

#include <assert.h>
#include <stdio.h>
#include <string.h>

#define MAPPING 0x200 /* from an object of communication parameters to its mapping */

/* Of an object. One that is watched (1016) reads its entries in the steps from ENTRIES on. */
enum { OBJECT_READ, OBJECT_WRITE, OBJECT_STEPS };
enum { WATCH_COUNT, WATCH_WRITE, WATCH_ENTRIES };
#define WATCH_ENTRIES_MAX 16

/* Of a PDO. */
enum {
	READ_COB,
	READ_PARAMETERS,
	READ_COUNT = READ_PARAMETERS + 3,
	READ_ENTRIES,
	WRITE_OFF = READ_ENTRIES + CANOPEN_PDO_ENTRIES,
	WRITE_PARAMETERS,
	WRITE_EMPTY = WRITE_PARAMETERS + 3,
	WRITE_ENTRIES,
	WRITE_COUNT = WRITE_ENTRIES + CANOPEN_PDO_ENTRIES,
	WRITE_COB,
	PDO_STEPS
};

static const struct {
	uint8_t sub, size;
} parameter[3] = {{2, 1}, {3, 2}, {5, 2}};

struct transfer {
	bool download;
	uint16_t index;
	uint8_t sub, size;
	uint32_t value;
};

void canopen_setup_init(struct canopen_setup *s, int node)
{
	memset(s, 0, sizeof *s);
	canopen_sdo_init(&s->sdo, node);
}

void canopen_setup_object(struct canopen_setup *s, const struct canopen_object *object)
{
	assert(s->objects < CANOPEN_SETUP_OBJECTS);
	assert(object->size >= 1 && object->size <= 4);
	s->object[s->objects++] = *object;
}

void canopen_setup_pdo(struct canopen_setup *s, const struct canopen_pdo *pdo)
{
	assert(s->pdos < CANOPEN_SETUP_PDOS);
	assert(pdo->n <= CANOPEN_PDO_ENTRIES);
	s->pdo[s->pdos++] = *pdo;
}

void canopen_setup_identify(struct canopen_setup *s)
{
	canopen_setup_object(s, &(struct canopen_object){.index = 0x1000, .size = 4, .how = CANOPEN_LEARN});
	for (uint8_t sub = 1; sub <= 4; sub++) /* vendor, product, revision, serial number */
		canopen_setup_object(
		    s, &(struct canopen_object){
		           .index = 0x1018, .sub = sub, .size = 4, .how = CANOPEN_LEARN, .optional = true});
}

void canopen_setup_heartbeat(struct canopen_setup *s, uint16_t producer_ms, int master, uint16_t consumer_ms)
{
	const uint32_t watch = (uint32_t)master << 16 | consumer_ms;

	if (producer_ms)
		canopen_setup_object(
		    s, &(struct canopen_object){.index = 0x1017, .size = 2, .how = CANOPEN_KEEP, .value = producer_ms});
	if (consumer_ms)
		canopen_setup_object(
		    s, &(struct canopen_object){.index = 0x1016, .size = 4, .how = CANOPEN_WATCH, .value = watch});
}

static uint32_t mask(uint8_t size)
{
	return UINT32_MAX >> 8 * (4 - size);
}

/* What the node holds after PDO `p` was set: its bit 30 as it was. */
static uint32_t wanted_cob(const struct canopen_setup *s, const struct canopen_pdo *p)
{
	const uint32_t id = CANOPEN_COB_ID | CANOPEN_COB_EXTENDED;

	return ((p->cob & id ? p->cob : s->cob) & id) | (s->cob & CANOPEN_COB_NO_RTR);
}

/* -1: as it is. */
static int wanted_parameter(const struct canopen_pdo *p, int i)
{
	const int wanted[3] = {p->type, p->inhibit, p->timer};

	return wanted[i];
}

static bool pdo_differs(const struct canopen_setup *s, const struct canopen_pdo *p)
{
	bool differs = s->mapping_differs || s->cob != wanted_cob(s, p);

	for (int i = 0; i < 3; i++)
		differs |= s->parameter_differs[i];
	return differs;
}

/* The transfer of the step at hand; false: none is needed. */
static bool pdo_read(const struct canopen_setup *s, const struct canopen_pdo *p, struct transfer *ret)
{
	const int i = s->step - READ_PARAMETERS, entry = s->step - READ_ENTRIES;

	*ret = (struct transfer){.index = p->index};
	if (s->step == READ_COB) {
		ret->sub = 1;
		ret->size = 4;
		return true;
	}
	if (p->off)
		return false;
	if (s->step < READ_COUNT) {
		ret->sub = parameter[i].sub;
		ret->size = parameter[i].size;
		return wanted_parameter(p, i) >= 0;
	}
	ret->index += MAPPING;
	ret->size = s->step == READ_COUNT ? 1 : 4;
	ret->sub = (uint8_t)(s->step == READ_COUNT ? 0 : entry + 1);
	return s->step == READ_COUNT ? p->n >= 0 : entry < p->n && !s->mapping_differs;
}

static bool pdo_write_mapping(const struct canopen_setup *s, const struct canopen_pdo *p, struct transfer *ret)
{
	const int entry = s->step - WRITE_ENTRIES;

	ret->index += MAPPING;
	ret->size = 1;
	if (s->step == WRITE_COUNT) {
		ret->value = (uint32_t)p->n;
		return s->mapping_differs && p->n > 0;
	}
	if (s->step >= WRITE_ENTRIES) {
		ret->sub = (uint8_t)(entry + 1);
		ret->size = 4;
		ret->value = entry < p->n ? p->entry[entry] : 0;
		return s->mapping_differs && entry < p->n;
	}
	return s->mapping_differs;
}

static bool pdo_write(const struct canopen_setup *s, const struct canopen_pdo *p, struct transfer *ret)
{
	const int i = s->step - WRITE_PARAMETERS;

	*ret = (struct transfer){.download = true, .index = p->index};
	if (s->step == WRITE_OFF || s->step == WRITE_COB) {
		ret->sub = 1;
		ret->size = 4;
		ret->value = s->step == WRITE_OFF ? s->cob | CANOPEN_COB_OFF : wanted_cob(s, p);
		if (s->step == WRITE_OFF)
			return !(s->cob & CANOPEN_COB_OFF) && (p->off || s->differs);
		return !p->off && s->differs;
	}
	if (s->step < WRITE_EMPTY) {
		ret->sub = parameter[i].sub;
		ret->size = parameter[i].size;
		ret->value = (uint32_t)wanted_parameter(p, i);
		return s->parameter_differs[i];
	}
	return pdo_write_mapping(s, p, ret);
}

static bool object_transfer(const struct canopen_setup *s, const struct canopen_object *o, struct transfer *ret)
{
	const bool read = o->how != CANOPEN_WRITE && s->step == OBJECT_READ;

	*ret = (struct transfer){
	    .download = !read, .index = o->index, .sub = o->sub, .size = o->size, .value = o->value & mask(o->size)};
	if (s->step == OBJECT_READ)
		return read;
	return o->how == CANOPEN_WRITE || (o->how == CANOPEN_KEEP && s->differs);
}

/* The entry to be written is known when all were read. */
static bool watch_transfer(const struct canopen_setup *s, const struct canopen_object *o, struct transfer *ret)
{
	*ret = (struct transfer){.index = o->index, .size = o->size, .value = o->value};
	if (s->step == WATCH_COUNT) {
		ret->size = 1;
	} else if (s->step == WATCH_WRITE) {
		ret->download = true;
		ret->sub = (uint8_t)s->free_sub;
		return s->differs;
	} else {
		ret->sub = (uint8_t)(s->step - WATCH_ENTRIES + 1);
	}
	return true;
}

/* Nothing is known of what comes next. */
static void next_item(struct canopen_setup *s)
{
	s->at++;
	s->step = 0;
	s->differs = s->mapping_differs = false;
	memset(s->parameter_differs, 0, sizeof s->parameter_differs);
	s->free_sub = 0;
}

static struct canopen_object *object_at(struct canopen_setup *s)
{
	return s->at < s->objects ? &s->object[s->at] : NULL;
}

static struct canopen_pdo *pdo_at(struct canopen_setup *s)
{
	return s->at - s->objects < s->pdos ? &s->pdo[s->at - s->objects] : NULL;
}

/* Steps to the next that needs a transfer. */
static bool seek(struct canopen_setup *s, struct transfer *ret)
{
	for (;;) {
		const struct canopen_object *o = object_at(s);
		const struct canopen_pdo *p = o ? NULL : pdo_at(s);
		bool needed;
		int steps;

		if (!o && !p)
			return false;
		if (o && o->how == CANOPEN_WATCH) {
			needed = watch_transfer(s, o, ret);
			steps = WATCH_ENTRIES + WATCH_ENTRIES_MAX;
		} else if (o) {
			needed = object_transfer(s, o, ret);
			steps = OBJECT_STEPS;
		} else {
			needed = s->step < WRITE_OFF ? pdo_read(s, p, ret) : pdo_write(s, p, ret);
			steps = PDO_STEPS;
		}
		if (needed)
			return true;
		if (++s->step >= steps || (o && o->how == CANOPEN_WATCH))
			next_item(s);
		else if (p && s->step == WRITE_OFF)
			s->differs = !p->off && pdo_differs(s, p);
	}
}

static void go_on(struct canopen_setup *s)
{
	struct transfer t;

	if (!seek(s, &t)) {
		s->state = CANOPEN_SETUP_DONE;
	} else if (t.download) {
		canopen_sdo_write(&s->sdo, t.index, t.sub, t.size, t.value);
	} else {
		canopen_sdo_upload(&s->sdo, t.index, t.sub);
	}
}

void canopen_setup_begin(struct canopen_setup *s)
{
	for (int i = 0; i < s->objects; i++) {
		s->object[i].known = false;
		s->object[i].abort = 0;
	}
	s->state = CANOPEN_SETUP_BUSY;
	s->error[0] = 0;
	s->abort = 0;
	s->written = 0;
	s->at = -1;
	next_item(s);
	go_on(s);
}

static void fail(struct canopen_setup *s)
{
	const struct canopen_sdo *c = &s->sdo;
	const char *why = canopen_wire_abort_text(c->abort);

	s->state = CANOPEN_SETUP_FAILED;
	s->abort = c->abort;
	if (c->abort == CANOPEN_ABORT_TIMEOUT && !c->refused)
		snprintf(s->error, sizeof s->error,
		         "node %d does not answer (object %04X:%02X); is it on, and its id and bit rate right?",
		         c->node, c->index, c->sub);
	else if (c->download)
		snprintf(s->error, sizeof s->error, "object %04X:%02X of node %d cannot be set to 0x%0*X: %s (%08X)",
		         c->index, c->sub, c->node, (int)c->len * 2, canopen_sdo_number(c, 4), why, c->abort);
	else
		snprintf(s->error, sizeof s->error, "object %04X:%02X of node %d cannot be read: %s (%08X)", c->index,
		         c->sub, c->node, why, c->abort);
}

static bool is_missing(uint32_t abort)
{
	return abort == CANOPEN_ABORT_NO_OBJECT || abort == CANOPEN_ABORT_NO_SUB;
}

/* A node that does not answer at all lacks no object. */
static bool was_refused(const struct canopen_setup *s)
{
	return s->sdo.state == CANOPEN_SDO_FAILED && s->sdo.refused;
}

static void object_done(struct canopen_setup *s, struct canopen_object *o)
{
	const bool good = s->sdo.state == CANOPEN_SDO_DONE;

	if (!good && o->how == CANOPEN_KEEP && s->step == OBJECT_READ && was_refused(s) &&
	    s->sdo.abort == CANOPEN_ABORT_WRITE_ONLY) {
		s->differs = true;
		s->step++;
	} else if (!good && (!o->optional || !was_refused(s))) {
		fail(s);
	} else if (!good) {
		o->abort = s->sdo.abort;
		next_item(s);
	} else {
		o->known = true;
		o->read = canopen_sdo_number(&s->sdo, o->size);
		s->differs = o->read != (o->value & mask(o->size));
		if (s->step++ == OBJECT_WRITE)
			next_item(s);
	}
}

static void watch_fail(struct canopen_setup *s)
{
	s->state = CANOPEN_SETUP_FAILED;
	s->abort = CANOPEN_ABORT_MEMORY;
	snprintf(s->error, sizeof s->error,
	         "node %d already watches the heartbeats of as many others as it can; free an entry of object 1016",
	         s->sdo.node);
}

/* Every entry was read. */
static void watch_judge(struct canopen_setup *s, struct canopen_object *o)
{
	if (s->free_sub) {
		s->differs = true;
		s->step = WATCH_WRITE;
	} else if (o->optional) {
		o->abort = CANOPEN_ABORT_MEMORY;
		next_item(s);
	} else {
		watch_fail(s);
	}
}

static void watch_entry(struct canopen_setup *s, struct canopen_object *o)
{
	const int sub = s->step - WATCH_ENTRIES + 1;
	const uint32_t entry = canopen_sdo_number(&s->sdo, 4);
	const bool same_node = (entry >> 16 & 0x7f) == (o->value >> 16 & 0x7f);
	const bool is_free = (entry >> 16 & 0x7f) == 0 || (entry & 0xffff) == 0;

	if (entry == o->value) {
		o->known = true;
		o->read = entry;
		next_item(s);
		return;
	}
	if (same_node || (is_free && !s->free_sub))
		s->free_sub = sub;
	s->step++;
	if (same_node || sub >= (int)s->count)
		watch_judge(s, o);
}

static void watch_done(struct canopen_setup *s, struct canopen_object *o)
{
	if (s->sdo.state != CANOPEN_SDO_DONE) {
		object_done(s, o);
	} else if (s->step == WATCH_WRITE) {
		o->known = true;
		o->read = o->value;
		next_item(s);
	} else if (s->step == WATCH_COUNT) {
		s->count = canopen_sdo_number(&s->sdo, 1);
		s->count = s->count < WATCH_ENTRIES_MAX ? s->count : WATCH_ENTRIES_MAX;
		s->step = WATCH_ENTRIES;
		if (s->count == 0)
			watch_judge(s, o);
	} else {
		watch_entry(s, o);
	}
}

/* Of PDO `p`, as read. */
static void pdo_learn(struct canopen_setup *s, const struct canopen_pdo *p)
{
	const int i = s->step - READ_PARAMETERS, entry = s->step - READ_ENTRIES;
	const uint32_t value = canopen_sdo_number(&s->sdo, 4);

	if (s->step == READ_COB)
		s->cob = value;
	else if (s->step < READ_COUNT)
		s->parameter_differs[i] = (value & mask(parameter[i].size)) != (uint32_t)wanted_parameter(p, i);
	else if (s->step == READ_COUNT)
		s->mapping_differs = (value & 0xff) != (uint32_t)p->n;
	else if (s->step < WRITE_OFF)
		s->mapping_differs = value != p->entry[entry];
}

static void pdo_done(struct canopen_setup *s, const struct canopen_pdo *p)
{
	const bool missing = was_refused(s) && is_missing(s->sdo.abort);
	/* Timers are had by few; 0 is what a node without one does. */
	const bool timer = s->step > READ_PARAMETERS && s->step < READ_COUNT;

	if (s->sdo.state == CANOPEN_SDO_DONE) {
		pdo_learn(s, p);
	} else if (missing && s->step == READ_COB && (p->optional || p->off)) {
		next_item(s);
		return;
	} else if (!(missing && timer)) {
		fail(s);
		return;
	}
	if (++s->step == WRITE_OFF)
		s->differs = !p->off && pdo_differs(s, p);
	if (s->step == PDO_STEPS)
		next_item(s);
}

void canopen_setup_answer(struct canopen_setup *s, const uint8_t *bytes, size_t len)
{
	if (s->state == CANOPEN_SETUP_BUSY)
		canopen_sdo_answer(&s->sdo, bytes, len);
}

/* A transfer has ended. */
static void take(struct canopen_setup *s)
{
	struct canopen_object *o = object_at(s);

	if (s->sdo.state == CANOPEN_SDO_DONE && s->sdo.download)
		s->written++;
	if (o && o->how == CANOPEN_WATCH)
		watch_done(s, o);
	else if (o)
		object_done(s, o);
	else
		pdo_done(s, pdo_at(s));
	if (s->state == CANOPEN_SETUP_BUSY)
		go_on(s);
}

bool canopen_setup_step(struct canopen_setup *s, int64_t t_ns, struct can_frame_at *ret)
{
	for (;;) {
		if (canopen_sdo_step(&s->sdo, t_ns, ret))
			return true;
		if (s->state != CANOPEN_SETUP_BUSY || s->sdo.state == CANOPEN_SDO_BUSY)
			return false;
		take(s);
	}
}

int64_t canopen_setup_deadline(const struct canopen_setup *s)
{
	if (s->state == CANOPEN_SETUP_BUSY && s->sdo.state != CANOPEN_SDO_BUSY)
		return INT64_MIN;
	return canopen_sdo_deadline(&s->sdo);
}

bool canopen_setup_value(const struct canopen_setup *s, uint16_t index, uint8_t sub, uint32_t *ret)
{
	for (int i = 0; i < s->objects; i++) {
		const struct canopen_object *o = &s->object[i];

		if (o->index == index && o->sub == sub && o->known) {
			*ret = o->read;
			return true;
		}
	}
	return false;
}
