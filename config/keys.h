/* The one table of configuration keys: name, type, default, range, unit, help, and for which driver (style, rule 32).
 * Checks, messages and the commented manual come from it. */
#ifndef FACET_CONFIG_KEYS_H
#define FACET_CONFIG_KEYS_H

#include <stdbool.h>
#include <stdio.h>

#include "config/config.h"
#include "config/units.h"

/* A map of keys in the file. */
enum key_group {
	GROUP_TOP,
	GROUP_MAP,
	GROUP_ROBOT,
	GROUP_BOX,
	GROUP_MOUNT,
	GROUP_FRAME,
	GROUP_DEVICE,
	GROUP_REGISTER,
	GROUP_WRITE,
	GROUP_UNTIL,
	GROUP_STROBE,
	GROUP_WATCHDOG,
	GROUP_STATUS,
	GROUP_SIGNAL,
	GROUP_COUNTER,
	GROUP_VALID,
	GROUP_MUX,
	GROUP_COUNT,
	GROUP_HOMING,
	GROUP_ENCODER,
	GROUP_SWEEP,
	GROUP_LISTEN,
	GROUP_TLS,
	GROUP_RECORD,
	GROUP_STATE,
	GROUPS
};

enum key_type {
	KEY_GROUP,     /* a map of the keys of `inner`; offset: where it begins */
	KEY_DEVICES,   /* the list of devices */
	KEY_SWITCH,    /* bool: on|off, yes|no, true|false */
	KEY_INTEGER,   /* integer of `size` bytes; with `choices`: one of those */
	KEY_REAL,      /* double, SI */
	KEY_DURATION,  /* int64_t, ns */
	KEY_CHOICE,    /* an enum: the place of the word in `choices` */
	KEY_LETTER,    /* char: the first letter of the word, in capitals */
	KEY_TEXT,      /* char[size] */
	KEY_TEXTS,     /* char[CONFIG_LISTEN_MAX][CONFIG_TEXT_MAX] followed by an int: how many */
	KEY_PAIR,      /* [from, to]: two doubles, from < to */
	KEY_VECTOR,    /* [x, y, z]: three doubles */
	KEY_TRANSFORM, /* {xyz, rpy} -> struct transform */
	KEY_REGISTER,  /* a Modbus register map */
	KEY_SIGNAL,    /* a number in a CAN frame */
	KEY_TILT,      /* a device's name, or a fixed angle */
	KEY_VARIANT,   /* FIELD_OF_VIEW/RESOLUTION in degrees */
	KEY_MASKS,     /* a list of [from, to] */
	KEY_WRITES     /* a list of {address, value, ...} -> struct config_writes */
};

/* Drivers a key of a device belongs to. */
#define KEY_LMS2XX   1u
#define KEY_MODBUS   2u
#define KEY_POSE     4u
#define KEY_TIM      8u
#define KEY_LMS1XX   16u
#define KEY_LMS5XX   32u
#define KEY_CAN      64u
#define KEY_CANOPEN  128u
#define KEY_ODOMETRY 256u
#define KEY_CARMEN   512u
#define KEY_COLA     (KEY_TIM | KEY_LMS1XX | KEY_LMS5XX)
#define KEY_SCANNER  (KEY_LMS2XX | KEY_COLA | KEY_CARMEN)
#define KEY_ON_CAN   (KEY_CAN | KEY_CANOPEN | KEY_ODOMETRY)
#define KEY_SERVO    (KEY_MODBUS | KEY_CANOPEN) /* those that can be commanded */
#define KEY_ALL      1023u

struct key {
	enum key_group group;
	const char *name;
	enum key_type type;
	unsigned drivers;    /* GROUP_DEVICE: whose; 0 elsewhere */
	const char *preset;  /* the default, as written in YAML; NULL: none */
	const char *example; /* what the manual shows instead */
	bool required;
	enum dimension dimension;
	double min, max;     /* SI; where both are 0 any number will do */
	const char *choices; /* `a|b|c` */
	const char *word;    /* a word instead of a number ... */
	int word_value;      /* ... and what it stands for */
	enum key_group inner;
	size_t offset, size; /* in the structure of the group; size 0: checked, not stored */
	size_t count;        /* KEY_TEXTS: offset of the int that says how many there are */
	size_t flag;         /* offset of a bool there that says the key was written; 0: none */
	const char *later;   /* only the default works so far; what comes later */
	const char *help;
};

extern const struct key key_table[]; /* ends with a NULL name */

/* The key of that name for one of `drivers` (0: any); NULL: there is none. */
const struct key *keys_find(enum key_group, const char *name, unsigned drivers);

/* The key of that group whose name is nearest by edit distance. Never NULL for a group that has keys. */
const struct key *keys_nearest(enum key_group, const char *name, unsigned drivers);

/* Insertions, deletions, replacements and swaps of neighbours between two words; words beyond 63 letters are cut. */
int keys_distance(const char *a, const char *b);

/* The bit of a driver's name, 0: unknown. */
unsigned keys_driver(const char *name);
const char *keys_driver_name(unsigned bit);

/* "0.01m .. 1m", "one of distance, hoppe, direct"; empty where anything goes. */
void keys_print_range(const struct key *, char *ret, size_t cap);

/* The commented manual, config/facetd.yaml: itself a valid configuration. */
void keys_write_manual(FILE *);

#endif
