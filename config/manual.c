/* The commented manual is written from the table of keys and is itself a valid configuration: examples where the table
 * has them, defaults elsewhere, and keys with neither as comments. A test compares config/facetd.yaml with it. */
#include <string.h>

#include "config/keys.h"

#define WIDTH 112

static const char *const opening[] = {
    "facetd.yaml: the manual of the configuration, with every key. Written from the table of keys in config/keys.c;",
    "`facetd --check-config --config FILE` says whether a file is right.",
    "",
    "Numbers are SI (metres, radians, seconds) or carry a unit: 5cm, 30deg, 30ms, 5min, 256M, 30deg/s.",
    "Everything has a default but what is needed to reach a device. A key left out means its default.",
    "Unknown keys, keys written twice and values out of range are errors with file and line.",
    NULL,
};

static void put_indent(FILE *out, int indent)
{
	fprintf(out, "%*s", indent, "");
}

/* A comment, wrapped at WIDTH. */
static void put_comment(FILE *out, int indent, const char *text)
{
	int column = 0;
	while (*text) {
		const size_t word = strcspn(text, " ");
		if (column && column + 1 + (int)word > WIDTH) {
			fputc('\n', out);
			column = 0;
		}
		if (!column) {
			put_indent(out, indent);
			fputc('#', out);
			column = indent + 1;
		}
		fprintf(out, " %.*s", (int)word, text);
		column += 1 + (int)word;
		text += word;
		text += strspn(text, " ");
	}
	fputc('\n', out);
}

/* What a key means, its range, its default where the line below shows something else, and whether it works yet. */
static void describe(FILE *out, int indent, const struct key *key, const char *name)
{
	char range[160], text[900];
	size_t n = (size_t)snprintf(text, sizeof(text), "%s%s%s", name, name[0] ? ": " : "", key->help);
	keys_print_range(key, range, sizeof(range));
	const bool preset = key->preset && key->preset[0] && (key->example || name[0]);
	if (range[0] || preset || key->required)
		n += (size_t)snprintf(text + n, sizeof(text) - n, " [%s%s%s%s%s]", range,
		                      range[0] && (preset || key->required) ? "; " : "", preset ? "default " : "",
		                      preset ? key->preset : "", key->required ? "needed" : "");
	if (key->later)
		snprintf(text + n, sizeof(text) - n, " Not yet: %s will come later.", key->later);
	put_comment(out, indent, text);
}

/* `brief`: what it means stands above already. */
static void put_key(FILE *out, int indent, const struct key *key, bool brief)
{
	const char *value = key->example ? key->example : key->preset;
	if (!brief)
		describe(out, indent, key, "");
	put_indent(out, indent);
	fprintf(out, "%s%s:%s%s\n", value ? "" : "# ", key->name, value && value[0] ? " " : "", value ? value : "");
}

/* The parts of a value that is written in braces, once, before the first key that has them. */
static void put_parts(FILE *out, int indent, const struct key *key, bool *described)
{
	if (!key->inner || described[key->inner])
		return;
	described[key->inner] = true;
	put_indent(out, indent);
	fprintf(out, "# What stands in the braces of `%s` and the like:\n", key->name);
	for (const struct key *part = key_table; part->name; part++)
		if (part->group == key->inner)
			describe(out, indent, part, part->name);
	for (const struct key *part = key_table; part->name; part++)
		if (part->group == key->inner)
			put_parts(out, indent, part, described);
}

static void put_group(FILE *out, enum key_group group, bool *described)
{
	for (const struct key *key = key_table; key->name; key++) {
		if (key->group != group)
			continue;
		put_parts(out, 2, key, described);
		put_key(out, 2, key, false);
	}
}

/* Was this key described with a driver before this one, word by word? */
static bool is_repeated(const struct key *key, unsigned driver)
{
	for (const struct key *other = key_table; other->name; other++)
		if (other->group == GROUP_DEVICE && (other->drivers & (driver - 1)) &&
		    strcmp(other->name, key->name) == 0 && strcmp(other->help, key->help) == 0)
			return true;
	return false;
}

static void put_device(FILE *out, unsigned driver, bool *described)
{
	static const char *const names[] = {"laser", "servo", "pose",  "front",  "left",
	                                    "right", "angle", "drive", "wheels", "log"};
	int place = 0;
	while (driver >> place > 1)
		place++;
	fprintf(out, "\n  - name: %s\n    driver: %s\n", names[place], keys_driver_name(driver));
	for (const struct key *key = key_table; key->name; key++) {
		if (key->group != GROUP_DEVICE || key->drivers == KEY_ALL || !(key->drivers & driver))
			continue;
		put_parts(out, 4, key, described);
		put_key(out, 4, key, is_repeated(key, driver));
	}
}

void keys_write_manual(FILE *out)
{
	bool described[GROUPS] = {false};
	for (int i = 0; opening[i]; i++)
		fprintf(out, "#%s%s\n", opening[i][0] ? " " : "", opening[i]);
	for (const struct key *key = key_table; key->name; key++) {
		if (key->group != GROUP_TOP)
			continue;
		fputc('\n', out);
		put_comment(out, 0, key->help);
		fprintf(out, "%s:\n", key->name);
		if (key->type == KEY_GROUP)
			put_group(out, key->inner, described);
		for (unsigned driver = KEY_LMS2XX; key->type == KEY_DEVICES && driver & KEY_ALL; driver <<= 1)
			put_device(out, driver, described);
	}
}
