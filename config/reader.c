/* The reader knows types, the table knows names. A value is judged whole (shape, suffix, range, choices) before it is
 * stored. Defaults go the same way: a preset is a small YAML document of its own, so the table can never hold a default
 * that the reader would refuse. */
#include "config/reader.h"

#include <ctype.h>
#include <errno.h>
#include <math.h>
#include <stdarg.h>
#include <stdlib.h>
#include <string.h>

int reader_fail(struct reader *r, int line, const char *format, ...)
{
	va_list args;
	va_start(args, format);
	const size_t cap = sizeof(r->error->text);
	int n = line > 0 ? snprintf(r->error->text, cap, "%.200s:%d: ", r->file, line)
	                 : snprintf(r->error->text, cap, "%.200s: ", r->file);
	vsnprintf(r->error->text + n, cap - (size_t)n, format, args);
	va_end(args);
	return -EINVAL;
}

const char *reader_shown(const char *text, char ret[READER_SHOWN_MAX])
{
	size_t n = 0;
	while (n < READER_SHOWN_MAX - 4 && text[n]) {
		ret[n] = iscntrl((unsigned char)text[n]) ? '?' : text[n];
		n++;
	}
	strcpy(ret + n, text[n] ? "..." : "");
	return ret;
}

static const struct yaml_node *node_at(const struct reader *r, int node)
{
	return &r->tree->node[node];
}

int reader_child(const struct reader *r, int node, const char *name)
{
	if (node < 0 || node_at(r, node)->kind != YAML_MAP)
		return -1;
	for (int key = node_at(r, node)->first; key >= 0;) {
		const int value = node_at(r, key)->next;
		if (node_at(r, key)->kind == YAML_TEXT && strcmp(node_at(r, key)->text, name) == 0)
			return value;
		key = node_at(r, value)->next;
	}
	return -1;
}

int reader_line(const struct reader *r, int node, const char *name)
{
	const int child = reader_child(r, node, name);
	return child >= 0 ? node_at(r, child)->line : node >= 0 ? node_at(r, node)->line : 0;
}

/* Numbers ------------------------------------------------------------------------------------------------------- */

static bool is_choice_number(const char *choices, double value)
{
	for (const char *c = choices; c; c = strchr(c, '|') ? strchr(c, '|') + 1 : NULL)
		if (strtod(c, NULL) == value)
			return true;
	return false;
}

/* Registers and modes are often written in hexadecimal. */
static bool parse_hex(const char *text, double *ret)
{
	const size_t n = strlen(text);
	if (n < 3 || n > 10 || text[0] != '0' || text[1] != 'x' || strspn(text + 2, "0123456789abcdefABCDEF") != n - 2)
		return false;
	*ret = (double)strtoul(text, NULL, 16);
	return true;
}

/* Who writes -65 for an angle means degrees: the hint costs nothing and saves an hour. */
static const char *degree_hint(const struct key *key, const char *text)
{
	const bool angle = key->dimension == DIMENSION_ANGLE || key->dimension == DIMENSION_RATE;
	return angle && isdigit((unsigned char)text[strlen(text) - 1])
	           ? " (a number without a unit is in radians; write `deg` behind degrees)"
	           : "";
}

static int judge_number(struct reader *r, const struct key *key, const struct yaml_node *node, double value)
{
	char range[120], shown[READER_SHOWN_MAX];
	keys_print_range(key, range, sizeof(range));
	if (key->type == KEY_INTEGER && floor(value) != value)
		return reader_fail(r, node->line, "%s: '%s' is not a whole number", r->path,
		                   reader_shown(node->text, shown));
	if (key->choices && !is_choice_number(key->choices, value))
		return reader_fail(r, node->line, "%s: '%s' is not %s", r->path, reader_shown(node->text, shown),
		                   range);
	if ((key->min != 0 || key->max != 0) && (value < key->min || value > key->max))
		return reader_fail(r, node->line, "%s: '%s' is outside %s%s", r->path, reader_shown(node->text, shown),
		                   range, degree_hint(key, node->text));
	return 0;
}

