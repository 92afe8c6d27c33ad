/* The bytes of the native protocol (interfaces, section 4; docs/protocol.md).
 *
 *   0        4     5      6      8
 *   | length | type | flags | 0  | payload ...      length counts everything after itself: 4 + payload
 *
 * Every number is little-endian, as are all machines this is built for, so records are copied, not shifted together;
 * they are packed, so copying goes through memcpy, never through a pointer cast.
 *
 * What comes from outside is judged before it is used: a length before it is waited for, a count before memory is asked
 * for it, an index before it is stored. A decoded patch is therefore one that may be drawn without another look.
 * A message of fixed size has exactly that size; only WANT may be longer, because a client pads.
 *
 * The mirror is what a client holds. A batch collects beside it and goes in whole at COMMIT, after its announced counts
 * were found true; ABORT forgets the batch. So at no time does the mirror hold parts of two steps. */
#include "core/native.h"

#include "core/coded.h"

#include <assert.h>
#include <errno.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include <zstd.h>

_Static_assert(__BYTE_ORDER__ == __ORDER_LITTLE_ENDIAN__,
               "the wire is little-endian and so is every machine built for");

enum {
	HELLO_BYTES = 2 + 2 + 16 + 4 + 8 + 8 + 8,
	WANT_BYTES = 1 + 3 + 4 + 6 * 4,
	BEGIN_BYTES = 8 + 4 + 4 + 1,
	PATCH_HEAD_BYTES = 12 + 8 + 8 + 8 + 2 + 2 + 2,
	RUN_BYTES = 4 + 1 + 2,
	KEY_BYTES = 12,
	STEP_BYTES = 8,
	PLANE_BYTES = 4 + 3 * 4 + 8 + 1 + 3 + 4 + 6 * 4 + 8,
	PLANE_GONE_BYTES = 4,
	PACKED = 1, /* the flag of a frame */
	PACK_LEVEL = 1,
	BATCH_MAX = 1 << 20, /* patches or removals of one batch; a BEGIN that announces more is refused */
};

/* Encoding */

static void put_u8(struct buffer *b, uint8_t v)
{
	buffer_append(b, &v, 1);
}

static void put_u16(struct buffer *b, uint16_t v)
{
	buffer_append(b, &v, 2);
}

static void put_u32(struct buffer *b, uint32_t v)
{
	buffer_append(b, &v, 4);
}

static void put_u64(struct buffer *b, uint64_t v)
{
	buffer_append(b, &v, 8);
}

static void put_key(struct buffer *b, struct patch_key key)
{
	int32_t xyz[3] = {key.x, key.y, key.z};

	buffer_append(b, xyz, sizeof(xyz));
}

static void put_head(struct buffer *b, enum native_type type, size_t payload)
{
	put_u32(b, (uint32_t)(NATIVE_HEAD - 4 + payload));
	put_u8(b, (uint8_t)type);
	put_u8(b, 0);
	put_u16(b, 0);
}

void native_put_hello(struct buffer *b, const struct native_hello *hello)
{
	put_head(b, NATIVE_HELLO, HELLO_BYTES);
	put_u16(b, hello->major);
	put_u16(b, hello->minor);
	buffer_append(b, hello->map_id, sizeof(hello->map_id));
	put_u32(b, hello->generation);
	buffer_append(b, &hello->cell_m, 8);
	put_u64(b, hello->step);
	buffer_append(b, &hello->t_ns, 8);
}

/* A connection that begins with '?' or '{' speaks JSON lines: the low byte of a length must be neither. */
static bool looks_like_text(size_t length)
{
	return (length & 0xff) == '?' || (length & 0xff) == '{';
}

void native_put_want(struct buffer *b, const struct native_want *want)
{
	static const uint8_t zero[3];

	_Static_assert(((NATIVE_HEAD - 4 + WANT_BYTES) & 0xff) != '?' && ((NATIVE_HEAD - 4 + WANT_BYTES) & 0xff) != '{',
	               "WANT needs no padding");
	put_head(b, NATIVE_WANT, WANT_BYTES);
	put_u8(b, want->flags);
	buffer_append(b, zero, sizeof(zero));
	put_u32(b, want->bytes_per_s);
	buffer_append(b, want->region, sizeof(want->region));
}

