/* The three parts of driver_lms2xx (see driver.h): lms2xx_decoder.c, lms2xx_dialogue.c, and the link in lms2xx.c. */
#ifndef FACET_DRIVERS_LMS2XX_H
#define FACET_DRIVERS_LMS2XX_H

#include "drivers/driver.h"

struct decoder *lms2xx_decoder_create(const struct config_device *, int device);
void lms2xx_decoder_destroy(struct decoder *);
void lms2xx_decode(struct decoder *, const struct record *, const struct record_sink *);
void lms2xx_counters(const struct decoder *, struct decoder_counters *ret);
void lms2xx_timing(const struct decoder *, struct decoder_timing *ret);
void lms2xx_decoder_state(struct decoder *, struct state *);

struct dialogue *lms2xx_dialogue_create(const struct config *, int device);
void lms2xx_dialogue_destroy(struct dialogue *);
void lms2xx_dialogue_reset(struct dialogue *, int64_t t_ns);
void lms2xx_dialogue_reply(struct dialogue *, const struct reply *);
void lms2xx_dialogue_data(struct dialogue *, int64_t t_ns);
void lms2xx_dialogue_step(struct dialogue *, int64_t t_ns, struct dialogue_step *ret);
void lms2xx_dialogue_stop(struct dialogue *, int64_t t_ns);

/* Limits that the protocol sets to the host (protocols A.9), kept with a margin for a busy one. */
#define LMS2XX_TICK_NS   1000000   /* at 500 kBd: a byte each, the scanner wants 55 us .. 6 ms between bytes */
#define LMS2XX_GAP_NS    6000000   /* a longer gap: the telegram is repeated ... */
#define LMS2XX_PAUSE_NS  30000000  /* ... after this time; a NAK likewise */
#define LMS2XX_SETTLE_NS 250000000 /* after the rate was changed */
#define LMS2XX_ACK_NS    500000000
#define LMS2XX_REPLY_NS  3000000000
#define LMS2XX_WRITE_NS  15000000000 /* the configuration goes to an EEPROM */
#define LMS2XX_QUIET_NS  2000000000  /* streaming without a valid telegram */
#define LMS2XX_STALE_NS  250000000   /* a begun telegram gets its end within this time or never */
#define LMS2XX_TRIES     3

#endif