static int read_number(struct reader *r, const struct key *key, int at, double *ret)
{
	const struct yaml_node *node = node_at(r, at);
	char range[120], shown[READER_SHOWN_MAX];
	keys_print_range(key, range, sizeof(range));
	if (node->kind != YAML_TEXT || yaml_is_null(node))
		return reader_fail(r, node->line, "%s: a number is needed here%s%s", r->path, range[0] ? ", " : "",
		                   range);
	if (key->word && strcmp(key->word, node->text) == 0) {
		*ret = key->word_value;
		return 0;
	}
	double value;
	const int error = key->type == KEY_INTEGER && parse_hex(node->text, &value)
	                      ? 0
	                      : units_parse(node->text, key->dimension, &value);
	reader_shown(node->text, shown);
	if (error == -ENOTSUP)
		return reader_fail(r, node->line,
		                   "%s: the unit in '%s' is not known here; use one of %s, or none for SI", r->path,
		                   shown, units_suffixes(key->dimension));
	if (error)
		return reader_fail(r, node->line, "%s: '%s' is not a number%s%s", r->path, shown, range[0] ? "; " : "",
		                   range);
	const int bad = judge_number(r, key, node, value);
	if (!bad)
		*ret = value;
	return bad;
}

static void store_integer(double value, void *to, size_t size)
{
	const int64_t wide = (int64_t)value;
	const uint64_t bits = (uint64_t)wide;
	const uint32_t bits32 = (uint32_t)bits;
	const uint16_t bits16 = (uint16_t)bits;
	const uint8_t bits8 = (uint8_t)bits;
	if (size == 8)
		memcpy(to, &bits, size);
	else if (size == 4)
		memcpy(to, &bits32, size);
	else if (size == 2)
		memcpy(to, &bits16, size);
	else if (size == 1)
		memcpy(to, &bits8, size);
}

static int read_scalar_number(struct reader *r, const struct key *key, int at, void *to)
{
	double value;
	const int error = read_number(r, key, at, &value);
	if (error || key->size == 0)
		return error;
	if (key->type == KEY_DURATION)
		*(int64_t *)to = (int64_t)rint(value * 1e9);
	else if (key->type == KEY_INTEGER)
		store_integer(value, to, key->size);
	else
		*(double *)to = value;
	return 0;
}

/* A list of exactly n numbers. */
static int read_numbers(struct reader *r, const struct key *key, int at, int n, double *ret)
{
	double value[3];
	const struct yaml_node *node = node_at(r, at);
	int count = 0;
	if (node->kind == YAML_LIST)
		for (int child = node->first; child >= 0; child = node_at(r, child)->next, count++)
			if (count < n) {
				const int error = read_number(r, key, child, &value[count]);
				if (error)
					return error;
			}
	if (count != n)
		return reader_fail(r, node->line, "%s: a list of %d numbers is needed here, like %s", r->path, n,
		                   n == 2 ? "[0.3, 30]" : "[0, 0, 0]");
	memcpy(ret, value, (size_t)n * sizeof(*ret));
	return 0;
}

static int read_pair(struct reader *r, const struct key *key, int at, double ret[2])
{
	double pair[2];
	const int error = read_numbers(r, key, at, 2, pair);
	if (error)
		return error;
	if (pair[0] >= pair[1])
		return reader_fail(r, node_at(r, at)->line, "%s: the first number must be smaller than the second",
		                   r->path);
	memcpy(ret, pair, sizeof(pair));
	return 0;
}

static int read_vector(struct reader *r, const struct key *key, int at, struct vec3 *ret)
{
	double v[3];
	const int error = read_numbers(r, key, at, 3, v);
	if (!error)
		*ret = (struct vec3){v[0], v[1], v[2]};
	return error;
}

/* Words --------------------------------------------------------------------------------------------------------- */

