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

/* A frame that was packed is, unpacked, the frame it was. */
static void check_packing(struct native_packer *packer, const uint8_t *frame, size_t len)
{
	struct buffer packed = {0}, plain = {0};
	char error[128];

	must(native_put_packed(packer, &packed, frame, len) == 0);
	if (native_is_packed(packed.data))
		must(packed.len < len && native_unpack(packed.data, packed.len, len, &plain, error) == 0);
	else
		buffer_append(&plain, packed.data, packed.len);
	must(plain.len == len && memcmp(plain.data, frame, len) == 0);
	buffer_finish(&packed);
	buffer_finish(&plain);
}

/* 0, 1 after a COMMIT, negative: the client hangs up. */
static int hear(struct native_mirror *mirror, struct native_packer *packer, const uint8_t *frame, size_t len)
{
	struct native_message message;
	char error[128];
	int decoded = native_decode(frame, len, &message, error);

	must(decoded == 0 || strlen(error) < sizeof(error));
	if (decoded < 0)
		return 0;
	check_round_trip(frame, len, &message);
	check_packing(packer, frame, len);
	return native_mirror_apply(mirror, &message, error);
}

static void check_last_batch(const struct native_mirror *mirror)
{
	size_t n;
	struct patch *const *patch = native_mirror_changed(mirror, &n);

	must(native_mirror_hello(mirror) != NULL);
	must(!native_mirror_was_reset(mirror) || patch_store_count(native_mirror_patches(mirror)) <= n);

	for (size_t i = 0; i < n; i++)
		must(patch[i]->nt > 0 && patch[i]->version <= native_mirror_step(mirror));
	patch = native_mirror_removed(mirror, &n);
	for (size_t i = 0; i < n; i++)
		must(patch[i]->nt == 0);
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
	struct native_mirror *mirror = native_mirror_create();
	struct native_packer *packer = native_packer_create();
	int r = 0;

	must(mirror && packer);
	while (r >= 0) {
		struct buffer plain = {0};
		ssize_t n = native_scan(data, size, NATIVE_TO_CLIENT_MAX);
		char error[128];

		if (n <= 0)
			break;
		must((size_t)n <= size);
		if (native_is_packed(data) && native_unpack(data, (size_t)n, 1 << 20, &plain, error) == 0) {
			must(plain.len <= 1 << 20);
			r = hear(mirror, packer, plain.data, plain.len);
		} else {
			r = hear(mirror, packer, data, (size_t)n);
		}
		if (r == 1)
			check_last_batch(mirror);
		buffer_finish(&plain);
		data += n;
		size -= (size_t)n;
	}
	native_mirror_lost(mirror);
	native_packer_destroy(packer);
	native_mirror_destroy(mirror);
	return 0;
}