void native_put_begin(struct buffer *b, const struct native_begin *begin)
{
	put_head(b, NATIVE_BEGIN, BEGIN_BYTES);
	put_u64(b, begin->step);
	put_u32(b, begin->patches);
	put_u32(b, begin->removals);
	put_u8(b, begin->reset);
}

static size_t index_bytes(uint32_t nv)
{
	return nv <= 256 ? 1 : 2;
}

static void put_indices(struct buffer *b, const struct patch *patch)
{
	const uint32_t *index = &patch->triangle[0][0];
	size_t left = (size_t)patch->nt * 3, width = index_bytes(patch->nv);
	uint8_t chunk[1024] = {0};

	while (left > 0) {
		size_t n = left < sizeof(chunk) / 2 ? left : sizeof(chunk) / 2;

		for (size_t i = 0; i < n; i++) {
			uint16_t value = (uint16_t)index[i];

			memcpy(chunk + i * width, &value, width);
		}
		buffer_append(b, chunk, n * width);
		index += n;
		left -= n;
	}
}

void native_put_patch(struct buffer *b, const struct patch *patch)
{
	assert(patch->nt > 0 && patch->nt <= UINT16_MAX && patch->nv <= PATCH_VERTICES_MAX &&
	       patch->nruns <= UINT16_MAX);
	put_head(b, NATIVE_PATCH,
	         PATCH_HEAD_BYTES + (size_t)patch->nv * 6 + (size_t)patch->nruns * RUN_BYTES +
	             (size_t)patch->nt * 3 * index_bytes(patch->nv));
	put_key(b, patch->key);
	put_u64(b, patch->version);
	buffer_append(b, &patch->t_first_ns, 8);
	buffer_append(b, &patch->t_last_ns, 8);
	put_u16(b, (uint16_t)patch->nv);
	put_u16(b, (uint16_t)patch->nt);
	put_u16(b, (uint16_t)patch->nruns);
	buffer_append(b, patch->vertex, (size_t)patch->nv * 6);
	for (uint32_t i = 0; i < patch->nruns; i++) {
		put_u32(b, patch->run[i].plane);
		put_u8(b, patch->run[i].class);
		put_u16(b, patch->run[i].triangles);
	}
	put_indices(b, patch);
}

void native_put_coded_head(struct buffer *b, size_t len)
{
	put_head(b, NATIVE_CODED, len);
}

void native_put_coded(struct buffer *b, const uint8_t *patches, size_t len)
{
	native_put_coded_head(b, len);
	buffer_append(b, patches, len);
}

void native_put_remove(struct buffer *b, struct patch_key key)
{
	put_head(b, NATIVE_REMOVE, KEY_BYTES);
	put_key(b, key);
}

void native_put_plane(struct buffer *b, const struct native_plane *plane)
{
	static const uint8_t zero[3];

	put_head(b, NATIVE_PLANE, PLANE_BYTES);
	put_u32(b, plane->id);
	buffer_append(b, plane->normal, sizeof(plane->normal));
	buffer_append(b, &plane->distance_m, 8);
	put_u8(b, plane->class);
	buffer_append(b, zero, sizeof(zero));
	buffer_append(b, &plane->area_m2, 4);
	buffer_append(b, plane->covariance, sizeof(plane->covariance));
	buffer_append(b, &plane->t_ns, 8);
}

void native_put_plane_gone(struct buffer *b, uint32_t id)
{
	put_head(b, NATIVE_PLANE_GONE, PLANE_GONE_BYTES);
	put_u32(b, id);
}

void native_put_step(struct buffer *b, enum native_type type, uint64_t step)
{
	assert(type == NATIVE_COMMIT || type == NATIVE_ABORT);
	put_head(b, type, STEP_BYTES);
	put_u64(b, step);
}