/* The place of `text` among `a|b|c`, -1: not there. */
static int choice_index(const char *choices, const char *text)
{
	const size_t len = strlen(text);
	int i = 0;
	if (strchr(text, '|'))
		return -1;
	for (const char *c = choices; c; c = strchr(c, '|') ? strchr(c, '|') + 1 : NULL, i++)
		if (strncmp(c, text, len) == 0 && (c[len] == '|' || c[len] == '\0'))
			return i;
	return -1;
}

static int read_choice(struct reader *r, const struct key *key, int at, int *ret)
{
	const struct yaml_node *node = node_at(r, at);
	char range[120], shown[READER_SHOWN_MAX];
	keys_print_range(key, range, sizeof(range));
	if (node->kind != YAML_TEXT)
		return reader_fail(r, node->line, "%s: a word is needed here, %s", r->path, range);
	const int index = node->text[0] ? choice_index(key->choices, node->text) : -1;
	if (index < 0)
		return reader_fail(r, node->line, "%s: '%s' is not %s", r->path, reader_shown(node->text, shown),
		                   range);
	*ret = index;
	return 0;
}

static int read_switch(struct reader *r, const struct key *key, int at, bool *to)
{
	static const char *const words = "off|on|no|yes|false|true";
	const struct yaml_node *node = node_at(r, at);
	const int index = node->kind == YAML_TEXT && node->text[0] ? choice_index(words, node->text) : -1;
	if (index < 0)
		return reader_fail(r, node->line, "%s: on or off is needed here", r->path);
	if (key->size)
		*to = index & 1;
	return 0;
}

static int read_text(struct reader *r, const struct key *key, int at, char *to, size_t size)
{
	const struct yaml_node *node = node_at(r, at);
	if (node->kind != YAML_TEXT)
		return reader_fail(r, node->line, "%s: one text is needed here, not a list or map", r->path);
	const char *text = yaml_is_null(node) ? "" : node->text;
	if (key->required && !text[0])
		return reader_fail(r, node->line, "%s: nothing is written here, but it is needed", r->path);
	if (!size)
		return 0;
	if (strlen(text) >= size)
		return reader_fail(r, node->line, "%s: the text is longer than %zu characters", r->path, size - 1);
	strcpy(to, text);
	return 0;
}

/* The place of a word in a list of choices is the enum's value; where letters are stored, the word's first. */
static int read_word(struct reader *r, const struct key *key, int at, void *to)
{
	int index = 0;
	const int error = read_choice(r, key, at, &index);
	if (error || !key->size)
		return error;
	if (key->type == KEY_LETTER)
		*(char *)to = (char)toupper((unsigned char)node_at(r, at)->text[0]);
	else
		store_integer(index, to, key->size);
	return 0;
}

/* Values of several parts ---------------------------------------------------------------------------------------- */

static int read_texts(struct reader *r, const struct key *key, int at, void *base)
{
	const struct yaml_node *node = node_at(r, at);
	char(*text)[CONFIG_TEXT_MAX] = (void *)((char *)base + key->offset);
	int n = 0;
	if (node->kind != YAML_LIST)
		return reader_fail(r, node->line, "%s: a list is needed here, like [%s]", r->path,
		                   key->example ? key->example : "unix:/run/facetd/facetd.sock");
	for (int child = node->first; child >= 0; child = node_at(r, child)->next, n++) {
		if (n == CONFIG_LISTEN_MAX)
			return reader_fail(r, node_at(r, child)->line, "%s: at most %d are possible", r->path,
			                   CONFIG_LISTEN_MAX);
		const int error = read_text(r, key, child, text[n], CONFIG_TEXT_MAX);
		if (error)
			return error;
	}
	*(int *)((char *)base + key->count) = n;
	return 0;
}

static int read_transform(struct reader *r, const struct key *key, int at, struct transform *to)
{
	struct {
		struct vec3 xyz, rpy;
	} frame;
	const int error = reader_group(r, key->inner, 0, at, &frame);
	if (!error)
		*to = transform_rpy(frame.xyz, frame.rpy);
	return error;
}

