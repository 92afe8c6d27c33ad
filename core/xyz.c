/* Clouds as plain text: .xyz, `x y z` and whatever else a line, and .pts, the same behind a line with the number of points.
 *
 *   81360                      the count is only believed to be a count: files that were cut or filtered keep a wrong one
 *   1.25 -0.3 0.17 113 255 ... intensity and colours are left aside
 *
 * One line of words at the top (`x,y,z`, `//X Y Z`) is a header; `#` begins a comment. Metres. */
#include <errno.h>

#include "core/cloud.h"
#include "core/text.h"

int xyz_read(const uint8_t *data, size_t len, struct cloud *ret, struct parse_error *error)
{
	struct cloud_builder builder = {0};
	struct text text;
	text_init(&text, data, len);
	bool header = true;
	int r = 0;
	while (r == 0 && text_skip_empty(&text)) {
		double v[3];
		int n = text_numbers(&text, 3, v);
		if (n == 3)
			r = cloud_add(&builder, v[0], v[1], v[2]);
		else if (!header)
			r = cloud_refuse(error, text.line, "expected x y z in metres; is this a cloud as text?");
		header = false;
		text_next_line(&text);
	}
	return cloud_take(&builder, r, ret, error);
}