void native_put_json(struct buffer *b, const char *text, size_t len)
{
	bool pad = looks_like_text(NATIVE_HEAD - 4 + len);

	put_head(b, NATIVE_JSON, len + pad);
	buffer_append(b, text, len);
	if (pad)
		put_u8(b, ' ');
}

void native_put_ping(struct buffer *b)
{
	put_head(b, NATIVE_PING, 0);
}

/* Compression */

static int refuse(char error[128], const char *text)
{
	snprintf(error, 128, "%s", text);
	return -EPROTO;
}

struct native_packer {
	ZSTD_CCtx *zstd;
	struct buffer room; /* for a frame that turns out no smaller */
};

struct native_packer *native_packer_create(void)
{
	struct native_packer *packer = calloc(1, sizeof(*packer));

	if (!packer)
		return NULL;
	packer->zstd = ZSTD_createCCtx();
	if (!packer->zstd || ZSTD_isError(ZSTD_CCtx_setParameter(packer->zstd, ZSTD_c_compressionLevel, PACK_LEVEL))) {
		native_packer_destroy(packer);
		return NULL;
	}
	return packer;
}

void native_packer_destroy(struct native_packer *packer)
{
	if (!packer)
		return;
	ZSTD_freeCCtx(packer->zstd);
	buffer_finish(&packer->room);
	free(packer);
}

int native_put_packed(struct native_packer *packer, struct buffer *b, const uint8_t *frame, size_t len)
{
	const size_t payload = len - NATIVE_HEAD, bound = ZSTD_compressBound(payload);
	size_t n;

	assert(len >= NATIVE_HEAD);
	packer->room.len = 0;
	if (!buffer_reserve(&packer->room, bound)) {
		b->error = -ENOMEM;
		return -ENOMEM;
	}
	n = ZSTD_compress2(packer->zstd, packer->room.data, bound, frame + NATIVE_HEAD, payload);
	if (ZSTD_isError(n) || n >= payload) {
		buffer_append(b, frame, len);
		return b->error;
	}
	put_u32(b, (uint32_t)(NATIVE_HEAD - 4 + n));
	put_u8(b, frame[4]);
	put_u8(b, PACKED);
	put_u16(b, 0);
	buffer_append(b, packer->room.data, n);
	return b->error;
}

/* The size that the bytes declare is judged before memory is asked for it; they may not hold more than it, nor less. */
int native_unpack(const uint8_t *frame, size_t len, size_t max, struct buffer *ret, char error[128])
{
	unsigned long long size;
	size_t n;

	if (len < NATIVE_HEAD || native_scan(frame, len, SIZE_MAX) != (ssize_t)len || !native_is_packed(frame))
		return refuse(error, "bytes that are no compressed frame");
	size = ZSTD_getFrameContentSize(frame + NATIVE_HEAD, len - NATIVE_HEAD);
	if (size == ZSTD_CONTENTSIZE_ERROR || size == ZSTD_CONTENTSIZE_UNKNOWN || size > max - NATIVE_HEAD)
		return refuse(error, "a compressed frame of an impossible size");
	put_u32(ret, (uint32_t)(NATIVE_HEAD - 4 + size));
	put_u8(ret, frame[4]);
	put_u8(ret, 0);
	put_u16(ret, 0);
	if (!buffer_reserve(ret, size)) {
		refuse(error, "no memory for a compressed frame");
		return -ENOMEM;
	}
	n = ZSTD_decompress(ret->data + ret->len, size, frame + NATIVE_HEAD, len - NATIVE_HEAD);
	if (ZSTD_isError(n) || n != size) {
		ret->len -= NATIVE_HEAD;
		return refuse(error, "a compressed frame that cannot be decompressed");
	}
	ret->len += size;
	return 0;
}

/* Decoding */

static uint16_t get_u16(const uint8_t *p)
{
	uint16_t v;

	memcpy(&v, p, 2);
	return v;
}

