/* Law: no bytes from a socket crash a reader of the native protocol, make it read beyond them or allocate without
 * bound; what it accepts it would send again, byte for byte. */
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#include "core/native.h"

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);

static void must(bool condition)
{
	if (!condition)
		abort();
}

static void encode(struct buffer *b, const struct native_message *message)
{
	switch (message->type) {
	case NATIVE_HELLO:
		native_put_hello(b, &message->hello);
		break;
	case NATIVE_WANT:
		native_put_want(b, &message->want);
		break;
	case NATIVE_BEGIN:
		native_put_begin(b, &message->begin);
		break;
	case NATIVE_PATCH:
		native_put_patch(b, message->patch);
		break;
	case NATIVE_REMOVE:
		native_put_remove(b, message->remove);
		break;
	case NATIVE_PLANE:
		native_put_plane(b, &message->plane);
		break;
	case NATIVE_PLANE_GONE:
		native_put_plane_gone(b, message->plane_gone);
		break;
	case NATIVE_CODED:
		native_put_coded(b, message->coded.bytes, message->coded.len);
		break;
	case NATIVE_COMMIT:
	case NATIVE_ABORT:
		native_put_step(b, message->type, message->step);
		break;
	case NATIVE_JSON:
		native_put_json(b, message->json.text, message->json.len);
		break;
	default:
		native_put_ping(b);
		break;
	}
}

/* WANT and JSON may be padded: their beginning comes back. Three bytes of PLANE mean nothing. */
static void check_round_trip(const uint8_t *frame, size_t len, const struct native_message *message)
{
	struct buffer b = {0};

	encode(&b, message);
	if (message->type == NATIVE_WANT)
		must(b.len <= len && memcmp(b.data + 12, frame + 12, 28) == 0);
	else if (message->type == NATIVE_PLANE)
		must(b.len == len && memcmp(b.data, frame, NATIVE_HEAD + 25) == 0 &&
		     memcmp(b.data + NATIVE_HEAD + 28, frame + NATIVE_HEAD + 28, len - NATIVE_HEAD - 28) == 0);
	else if (message->type == NATIVE_JSON)
		must(b.len >= len && memcmp(b.data + NATIVE_HEAD, frame + NATIVE_HEAD, len - NATIVE_HEAD) == 0);
	else
		must(b.len == len && memcmp(b.data, frame, len) == 0);
	buffer_finish(&b);
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
	struct native_mirror *mirror = native_mirror_create();
	char error[128];
	int r = 0;

	while (r >= 0) {
		struct native_message message;
		ssize_t n = native_scan(data, size, NATIVE_TO_CLIENT_MAX);
		int decoded;

		if (n <= 0)
			break;
		must((size_t)n <= size);
		decoded = native_decode(data, (size_t)n, &message, error);
		must(decoded == 0 || strlen(error) < sizeof(error));
		if (decoded == 0) {
			check_round_trip(data, (size_t)n, &message);
			r = native_mirror_apply(mirror, &message, error);
		}
		data += n;
		size -= (size_t)n;
	}
	native_mirror_destroy(mirror);
	return 0;
}