static bool is_wide(const struct config_register *reg)
{
	return reg->type == REGISTER_I32 || reg->type == REGISTER_U32 || reg->type == REGISTER_F32;
}

/* Only the position is read; everything else is written. */
static int read_register(struct reader *r, const struct key *key, int at, struct config_register *to)
{
	struct config_register reg = {.set = true};
	int error = reader_group(r, key->inner, 0, at, &reg);
	if (error)
		return error;
	const bool read = strcmp(key->name, "position") == 0;
	if (reg.function == 0)
		reg.function = read ? 3 : is_wide(&reg) ? 16 : 6;
	const int line = reader_line(r, at, "function");
	if (read != (reg.function == 3 || reg.function == 4))
		return reader_fail(r, line, "%s.function: %d does not fit; %s", r->path, reg.function,
		                   read ? "a value is read with 3 or 4" : "a value is written with 6 or 16");
	if (reg.function == 6 && is_wide(&reg))
		return reader_fail(r, line, "%s.function: 6 writes 16 bits only; use 16 for a type of 32 bits",
		                   r->path);
	if (is_wide(&reg) && reg.address == 65535)
		return reader_fail(r, line, "%s.address: 32 bits need two registers; 65535 is the last one", r->path);
	*to = reg;
	return 0;
}

/* Bits that a frame does not have are refused here, so that decoders need not ask. */
static int judge_bits(struct reader *r, int at, const char *what, int start, int length, bool motorola)
{
	int last = start + length - 1;
	if (motorola) /* down to bit 0 of this byte, then on from bit 7 of the next */
		last = (start / 8 + (length - start % 8 - 1 + 7) / 8) * 8;
	return last < 512 ? 0
	                  : reader_fail(r, reader_line(r, at, what),
	                                "%s.%s: bits beyond the 512 of the longest frame; check start and length",
	                                r->path, what);
}

static int read_signal(struct reader *r, const struct key *key, int at, struct config_signal *to)
{
	struct config_signal signal = {.set = true};
	int error = reader_group(r, key->inner, 0, at, &signal);
	if (error)
		return error;
	const bool motorola = signal.order == SIGNAL_MOTOROLA;
	if (!signal.extended && signal.id > 0x7ff)
		return reader_fail(r, reader_line(r, at, "id"),
		                   "%s.id: 0x%x has more than 11 bits; write `extended: on` beside it", r->path,
		                   signal.id);
	if (signal.type == SIGNAL_FLOAT && signal.length != 32 && signal.length != 64)
		return reader_fail(r, reader_line(r, at, "length"), "%s.length: a float has 32 or 64 bits", r->path);
	if (signal.scale == 0)
		return reader_fail(r, reader_line(r, at, "scale"), "%s.scale: 0 makes everything 0", r->path);
	error = judge_bits(r, at, "start", signal.start, signal.length, motorola);
	if (!error && signal.counter.set)
		error = judge_bits(r, at, "counter", signal.counter.start, signal.counter.length, motorola);
	if (!error && signal.mux.set)
		error = judge_bits(r, at, "mux", signal.mux.start, signal.mux.length, motorola);
	if (!error)
		*to = signal;
	return error;
}

static int read_tilt(struct reader *r, const struct key *key, int at, struct config_device *device)
{
	const struct yaml_node *node = node_at(r, at);
	device->tilt[0] = '\0';
	device->tilt_fixed_rad = 0;
	if (node->kind == YAML_TEXT && isalpha((unsigned char)node->text[0]))
		return read_text(r, key, at, device->tilt, sizeof(device->tilt));
	return read_number(r, key, at, &device->tilt_fixed_rad);
}

static int read_variant(struct reader *r, const struct key *key, int at, struct config_device *device)
{
	int index;
	const int error = read_choice(r, key, at, &index);
	if (error)
		return error;
	const char *text = node_at(r, at)->text;
	device->fov_deg = atoi(text);
	device->resolution_cdeg = (int)rint(strtod(strchr(text, '/') + 1, NULL) * 100);
	return 0;
}