static uint32_t get_u32(const uint8_t *p)
{
	uint32_t v;

	memcpy(&v, p, 4);
	return v;
}

static uint64_t get_u64(const uint8_t *p)
{
	uint64_t v;

	memcpy(&v, p, 8);
	return v;
}

static struct patch_key get_key(const uint8_t *p)
{
	return (struct patch_key){(int32_t)get_u32(p), (int32_t)get_u32(p + 4), (int32_t)get_u32(p + 8)};
}

ssize_t native_scan(const uint8_t *data, size_t len, size_t max)
{
	uint32_t length;

	if (len < 4)
		return 0;
	length = get_u32(data);
	if (length < NATIVE_HEAD - 4 || length > max - 4)
		return -EPROTO;
	if ((len > 5 && data[5] > 1) || (len > 6 && data[6] != 0) || (len > 7 && data[7] != 0))
		return -EPROTO;
	return len < (size_t)length + 4 ? 0 : (ssize_t)length + 4;
}

static int decode_hello(const uint8_t *p, size_t len, struct native_hello *ret, char error[128])
{
	struct native_hello hello = {0};

	if (len != HELLO_BYTES)
		return refuse(error, "a HELLO of the wrong length");
	hello.major = get_u16(p);
	hello.minor = get_u16(p + 2);
	memcpy(hello.map_id, p + 4, 16);
	hello.generation = get_u32(p + 20);
	memcpy(&hello.cell_m, p + 24, 8);
	hello.step = get_u64(p + 32);
	hello.t_ns = (int64_t)get_u64(p + 40);
	if (hello.major != NATIVE_MAJOR) {
		snprintf(error, 128, "the peer speaks version %u of the protocol, this program version %d", hello.major,
		         NATIVE_MAJOR);
		return -EPROTO;
	}
	if (!(hello.cell_m > 1e-6 && hello.cell_m < 1e6)) /* NaN fails too */
		return refuse(error, "a HELLO with an impossible cell size");
	*ret = hello;
	return 0;
}

static int decode_want(const uint8_t *p, size_t len, struct native_want *ret, char error[128])
{
	if (len < WANT_BYTES)
		return refuse(error, "a WANT that is too short");
	ret->flags = p[0];
	ret->bytes_per_s = get_u32(p + 4);
	memcpy(ret->region, p + 8, sizeof(ret->region));
	return 0;
}

static int decode_begin(const uint8_t *p, size_t len, struct native_begin *ret, char error[128])
{
	struct native_begin begin;

	if (len != BEGIN_BYTES)
		return refuse(error, "a BEGIN of the wrong length");
	begin = (struct native_begin){get_u64(p), get_u32(p + 8), get_u32(p + 12), p[16] == 1};
	if (p[16] > 1 || begin.patches > BATCH_MAX || begin.removals > BATCH_MAX)
		return refuse(error, "a BEGIN that announces the impossible");
	*ret = begin;
	return 0;
}

static bool key_in_range(struct patch_key key)
{
	return key.x >= -GRID_PATCH_LIMIT && key.x <= GRID_PATCH_LIMIT && key.y >= -GRID_PATCH_LIMIT &&
	       key.y <= GRID_PATCH_LIMIT && key.z >= -GRID_PATCH_LIMIT && key.z <= GRID_PATCH_LIMIT;
}

static int decode_runs(const uint8_t *p, struct patch *patch, char error[128])
{
	uint32_t sum = 0;

	for (uint32_t i = 0; i < patch->nruns; i++, p += RUN_BYTES) {
		patch->run[i].plane = get_u32(p);
		patch->run[i].class = p[4];
		patch->run[i].triangles = get_u16(p + 5);
		if (patch->run[i].triangles == 0)
			return refuse(error, "a PATCH with an empty run");
		sum += patch->run[i].triangles;
	}
	return sum == patch->nt ? 0 : refuse(error, "a PATCH whose runs do not add up to its triangles");
}

