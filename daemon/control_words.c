/* Words of clients, in gpsd's manner: a question begins with `?`. What is known but not there yet is refused by its name, so
 * that nobody mistakes a missing feature for a misspelt one. Jansson does the JSON; its refusal of duplicate keys and of
 * depth bounds the rest. */
#include "daemon/control.h"

#include <errno.h>
#include <jansson.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

static const char *const words[] = {"STATUS", "WATCH", "PAUSE", "RESUME", "RESET", "SAVE", "RECORD", "SEEK"};

static const struct {
	const char *word, *sentence;
} later[] = {
    {"SWEEP", "?SWEEP comes in a later version: set `sweep` in the configuration"},
};

const char *control_name(enum control_word word)
{
	return words[word];
}

bool control_changes(enum control_word word)
{
	return word == CONTROL_PAUSE || word == CONTROL_RESUME || word == CONTROL_RESET || word == CONTROL_SAVE ||
	       word == CONTROL_RECORD || word == CONTROL_SEEK;
}

bool control_plays(enum control_word word)
{
	return word == CONTROL_PAUSE || word == CONTROL_RESUME || word == CONTROL_SEEK;
}

static int refuse(char error[200], const char *sentence)
{
	snprintf(error, 200, "%s", sentence);
	return -EINVAL;
}

static int find_word(const char *word, enum control_word *ret, char error[200])
{
	for (size_t i = 0; i < sizeof(words) / sizeof(words[0]); i++)
		if (strcmp(words[i], word) == 0) {
			*ret = (enum control_word)i;
			return 0;
		}
	for (size_t i = 0; i < sizeof(later) / sizeof(later[0]); i++)
		if (strcmp(later[i].word, word) == 0) {
			snprintf(error, 200, "%s", later[i].sentence);
			return -ENOTSUP;
		}
	return refuse(error,
	              "not a command: say ?STATUS, ?WATCH={\"enable\":true}, ?PAUSE, ?RESUME, ?RESET, ?SEEK={...}, "
	              "?SAVE={\"file\":\"NAME.ply\"} or ?RECORD={\"enable\":true}");
}

static int read_file(json_t *arguments, struct control_command *command, char error[200])
{
	const char *file = json_string_value(json_object_get(arguments, "file"));

	if (!file || strlen(file) >= sizeof(command->file))
		return refuse(error, "?SAVE={\"file\":\"NAME.ply\"}: a name is needed, of less than 128 bytes");
	snprintf(command->file, sizeof(command->file), "%s", file);
	return 0;
}

/* {"t": seconds}, {"speed": number or "max"}, or both. */
static int read_seek(json_t *arguments, struct control_command *command, char error[200])
{
	json_t *t = json_object_get(arguments, "t"), *speed = json_object_get(arguments, "speed");
	const bool max = json_is_string(speed) && strcmp(json_string_value(speed), "max") == 0;

	if (!t && !speed)
		return refuse(error,
		              "say where to, or how fast: ?SEEK={\"t\": SECONDS} or ?SEEK={\"speed\": X or \"max\"}");
	if (t && (!json_is_number(t) || !(fabs(json_number_value(t)) < 4e9)))
		return refuse(error, "`t` is recorded time in seconds, as STATUS tells it in `replay`");
	if (speed && !max && !(json_is_number(speed) && json_number_value(speed) > 0))
		return refuse(error, "`speed` is a number above 0, or \"max\"");
	command->seek = t != NULL;
	command->seek_ns = (int64_t)(json_number_value(t) * 1e9);
	command->pace = speed != NULL;
	command->speed = max ? 0 : json_number_value(speed);
	return 0;
}

static int read_arguments(json_t *arguments, struct control_command *command, char error[200])
{
	json_t *enable = json_object_get(arguments, "enable"), *stream = json_object_get(arguments, "stream");

	command->enable = true;
	if (arguments && !json_is_object(arguments))
		return refuse(error, "what follows `=` is a JSON object, e.g. ?WATCH={\"enable\":true}");
	if (enable && !json_is_boolean(enable))
		return refuse(error, "`enable` is true or false");
	if (enable)
		command->enable = json_is_true(enable);
	if (stream && !json_is_boolean(stream))
		return refuse(error, "`stream` is true or false");
	command->stream = command->word == CONTROL_RECORD && json_is_true(stream);
	if (command->word == CONTROL_SEEK)
		return read_seek(arguments, command, error);
	return command->word == CONTROL_SAVE ? read_file(arguments, command, error) : 0;
}

static json_t *load(const char *text, size_t len)
{
	return json_loadb(text, len, JSON_REJECT_DUPLICATES, NULL);
}

/* ?WORD or ?WORD={...} */
static int parse_question(const char *text, size_t len, struct control_command *command, char error[200])
{
	const char *equals = memchr(text, '=', len);
	size_t word_len = equals ? (size_t)(equals - text) : len;
	json_t *arguments = NULL;
	char word[16] = "";
	int r;

	if (word_len < sizeof(word))
		memcpy(word, text, word_len);
	r = find_word(word, &command->word, error);
	if (r < 0)
		return r;
	if (equals) {
		arguments = load(equals + 1, len - word_len - 1);
		if (!arguments)
			return refuse(error, "what follows `=` is not valid JSON");
	}
	r = read_arguments(arguments, command, error);
	json_decref(arguments);
	return r;
}

static int parse_object(const char *text, size_t len, struct control_command *command, char error[200])
{
	json_t *object = load(text, len);
	const char *word = json_string_value(json_object_get(object, "command"));
	int r = refuse(error, "a line is ?WORD, ?WORD={...} or a JSON object with \"command\"");

	if (word)
		r = find_word(word, &command->word, error);
	if (word && r == 0)
		r = read_arguments(object, command, error);
	json_decref(object);
	return r;
}

static bool blank(char c)
{
	return c == ' ' || c == '\t' || c == '\r' || c == '\n' || c == ';';
}

int control_parse(const char *text, size_t len, struct control_command *ret, char error[200])
{
	struct control_command command = {0};
	int r;

	while (len > 0 && blank(text[len - 1]))
		len--;
	while (len > 0 && blank(*text)) {
		text++;
		len--;
	}
	if (len > 0 && *text == '?')
		r = parse_question(text + 1, len - 1, &command, error);
	else
		r = parse_object(text, len, &command, error);
	if (r == 0)
		*ret = command;
	return r;
}