static int read_masks(struct reader *r, const struct key *key, int at, struct config_device *device)
{
	const struct yaml_node *node = node_at(r, at);
	int n = 0;
	if (node->kind != YAML_LIST)
		return reader_fail(r, node->line, "%s: a list of pairs is needed here, like [[-90deg, -80deg]]",
		                   r->path);
	for (int child = node->first; child >= 0; child = node_at(r, child)->next, n++) {
		double pair[2];
		if (n == SWEEP_MASKS_MAX)
			return reader_fail(r, node_at(r, child)->line, "%s: at most %d are possible", r->path,
			                   SWEEP_MASKS_MAX);
		const int error = read_pair(r, key, child, pair);
		if (error)
			return error;
		device->mask[n].from_rad = pair[0];
		device->mask[n].to_rad = pair[1];
	}
	device->masks = n;
	return 0;
}

static int read_writes(struct reader *r, const struct key *key, int at, struct config_writes *to)
{
	const struct yaml_node *node = node_at(r, at);
	int n = 0;
	if (node->kind != YAML_LIST)
		return reader_fail(r, node->line, "%s: a list is needed here, like [{address: 16, value: 1}]", r->path);
	for (int child = node->first; child >= 0; child = node_at(r, child)->next, n++) {
		if (n == CONFIG_WRITES_MAX)
			return reader_fail(r, node_at(r, child)->line, "%s: at most %d are possible", r->path,
			                   CONFIG_WRITES_MAX);
		const int error = reader_group(r, key->inner, 0, child, &to->item[n]);
		if (error)
			return error;
	}
	to->n = n;
	return 0;
}

/* Devices -------------------------------------------------------------------------------------------------------- */

static int read_device(struct reader *r, int at, struct config_device *device)
{
	const struct yaml_node *node = node_at(r, at);
	const int driver = reader_child(r, at, "driver");
	const struct key *key = keys_find(GROUP_DEVICE, "driver", 0);
	char range[120];
	keys_print_range(key, range, sizeof(range));
	if (driver < 0)
		return reader_fail(r, node->line, "%s: `driver` is missing; it is %s", r->path, range);
	int index;
	const int error = read_choice(r, key, driver, &index);
	if (error)
		return error;
	device->line = node->line;
	return reader_group(r, GROUP_DEVICE, 1u << index, at, device);
}

static int read_devices(struct reader *r, int at, struct config *config)
{
	const struct yaml_node *node = node_at(r, at);
	if (yaml_is_null(node))
		return 0;
	if (node->kind != YAML_LIST)
		return reader_fail(r, node->line, "devices: a list is needed here; begin each device with `- name:`");
	const size_t length = strlen(r->path);
	for (int child = node->first; child >= 0; child = node_at(r, child)->next) {
		const int n = config->devices;
		if (n == CONFIG_DEVICES_MAX)
			return reader_fail(r, node_at(r, child)->line, "devices: at most %d are possible",
			                   CONFIG_DEVICES_MAX);
		snprintf(r->path + length, sizeof(r->path) - length, "[%d]", n);
		r->device_node[n] = child;
		const int error = read_device(r, child, &config->device[n]);
		if (error)
			return error;
		config->devices++;
	}
	r->path[length] = '\0';
	return 0;
}

/* The table ------------------------------------------------------------------------------------------------------ */