static int decode_vertices(const uint8_t *p, struct patch *patch, char error[128])
{
	memcpy(patch->vertex, p, (size_t)patch->nv * 6);
	for (uint32_t i = 0; i < patch->nv; i++)
		for (int axis = 0; axis < 3; axis++)
			if (patch->vertex[i][axis] > PATCH_SIDE * LATTICE)
				return refuse(error, "a PATCH with a vertex outside of it");
	return 0;
}

static int decode_indices(const uint8_t *p, struct patch *patch, char error[128])
{
	size_t width = index_bytes(patch->nv);

	for (uint32_t i = 0; i < patch->nt; i++) {
		uint32_t *t = patch->triangle[i];

		for (int k = 0; k < 3; k++, p += width) {
			t[k] = width == 1 ? *p : get_u16(p);
			if (t[k] >= patch->nv)
				return refuse(error, "a PATCH with an index beyond its vertices");
		}
		if (t[0] == t[1] || t[1] == t[2] || t[2] == t[0])
			return refuse(error, "a PATCH with a triangle that uses a vertex twice");
	}
	return 0;
}

static int decode_patch(const uint8_t *p, size_t len, struct patch **ret, char error[128])
{
	uint32_t nv, nt, nruns;
	struct patch *patch;
	int r;

	if (len < PATCH_HEAD_BYTES)
		return refuse(error, "a PATCH that is too short");
	nv = get_u16(p + 36);
	nt = get_u16(p + 38);
	nruns = get_u16(p + 40);
	if (nt == 0 || nv < 3 || nruns == 0)
		return refuse(error, "a PATCH without triangles");
	if (len != PATCH_HEAD_BYTES + (size_t)nv * 6 + (size_t)nruns * RUN_BYTES + (size_t)nt * 3 * index_bytes(nv))
		return refuse(error, "a PATCH whose length is not that of its counts");
	if (!key_in_range(get_key(p)))
		return refuse(error, "a PATCH beyond the limits of the map");
	patch = patch_allocate(get_key(p), nv, nt, nruns);
	if (!patch) {
		refuse(error, "no memory for a PATCH");
		return -ENOMEM;
	}
	patch->version = get_u64(p + 12);
	patch->t_first_ns = (int64_t)get_u64(p + 20);
	patch->t_last_ns = (int64_t)get_u64(p + 28);
	p += PATCH_HEAD_BYTES;
	r = decode_vertices(p, patch, error);
	if (r == 0)
		r = decode_runs(p + (size_t)nv * 6, patch, error);
	if (r == 0)
		r = decode_indices(p + (size_t)nv * 6 + (size_t)nruns * RUN_BYTES, patch, error);
	if (r < 0) {
		patch_unref(patch);
		return r;
	}
	*ret = patch;
	return 0;
}

/* Only that whole patches stand in a row; each is judged when it is decoded. */
static int decode_coded(const uint8_t *p, size_t len, struct native_message *ret, char error[128])
{
	if (len == 0)
		return refuse(error, "a CODED without patches");
	for (size_t at = 0; at < len;) {
		const ssize_t n = coded_scan(p + at, len - at);

		if (n < 0)
			return refuse(error, "a CODED whose patches are not whole");
		at += (size_t)n;
	}
	ret->coded.bytes = p;
	ret->coded.len = len;
	return 0;
}

static bool are_numbers(const float *value, int n)
{
	for (int i = 0; i < n; i++)
		if (!(value[i] - value[i] == 0)) /* not finite */
			return false;
	return true;
}

static int decode_plane(const uint8_t *p, size_t len, struct native_plane *ret, char error[128])
{
	struct native_plane plane = {0};

	if (len != PLANE_BYTES)
		return refuse(error, "a PLANE of the wrong length");
	plane.id = get_u32(p);
	memcpy(plane.normal, p + 4, sizeof(plane.normal));
	memcpy(&plane.distance_m, p + 16, 8);
	plane.class = p[24];
	memcpy(&plane.area_m2, p + 28, 4);
	memcpy(plane.covariance, p + 32, sizeof(plane.covariance));
	plane.t_ns = (int64_t)get_u64(p + 56);
	if (!are_numbers(plane.normal, 3) || !are_numbers(&plane.area_m2, 1) || !are_numbers(plane.covariance, 6) ||
	    !(plane.distance_m - plane.distance_m == 0))
		return refuse(error, "a PLANE with what is no number");
	*ret = plane;
	return 0;
}

