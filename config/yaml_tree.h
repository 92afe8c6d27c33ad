/* A YAML document as a small tree whose nodes know their lines. */
#ifndef FACET_CONFIG_YAML_TREE_H
#define FACET_CONFIG_YAML_TREE_H

#include <stdbool.h>
#include <stddef.h>

#define YAML_SIZE_MAX  (1u << 20) /* bytes of a document; a longer one is refused */
#define YAML_DEPTH_MAX 16         /* lists and maps within each other */
#define YAML_NODES_MAX 20000

enum yaml_kind { YAML_TEXT, YAML_LIST, YAML_MAP };

struct yaml_node {
	enum yaml_kind kind;
	int line;        /* from 1 */
	char *text;      /* YAML_TEXT; owned by the tree; holds no NUL */
	int first, next; /* first child, next sibling; -1: none. A map's children are key, value, key, value ... */
};

struct yaml_tree {
	struct yaml_node *node;
	int n, cap;
	int root; /* -1: an empty document */
};

struct yaml_error {
	int line;
	char text[200];
};

/* 0, -EINVAL with line and sentence, -ENOMEM. Aliases are refused: a few of them stand for gigabytes. */
int yaml_tree_parse(const char *text, size_t len, struct yaml_tree *ret, struct yaml_error *error);
void yaml_tree_finish(struct yaml_tree *);

/* Nothing was written: `key:`, `key: ~`, `key: null`. */
bool yaml_is_null(const struct yaml_node *);

#endif