static int read_value(struct reader *r, const struct key *key, int at, void *base)
{
	void *to = (char *)base + key->offset;
	switch (key->type) {
	case KEY_GROUP:
		return reader_group(r, key->inner, 0, at, base);
	case KEY_DEVICES:
		return read_devices(r, at, base);
	case KEY_SWITCH:
		return read_switch(r, key, at, to);
	case KEY_INTEGER:
	case KEY_REAL:
	case KEY_DURATION:
		return read_scalar_number(r, key, at, to);
	case KEY_CHOICE:
	case KEY_LETTER:
		return read_word(r, key, at, to);
	case KEY_TEXT:
		return read_text(r, key, at, to, key->size);
	case KEY_TEXTS:
		return read_texts(r, key, at, base);
	case KEY_PAIR:
		return read_pair(r, key, at, to);
	case KEY_VECTOR:
		return read_vector(r, key, at, to);
	case KEY_TRANSFORM:
		return read_transform(r, key, at, to);
	case KEY_REGISTER:
		return read_register(r, key, at, to);
	case KEY_TILT:
		return read_tilt(r, key, at, base);
	case KEY_VARIANT:
		return read_variant(r, key, at, base);
	case KEY_MASKS:
		return read_masks(r, key, at, base);
	case KEY_WRITES:
		return read_writes(r, key, at, to);
	case KEY_SIGNAL:
		return read_signal(r, key, at, to);
	}
	return -EINVAL;
}

/* Nothing inside a preset is unknown or out of range; that is a test's business. */
static int read_preset(struct reader *r, const struct key *key, void *base)
{
	struct yaml_tree tree;
	struct yaml_error error;
	const char *text = key->preset[0] ? key->preset : "''";
	const int parsed = yaml_tree_parse(text, strlen(text), &tree, &error);
	if (parsed)
		return parsed;
	struct reader inner = {.tree = &tree, .file = "default", .error = r->error};
	snprintf(inner.path, sizeof(inner.path), "%s", key->name);
	const int status = read_value(&inner, key, tree.root, base);
	yaml_tree_finish(&tree);
	return status;
}

static bool same_number(const struct key *key, const char *a, const char *b)
{
	double x, y;
	return units_parse(a, key->dimension, &x) == 0 && units_parse(b, key->dimension, &y) == 0 && x == y;
}

/* A key of later work: only its default is possible. */
static int judge_later(struct reader *r, const struct key *key, int at)
{
	const struct yaml_node *node = node_at(r, at);
	static const char *const off = "off|no|false";
	if (node->kind == YAML_TEXT) {
		const char *text = yaml_is_null(node) ? "" : node->text;
		if (strcmp(text, key->preset) == 0 || (!text[0] && key->type == KEY_TEXT) ||
		    same_number(key, text, key->preset))
			return 0;
		if (key->type == KEY_SWITCH && text[0] && choice_index(off, text) >= 0 &&
		    strcmp(key->preset, "off") == 0)
			return 0;
	}
	return reader_fail(r, node->line, "%s: %s will come later; until then %s%s", r->path, key->later,
	                   key->preset[0] ? "the only value is " : "leave it empty", key->preset);
}

/* The drivers that have this key: "modbus, tim". False: none has. */
static bool key_owners(const char *name, char *ret, size_t cap)
{
	size_t n = 0;
	for (unsigned bit = 1; bit & KEY_ALL; bit <<= 1)
		if (keys_find(GROUP_DEVICE, name, bit) && n < cap)
			n += (size_t)snprintf(ret + n, cap - n, "%s%s", n ? ", " : "", keys_driver_name(bit));
	return n > 0;
}

/* Names the key that was probably meant, or where a key of this name belongs. */
static int unknown_key(struct reader *r, enum key_group group, unsigned drivers, const struct yaml_node *node)
{
	char shown[READER_SHOWN_MAX];
	reader_shown(node->text, shown);
	char owners[80];
	if (group == GROUP_DEVICE && key_owners(node->text, owners, sizeof(owners)))
		return reader_fail(r, node->line, "%s: '%s' is a key of %s, not of %s", r->path, shown, owners,
		                   keys_driver_name(drivers));
	const struct key *nearest = keys_nearest(group, node->text, drivers);
	return reader_fail(r, node->line, "unknown key '%s'%s%s; the nearest known one is '%s'", shown,
	                   r->path[0] ? " in " : "", r->path, nearest->name);
}

