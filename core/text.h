/* Numbers out of text, without a locale and fast: what the readers of point files share.
 * A cursor walks over borrowed bytes, line by line; numbers never cross a line's end. */
#ifndef FACET_CORE_TEXT_H
#define FACET_CORE_TEXT_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

struct text {
	const char *at, *end; /* borrowed */
	uint32_t line;        /* of `at`, from 1 */
};

void text_init(struct text *, const void *data, size_t len);

/* The next number of this line, behind blanks, commas and semicolons; relative error < 1e-15. `nan` and `inf` are numbers.
 * False, and the cursor unmoved, where the line goes on with something else or ends. */
bool text_number(struct text *, double *ret);

/* Up to `max` numbers; how many there were. */
int text_numbers(struct text *, int max, double *ret);

bool text_line_ended(struct text *); /* only blanks are left in this line */
void text_next_line(struct text *);
bool text_ended(const struct text *); /* no line is left */

/* Skips blank lines and lines that begin with '#'; false where none is left. */
bool text_skip_empty(struct text *);

/* The line without its end and without blanks around it; the cursor moves to the next line. */
size_t text_take_line(struct text *, const char **ret_line);

#endif