static int decode_payload(const uint8_t *p, size_t len, struct native_message *ret, char error[128])
{
	switch (ret->type) {
	case NATIVE_HELLO:
		return decode_hello(p, len, &ret->hello, error);
	case NATIVE_WANT:
		return decode_want(p, len, &ret->want, error);
	case NATIVE_BEGIN:
		return decode_begin(p, len, &ret->begin, error);
	case NATIVE_PATCH:
		return decode_patch(p, len, &ret->patch, error);
	case NATIVE_REMOVE:
		if (len != KEY_BYTES || !key_in_range(get_key(p)))
			return refuse(error, "a REMOVE of the wrong length or beyond the limits of the map");
		ret->remove = get_key(p);
		return 0;
	case NATIVE_COMMIT:
	case NATIVE_ABORT:
		if (len != STEP_BYTES)
			return refuse(error, "a COMMIT or ABORT of the wrong length");
		ret->step = get_u64(p);
		return 0;
	case NATIVE_JSON:
		ret->json.text = (const char *)p;
		ret->json.len = len;
		return 0;
	case NATIVE_PING:
		return len == 0 ? 0 : refuse(error, "a PING of the wrong length");
	case NATIVE_CODED:
		return decode_coded(p, len, ret, error);
	case NATIVE_PLANE:
		return decode_plane(p, len, &ret->plane, error);
	case NATIVE_PLANE_GONE:
		if (len != PLANE_GONE_BYTES)
			return refuse(error, "a PLANE_GONE of the wrong length");
		ret->plane_gone = get_u32(p);
		return 0;
	}
	snprintf(error, 128, "a message of type %d, which this version does not know", ret->type);
	return -ENOTSUP;
}

int native_decode(const uint8_t *frame, size_t len, struct native_message *ret, char error[128])
{
	struct native_message message = {0};
	int r;

	if (len < NATIVE_HEAD || native_scan(frame, len, SIZE_MAX) != (ssize_t)len)
		return refuse(error, "bytes that are no frame");
	if (native_is_packed(frame)) {
		refuse(error, "a compressed message, which nobody asked for");
		return -ENOTSUP;
	}
	message.type = (enum native_type)frame[4];
	r = decode_payload(frame + NATIVE_HEAD, len - NATIVE_HEAD, &message, error);
	if (r < 0)
		return r;
	*ret = message;
	return 0;
}

void native_message_finish(struct native_message *message)
{
	if (message->type == NATIVE_PATCH && message->patch)
		patch_unref(message->patch);
	message->type = NATIVE_PING;
}

/* The mirror */

struct native_mirror {
	bool greeted, in_batch;
	struct native_hello hello;
	struct native_begin begin;
	uint64_t step;
	struct patch_store *patches;
	/* The batch being read: what it puts (removals as tombstones), in the order in which it came. */
	struct patch **pending;
	size_t pending_n, pending_cap;
	uint32_t pending_patches;
	/* The last batch that went in: removals first, references of its own. */
	struct patch **committed;
	size_t committed_n, committed_removals;
};

struct native_mirror *native_mirror_create(void)
{
	struct native_mirror *mirror = calloc(1, sizeof(*mirror));

	if (!mirror)
		return NULL;
	mirror->patches = patch_store_create();
	if (!mirror->patches) {
		free(mirror);
		return NULL;
	}
	return mirror;
}

static void forget_batch(struct native_mirror *mirror)
{
	for (size_t i = 0; i < mirror->pending_n; i++)
		patch_unref(mirror->pending[i]);
	mirror->pending_n = 0;
	mirror->pending_patches = 0;
	mirror->in_batch = false;
}