/* A limit that is left empty is none, as is 0, its default. */
static bool may_be_empty(const struct key *key)
{
	return (key->type == KEY_INTEGER || key->type == KEY_DURATION) && key->preset && strcmp(key->preset, "0") == 0;
}

static int read_key(struct reader *r, enum key_group group, unsigned drivers, int at, void *base)
{
	const struct yaml_node *node = node_at(r, at);
	if (node->kind != YAML_TEXT)
		return reader_fail(r, node->line, "%s: the name of a key is needed here", r->path);
	const struct key *key = keys_find(group, node->text, drivers);
	if (!key)
		return unknown_key(r, group, drivers, node);
	const size_t length = strlen(r->path);
	snprintf(r->path + length, sizeof(r->path) - length, "%s%s", length ? "." : "", key->name);
	const int value = node->next;
	int error = 0;
	const bool empty = node_at(r, value)->kind == YAML_TEXT && yaml_is_null(node_at(r, value));
	if (!(empty && (key->later ? key->type == KEY_TEXT : may_be_empty(key))))
		error = read_value(r, key, value, base);
	if (!error && key->later)
		error = judge_later(r, key, value);
	if (!error && key->flag && !yaml_is_null(node_at(r, value)))
		*((bool *)((char *)base + key->flag)) = true;
	if (!error)
		r->path[length] = '\0';
	return error;
}

static int check_duplicate(struct reader *r, int map, int at)
{
	const struct yaml_node *node = node_at(r, at);
	if (node->kind != YAML_TEXT)
		return 0;
	for (int key = node_at(r, map)->first; key != at; key = node_at(r, node_at(r, key)->next)->next)
		if (node_at(r, key)->kind == YAML_TEXT && strcmp(node_at(r, key)->text, node->text) == 0) {
			char shown[READER_SHOWN_MAX];
			return reader_fail(r, node->line, "the key '%s' is written twice, first in line %d; remove one",
			                   reader_shown(node->text, shown), node_at(r, key)->line);
		}
	return 0;
}

static int check_required(struct reader *r, enum key_group group, unsigned drivers, int map)
{
	for (const struct key *key = key_table; key->name; key++) {
		if (key->group != group || !key->required || (drivers && !(key->drivers & drivers)))
			continue;
		if (reader_child(r, map, key->name) < 0)
			return reader_fail(r, map >= 0 ? node_at(r, map)->line : 0, "%s: `%s` is missing: %s", r->path,
			                   key->name, key->help);
	}
	return 0;
}

int reader_group(struct reader *r, enum key_group group, unsigned drivers, int map, void *base)
{
	for (const struct key *key = key_table; key->name; key++) {
		const int inner = key->group == group && key->type == KEY_GROUP && !key->flag;
		if (key->group != group || (drivers && !(key->drivers & drivers)))
			continue;
		const int error = key->preset ? read_preset(r, key, base)
		                  : inner     ? reader_group(r, key->inner, 0, -1, base)
		                              : 0;
		if (error)
			return error;
	}
	if (map < 0)
		return 0;
	if (yaml_is_null(node_at(r, map))) /* an empty section is none; an empty device or register is a mistake */
		return group == GROUP_SWEEP || group == GROUP_BOX || group == GROUP_ENCODER || group == GROUP_TLS
		           ? 0
		           : check_required(r, group, drivers, map);
	if (!r->path[0] && node_at(r, map)->kind == YAML_LIST)
		return reader_fail(r, node_at(r, map)->line,
		                   "configuration: a list does not stand alone; write `devices:` above the devices");
	if (node_at(r, map)->kind != YAML_MAP)
		return reader_fail(r, node_at(r, map)->line, "%s: `key: value` pairs are needed here",
		                   r->path[0] ? r->path : "configuration");
	for (int at = node_at(r, map)->first; at >= 0; at = node_at(r, node_at(r, at)->next)->next) {
		int error = check_duplicate(r, map, at);
		if (!error)
			error = read_key(r, group, drivers, at, base);
		if (error)
			return error;
	}
	return check_required(r, group, drivers, map);
}
