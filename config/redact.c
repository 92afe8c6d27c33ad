/* See redact.h. The text went through config_read before, which refuses aliases, so the document is a tree and small. */
#include "config/redact.h"

#include <errno.h>
#include <string.h>
#include <yaml.h>

static bool is_key(yaml_document_t *document, int node, const char *word)
{
	const yaml_node_t *key = yaml_document_get_node(document, node);

	return key && key->type == YAML_SCALAR_NODE && strcmp((const char *)key->data.scalar.value, word) == 0;
}

/* The value of `key`, if `map` is a map that has it. */
static yaml_node_t *find(yaml_document_t *document, const yaml_node_t *map, const char *key)
{
	if (!map || map->type != YAML_MAPPING_NODE)
		return NULL;
	for (yaml_node_pair_t *pair = map->data.mapping.pairs.start; pair < map->data.mapping.pairs.top; pair++)
		if (is_key(document, pair->key, key))
			return yaml_document_get_node(document, pair->value);
	return NULL;
}

static void drop(yaml_document_t *document, yaml_node_t *map, const char *key)
{
	yaml_node_pair_t *pair;

	if (!map || map->type != YAML_MAPPING_NODE)
		return;
	for (pair = map->data.mapping.pairs.start; pair < map->data.mapping.pairs.top; pair++)
		if (is_key(document, pair->key, key)) {
			memmove(pair, pair + 1, (size_t)(map->data.mapping.pairs.top - pair - 1) * sizeof(*pair));
			map->data.mapping.pairs.top--;
			pair--;
		}
}

static int take(void *ctx, unsigned char *bytes, size_t len)
{
	struct buffer *ret = ctx;

	buffer_append(ret, bytes, len);
	return ret->error == 0;
}

/* Takes the document over. */
static int emit(yaml_document_t *document, struct buffer *ret)
{
	yaml_emitter_t emitter;
	bool good;

	if (!yaml_emitter_initialize(&emitter)) {
		yaml_document_delete(document);
		return -ENOMEM;
	}
	yaml_emitter_set_output(&emitter, take, ret);
	yaml_emitter_set_width(&emitter, -1);
	yaml_emitter_set_unicode(&emitter, 1);
	good = yaml_emitter_open(&emitter) && yaml_emitter_dump(&emitter, document) && yaml_emitter_close(&emitter);
	yaml_emitter_delete(&emitter);
	return good ? 0 : -ENOMEM;
}

int config_redact(const char *text, size_t len, struct buffer *ret)
{
	yaml_document_t document;
	yaml_parser_t parser;
	yaml_node_t *listen;
	bool good;

	if (!yaml_parser_initialize(&parser))
		return -ENOMEM;
	yaml_parser_set_input_string(&parser, (const unsigned char *)text, len);
	good = yaml_parser_load(&parser, &document);
	yaml_parser_delete(&parser);
	if (!good)
		return -EINVAL;
	listen = find(&document, yaml_document_get_root_node(&document), "listen");
	drop(&document, listen, "token_file");
	drop(&document, listen, "tls");
	if (yaml_document_get_root_node(&document))
		return emit(&document, ret);
	yaml_document_delete(&document);
	return 0;
}
