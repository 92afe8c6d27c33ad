/* Drivers tim, lms1xx and lms5xx: one decoder, one dialogue, links by TCP and USB (cola.c joins them).
 * What the families differ in stands in one table, cola_family. */
#ifndef FACET_DRIVERS_COLA_H
#define FACET_DRIVERS_COLA_H

#include "drivers/cola_wire.h"
#include "drivers/driver.h"

struct cola_family {
	const char *driver; /* "tim", "lms1xx", "lms5xx" */
	bool stamp_at_end;  /* what the stamp marks unless the identity says otherwise (protocols B.5) */
	bool usb;           /* has a USB port */
	bool encoders;      /* has encoder inputs */
	bool waits_ready;   /* STlms has to say 7 before it measures */
	double measures_hz; /* expected scan rate before a telegram says it */
};
const struct cola_family *cola_family(const char *driver);

struct decoder *cola_decoder_create(const struct config_device *, int device);
void cola_decoder_destroy(struct decoder *);
void cola_decode(struct decoder *, const struct record *, const struct record_sink *);
void cola_counters(const struct decoder *, struct decoder_counters *ret);
void cola_timing(const struct decoder *, struct decoder_timing *ret);
void cola_decoder_state(struct decoder *, struct state *);

struct dialogue *cola_dialogue_create(const struct config *, int device);
void cola_dialogue_destroy(struct dialogue *);
void cola_dialogue_reset(struct dialogue *, int64_t t_ns);
void cola_dialogue_reply(struct dialogue *, const struct reply *);
void cola_dialogue_data(struct dialogue *, int64_t t_ns);
void cola_dialogue_step(struct dialogue *, int64_t t_ns, struct dialogue_step *ret);
void cola_dialogue_stop(struct dialogue *, int64_t t_ns);

/* A byte stream to a scanner: TCP (cola_tcp.c) or USB (cola_usb.c); `connect` decides. Answers as in driver.h. */
struct cola_stream {
	struct link *(*open)(const struct config_device *, char error[160]);
	int (*fd)(const struct link *);
	ssize_t (*read)(struct link *, uint8_t *buf, size_t cap, int64_t *t_ns);
	ssize_t (*write)(struct link *, const uint8_t *bytes, size_t len);
	void (*close)(struct link *);
	void (*error)(const struct link *, int error, char ret[160]); /* as link_error; may be NULL */
};
struct link {
	const struct cola_stream *stream; /* first member of what each of them allocates */
};
extern const struct cola_stream cola_tcp, cola_usb;

#define COLA_PORT        2112
#define COLA_USB_VENDOR  0x19a2
#define COLA_USB_PRODUCT 0x5001

#endif