static void forget_committed(struct native_mirror *mirror)
{
	for (size_t i = 0; i < mirror->committed_n; i++)
		patch_unref(mirror->committed[i]);
	free(mirror->committed);
	mirror->committed = NULL;
	mirror->committed_n = mirror->committed_removals = 0;
}

void native_mirror_destroy(struct native_mirror *mirror)
{
	if (!mirror)
		return;
	forget_batch(mirror);
	forget_committed(mirror);
	free(mirror->pending);
	patch_store_destroy(mirror->patches);
	free(mirror);
}

/* Takes the reference over, also when it fails. */
static int pend(struct native_mirror *mirror, struct patch *patch, char error[128])
{
	if (mirror->pending_n == mirror->pending_cap) {
		size_t cap = mirror->pending_cap ? mirror->pending_cap * 2 : 64;
		struct patch **grown = realloc(mirror->pending, cap * sizeof(*grown));

		if (!grown) {
			patch_unref(patch);
			refuse(error, "no memory for a batch");
			return -ENOMEM;
		}
		mirror->pending = grown;
		mirror->pending_cap = cap;
	}
	mirror->pending[mirror->pending_n++] = patch;
	return 0;
}

static int apply_begin(struct native_mirror *mirror, const struct native_begin *begin, char error[128])
{
	if (!mirror->greeted)
		return refuse(error, "a BEGIN before HELLO");
	if (mirror->in_batch)
		return refuse(error, "a BEGIN within a batch");
	if (!begin->reset && begin->step < mirror->step)
		return refuse(error, "a BEGIN that goes back without a reset");
	mirror->begin = *begin;
	mirror->in_batch = true;
	return 0;
}

/* Takes the reference over, also when it fails. */
static int apply_patch(struct native_mirror *mirror, struct patch *patch, char error[128])
{
	const char *fault = !mirror->in_batch                                  ? "a PATCH outside of a batch"
	                    : mirror->pending_patches == mirror->begin.patches ? "more patches than the batch announced"
	                    : patch->version > mirror->begin.step              ? "a PATCH that is newer than its batch"
	                                                                       : NULL;
	if (fault) {
		patch_unref(patch);
		return refuse(error, fault);
	}
	mirror->pending_patches++;
	return pend(mirror, patch, error);
}

static int apply_coded(struct native_mirror *mirror, const uint8_t *bytes, size_t len, char error[128])
{
	int r = 0;

	for (size_t at = 0; at < len && r == 0;) {
		const ssize_t n = coded_scan(bytes + at, len - at);
		struct patch *patch;

		if (n < 0)
			return refuse(error, "a CODED whose patches are not whole");
		r = coded_get_patch(bytes + at, (size_t)n, &patch, error);
		if (r == 0)
			r = apply_patch(mirror, patch, error);
		at += (size_t)n;
	}
	return r;
}

static int apply_remove(struct native_mirror *mirror, struct patch_key key, char error[128])
{
	struct patch *tombstone;

	if (!mirror->in_batch)
		return refuse(error, "a REMOVE outside of a batch");
	if (mirror->pending_n - mirror->pending_patches == mirror->begin.removals)
		return refuse(error, "more removals than the batch announced");
	tombstone = patch_allocate(key, 0, 0, 0);
	if (!tombstone) {
		refuse(error, "no memory for a REMOVE");
		return -ENOMEM;
	}
	tombstone->version = mirror->begin.step;
	return pend(mirror, tombstone, error);
}

/* References to the batch, removals first. */
static int keep_committed(struct native_mirror *mirror)
{
	struct patch **kept = malloc((mirror->pending_n + 1) * sizeof(*kept));
	const size_t removals = mirror->pending_n - mirror->pending_patches;
	size_t gone = 0, there = removals;

	if (!kept)
		return -ENOMEM;
	for (size_t i = 0; i < mirror->pending_n; i++)
		kept[mirror->pending[i]->nt ? there++ : gone++] = patch_ref(mirror->pending[i]);
	forget_committed(mirror);
	mirror->committed = kept;
	mirror->committed_n = mirror->pending_n;
	mirror->committed_removals = removals;
	return 0;
}

