/* Reading a tree by the table of keys; shared by config.c, reader.c and check.c only. */
#ifndef FACET_CONFIG_READER_H
#define FACET_CONFIG_READER_H

#include "config/config.h"
#include "config/keys.h"
#include "config/yaml_tree.h"

#define READER_PATH_MAX  128
#define READER_SHOWN_MAX 48 /* characters of a user's text that a message repeats */

struct reader {
	const struct yaml_tree *tree;
	const char *file;
	struct config_error *error;
	char path[READER_PATH_MAX]; /* of the key being read, `devices[1].position.scale` */
	int device_node[CONFIG_DEVICES_MAX];
};

/* -EINVAL with "FILE:LINE: ..." */
int reader_fail(struct reader *, int line, const char *format, ...) __attribute__((format(printf, 3, 4)));

/* A user's text made fit for a message: cut, without control characters. */
const char *reader_shown(const char *text, char ret[READER_SHOWN_MAX]);

/* Fills `base`, the structure of `group`, from the map `node` (-1: nothing was written): defaults first. */
int reader_group(struct reader *, enum key_group, unsigned drivers, int node, void *base);

/* The node of a key in the map `node`; -1: it is not there. */
int reader_child(const struct reader *, int node, const char *name);

/* The line of `name` in the map `node`, of the map itself where it is not written. */
int reader_line(const struct reader *, int node, const char *name);

/* What one key says about another. 0 or -EINVAL. */
int config_check(struct reader *, const struct config *);

#endif
