/* What the files of the Modbus driver share: modbus.c (decoder and table), modbus_bus.c (threads that wait for libmodbus),
 * modbus_line.c (libmodbus), modbus_dialogue.c (set-up, faults, watchdog, sweeping), modbus_sequence.c (lists of writes).
 * Nobody else includes it, tests apart. */
#ifndef FACET_DRIVERS_MODBUS_PARTS_H
#define FACET_DRIVERS_MODBUS_PARTS_H

#include "drivers/driver.h"
#include "drivers/modbus_wire.h"

#define MODBUS_PERIOD_MIN_NS 2000000 /* between polls: nobody needs more than 500 angles a second */

/* Kinds of `struct reply`. */
enum modbus_reply {
	MODBUS_ANGLE,   /* payload: one double, rad, as decoded */
	MODBUS_WRITTEN, /* payload: u16 address as on the wire */
	MODBUS_READ,    /* payload: u16 function, u16 address, u16 value: one register that is not the angle */
	MODBUS_REFUSED  /* payload: u16 function, u16 address, u16 exception code (0: no valid answer came) */
};

/* A line or connection, for one thread (modbus_line.c). */
struct modbus_line {
	struct _modbus *modbus;
	bool serial;
	int64_t silence_ns, free_ns; /* between frames; it may be used from free_ns on */
};
int64_t modbus_line_now(void); /* CLOCK_MONOTONIC */
bool modbus_line_is_serial(const char *connect);
/* "host:port" or "[v6]:port" in two parts; false where it is neither. */
bool modbus_line_split(const char *connect, char ret_host[CONFIG_TEXT_MAX], char ret_port[8]);
int modbus_line_open(struct modbus_line *,
                     const struct config_device *); /* 0 or -errno: then it is to be closed, too */
void modbus_line_close(struct modbus_line *);
/* Asks and stamps, and puts the answer into the transaction, also a refusal. 0; -ETIMEDOUT, -EPROTO: nothing came, or no
 * valid answer, which is a refusal with code 0; another -errno: the line is lost. */
int modbus_line_ask(struct modbus_line *, int timeout_us, struct modbus_transaction *);
/* Reads away what still comes, until the line was silent for so long; at most four times as long. */
void modbus_line_drain(struct modbus_line *, int silence_us);

/* The link of modbus_bus.c. */
struct link *modbus_bus_open(const struct config_device *, char error[160]);
int modbus_bus_fd(const struct link *);
ssize_t modbus_bus_read(struct link *, uint8_t *buf, size_t cap, int64_t *t_ns);
ssize_t modbus_bus_write(struct link *, const uint8_t *bytes, size_t len);
void modbus_bus_error(const struct link *, int error, char ret[160]);
void modbus_bus_close(struct link *);

/* A list of writes under way (modbus_sequence.c). */
struct modbus_sequence {
	const struct config_writes *list; /* borrowed */
	enum modbus_sequence_state {
		MODBUS_SEQUENCE_WRITE, /* list->item[at] is to be written: then modbus_sequence_written */
		MODBUS_SEQUENCE_READ,  /* its `until` is to be read: then modbus_sequence_read */
		MODBUS_SEQUENCE_WAIT,  /* nothing before due_ns */
		MODBUS_SEQUENCE_DONE,
		MODBUS_SEQUENCE_FAILED /* `until` was not so in time; the register was `seen` last */
	} state;
	int at;
	uint16_t seen;
	int64_t due_ns, by_ns;
};
void modbus_sequence_begin(struct modbus_sequence *, const struct config_writes *);
enum modbus_sequence_state modbus_sequence_look(struct modbus_sequence *, int64_t t_ns);
void modbus_sequence_written(struct modbus_sequence *, int64_t t_ns);
void modbus_sequence_read(struct modbus_sequence *, uint16_t value, int64_t t_ns);

/* The dialogue of modbus_dialogue.c. */
struct dialogue *modbus_dialogue_create(const struct config *, int device);
void modbus_dialogue_destroy(struct dialogue *);
void modbus_dialogue_reset(struct dialogue *, int64_t t_ns);
void modbus_dialogue_reply(struct dialogue *, const struct reply *);
void modbus_dialogue_data(struct dialogue *, int64_t t_ns);
void modbus_dialogue_step(struct dialogue *, int64_t t_ns, struct dialogue_step *ret);
void modbus_dialogue_stop(struct dialogue *, int64_t t_ns);

#endif