static int apply_commit(struct native_mirror *mirror, uint64_t step, char error[128])
{
	const struct native_begin *begin = &mirror->begin;
	int r = 0;

	if (!mirror->in_batch || step != begin->step)
		return refuse(error, "a COMMIT of another step than the batch's");
	if (mirror->pending_patches != begin->patches || mirror->pending_n != (size_t)begin->patches + begin->removals)
		return refuse(error, "a COMMIT before everything announced has come");
	if (keep_committed(mirror) < 0) {
		refuse(error, "no memory for the map");
		return -ENOMEM;
	}
	if (begin->reset) {
		struct patch_store *fresh = patch_store_create();

		if (!fresh) {
			refuse(error, "no memory for the map");
			return -ENOMEM;
		}
		patch_store_destroy(mirror->patches);
		mirror->patches = fresh;
	}
	for (size_t i = 0; i < mirror->pending_n; i++) {
		int put = patch_store_put(mirror->patches, mirror->pending[i]);

		r = r < 0 ? r : put;
	}
	mirror->pending_n = 0;
	forget_batch(mirror);
	mirror->step = step;
	if (r < 0)
		refuse(error, "no memory for the map");
	return r < 0 ? r : 1;
}

static int apply_message(struct native_mirror *mirror, struct native_message *message, char error[128])
{
	switch (message->type) {
	case NATIVE_HELLO:
		if (mirror->in_batch)
			return refuse(error, "a HELLO within a batch");
		mirror->hello = message->hello;
		mirror->greeted = true;
		return 0;
	case NATIVE_BEGIN:
		return apply_begin(mirror, &message->begin, error);
	case NATIVE_PATCH:
		message->type = NATIVE_PING; /* the mirror has it now */
		return apply_patch(mirror, message->patch, error);
	case NATIVE_CODED:
		return apply_coded(mirror, message->coded.bytes, message->coded.len, error);
	case NATIVE_REMOVE:
		return apply_remove(mirror, message->remove, error);
	case NATIVE_COMMIT:
		return apply_commit(mirror, message->step, error);
	case NATIVE_ABORT:
		if (!mirror->in_batch)
			return refuse(error, "an ABORT outside of a batch");
		forget_batch(mirror);
		return 0;
	case NATIVE_WANT:
		return refuse(error, "a WANT from the server");
	case NATIVE_JSON:
	case NATIVE_PING:
	case NATIVE_PLANE:
	case NATIVE_PLANE_GONE:
		break;
	}
	return 0;
}

int native_mirror_apply(struct native_mirror *mirror, struct native_message *message, char error[128])
{
	int r = apply_message(mirror, message, error);

	native_message_finish(message);
	return r;
}

const struct patch_store *native_mirror_patches(const struct native_mirror *mirror)
{
	return mirror->patches;
}

const struct native_hello *native_mirror_hello(const struct native_mirror *mirror)
{
	return mirror->greeted ? &mirror->hello : NULL;
}

uint64_t native_mirror_step(const struct native_mirror *mirror)
{
	return mirror->step;
}

struct patch *const *native_mirror_changed(const struct native_mirror *mirror, size_t *ret_n)
{
	*ret_n = mirror->committed_n - mirror->committed_removals;
	return mirror->committed_n ? mirror->committed + mirror->committed_removals : NULL;
}

struct patch *const *native_mirror_removed(const struct native_mirror *mirror, size_t *ret_n)
{
	*ret_n = mirror->committed_removals;
	return mirror->committed;
}

bool native_mirror_was_reset(const struct native_mirror *mirror)
{
	return mirror->begin.reset;
}

void native_mirror_lost(struct native_mirror *mirror)
{
	forget_batch(mirror);
}
