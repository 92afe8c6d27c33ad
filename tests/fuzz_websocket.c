/* Law: no bytes of a server crash a client's WebSocket or make it read beyond them; they mean the same however they are cut, and
 * leave no more than they were, but for a text's newline. The first byte says how they are cut; an answer to the handshake stands
 * before the frames, as it comes. */
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#include "tools/libfacet_websocket.h"

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);

static void must(bool condition)
{
	if (!condition)
		abort();
}

/* What was left, or a negative number; answers are appended. */
static ssize_t hear(const uint8_t *data, size_t size, size_t piece, struct buffer *ret, struct buffer *answers)
{
	static const uint8_t mask[4] = {1, 2, 3, 4};
	struct websocket ws = {0};
	char error[WEBSOCKET_ERROR_MAX] = "";
	ssize_t kept = 0;
	for (size_t at = 0; at < size && kept >= 0; at += piece) {
		const size_t n = size - at < piece ? size - at : piece;
		uint8_t *place = malloc(n + 1);
		must(place);
		memcpy(place + 1, data + at, n);
		kept = websocket_hear(&ws, place, n, mask, answers, error);
		must(kept <= (ssize_t)n + 1 && (kept >= 0 || error[0]));
		if (kept > 0)
			buffer_append(ret, place, (size_t)kept);
		free(place);
	}
	return ws.closed ? -1 : kept < 0 ? kept : 0;
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
	static const uint8_t key[16] = "the sample nonce";
	struct buffer whole = {0}, cut = {0}, answers = {0}, more_answers = {0};
	char error[WEBSOCKET_ERROR_MAX] = "";
	if (size < 1)
		return 0;
	const size_t piece = data[0] + 1u;
	const ssize_t head = websocket_judge(data + 1, size - 1, key, error);
	must(head <= (ssize_t)size - 1 && (head >= 0 || error[0]));
	data += 1 + (head > 0 ? head : 0);
	size -= 1 + (size_t)(head > 0 ? head : 0);
	const ssize_t one = hear(data, size, size + 1, &whole, &answers),
	              other = hear(data, size, piece, &cut, &more_answers);
	must(one == other && answers.len == more_answers.len);
	/* Where it went wrong, pieces before that place were left; at once, nothing was. */
	must(one < -1 || (whole.len == cut.len && (!whole.len || memcmp(whole.data, cut.data, whole.len) == 0)));
	buffer_finish(&whole);
	buffer_finish(&cut);
	buffer_finish(&answers);
	buffer_finish(&more_answers);
	return 0;
}
