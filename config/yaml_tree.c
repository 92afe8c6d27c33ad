/* libyaml's events carry lines, its document API loses them and follows aliases; so events are put into a tree here.
 * What could make it large is bounded before it is kept: the document's bytes, the depth, the number of nodes. Key and
 * value of a map are siblings; the stack holds the open lists and maps with their last child, so nothing recurses. */
#include "config/yaml_tree.h"

#include <errno.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include <yaml.h>

struct builder {
	struct yaml_tree tree;
	struct {
		int node, last;
	} open[YAML_DEPTH_MAX];
	int depth;
	bool document_seen, end;
	const char *text;
	size_t len;
	struct yaml_error *error;
};

static int refuse(struct builder *b, size_t line, const char *sentence)
{
	b->error->line = (int)line + 1;
	snprintf(b->error->text, sizeof(b->error->text), "%s", sentence);
	return -EINVAL;
}

static int add_node(struct builder *b, enum yaml_kind kind, size_t line, char *text, int *ret_node)
{
	struct yaml_tree *tree = &b->tree;
	if (tree->n == YAML_NODES_MAX)
		return refuse(b, line, "there are too many values in this file");
	if (tree->n == tree->cap) {
		const int cap = tree->cap ? 2 * tree->cap : 64;
		struct yaml_node *node = realloc(tree->node, (size_t)cap * sizeof(*node));
		if (!node)
			return -ENOMEM;
		tree->node = node;
		tree->cap = cap;
	}
	const int at = tree->n++;
	tree->node[at] = (struct yaml_node){.kind = kind, .line = (int)line + 1, .text = text, .first = -1, .next = -1};
	if (b->depth == 0) {
		tree->root = at;
	} else {
		const int last = b->open[b->depth - 1].last;
		if (last < 0)
			tree->node[b->open[b->depth - 1].node].first = at;
		else
			tree->node[last].next = at;
		b->open[b->depth - 1].last = at;
	}
	*ret_node = at;
	return 0;
}

static int add_text(struct builder *b, const yaml_event_t *event)
{
	const char *value = (const char *)event->data.scalar.value;
	const size_t len = event->data.scalar.length;
	if (memchr(value, '\0', len))
		return refuse(b, event->start_mark.line, "a value holds a NUL character");
	char *text = strdup(value);
	if (!text)
		return -ENOMEM;
	int node;
	const int error = add_node(b, YAML_TEXT, event->start_mark.line, text, &node);
	if (error)
		free(text);
	return error;
}

static int open_node(struct builder *b, enum yaml_kind kind, const yaml_event_t *event)
{
	if (b->depth == YAML_DEPTH_MAX)
		return refuse(b, event->start_mark.line, "lists and maps are nested too deeply");
	int node;
	const int error = add_node(b, kind, event->start_mark.line, NULL, &node);
	if (error)
		return error;
	b->open[b->depth].node = node;
	b->open[b->depth].last = -1;
	b->depth++;
	return 0;
}

static int take_event(struct builder *b, const yaml_event_t *event)
{
	switch (event->type) {
	case YAML_DOCUMENT_START_EVENT:
		if (b->document_seen)
			return refuse(b, event->start_mark.line, "a second document begins here; only one is read");
		b->document_seen = true;
		return 0;
	case YAML_ALIAS_EVENT:
		return refuse(b, event->start_mark.line, "aliases (*name) are not read; write the value out");
	case YAML_SCALAR_EVENT:
		return add_text(b, event);
	case YAML_SEQUENCE_START_EVENT:
		return open_node(b, YAML_LIST, event);
	case YAML_MAPPING_START_EVENT:
		return open_node(b, YAML_MAP, event);
	case YAML_SEQUENCE_END_EVENT:
	case YAML_MAPPING_END_EVENT:
		b->depth--;
		return 0;
	case YAML_STREAM_END_EVENT:
		b->end = true;
		return 0;
	default:
		return 0;
	}
}

static int parser_error(struct builder *b, const yaml_parser_t *parser)
{
	if (parser->error == YAML_MEMORY_ERROR)
		return -ENOMEM;
	size_t line = parser->problem_mark.line;
	if (parser->error == YAML_READER_ERROR) /* bytes that are no UTF-8 have an offset, but no line */
		for (size_t i = line = 0; i < parser->problem_offset && i < b->len; i++)
			line += b->text[i] == '\n';
	char sentence[160];
	snprintf(sentence, sizeof(sentence), "this is not YAML: %s",
	         parser->problem ? parser->problem : "it cannot be read");
	return refuse(b, line, sentence);
}

int yaml_tree_parse(const char *text, size_t len, struct yaml_tree *ret, struct yaml_error *error)
{
	struct builder b = {.tree.root = -1, .text = text, .len = len, .error = error};
	if (len > YAML_SIZE_MAX)
		return refuse(&b, 0, "the file is larger than 1 MB; a configuration never is");
	yaml_parser_t parser;
	if (!yaml_parser_initialize(&parser))
		return -ENOMEM;
	yaml_parser_set_input_string(&parser, (const unsigned char *)text, len);
	int status = 0;
	while (!status && !b.end) {
		yaml_event_t event;
		if (!yaml_parser_parse(&parser, &event)) {
			status = parser_error(&b, &parser);
			break;
		}
		status = take_event(&b, &event);
		yaml_event_delete(&event);
	}
	yaml_parser_delete(&parser);
	if (status)
		yaml_tree_finish(&b.tree);
	else
		*ret = b.tree;
	return status;
}

void yaml_tree_finish(struct yaml_tree *tree)
{
	for (int i = 0; i < tree->n; i++)
		free(tree->node[i].text);
	free(tree->node);
	*tree = (struct yaml_tree){.root = -1};
}

bool yaml_is_null(const struct yaml_node *node)
{
	return node->kind == YAML_TEXT &&
	       (node->text[0] == '\0' || strcmp(node->text, "~") == 0 || strcmp(node->text, "null") == 0);
}
