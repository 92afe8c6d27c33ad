/* Law L2: what is remembered of a patch is what would be made again, and nothing else is ever given for it. */
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <cmocka.h>
#include <stdlib.h>
#include <string.h>

#include "core/memo.h"

static const struct patch_key one = {3, -4, 5}, other = {3, -4, 6};

static struct memo *memo_of(const struct patch_key *keys, size_t n)
{
	struct memo *memo = calloc(1, sizeof *memo);
	assert_non_null(memo);
	memo_expect(memo, keys, n);
	return memo;
}

static void forget(struct memo *memo)
{
	memo_finish(memo);
	free(memo);
}

/* Made of a surface with that digest and of a window with a digest of its own. */
static struct memo_source source_of(struct digest surface)
{
	return (struct memo_source){.window = {surface.a + 100, surface.b}, .surface = surface, .faces_raw = 50};
}

static void keep(struct memo *memo, struct patch_key key, struct digest surface, uint32_t nt)
{
	struct patch *patch = patch_allocate(key, 3, nt, 1);
	const struct memo_source source = source_of(surface);
	memo_keep(memo, &source, patch);
	patch_unref(patch);
}

static const struct patch *find(struct memo *memo, struct patch_key key, struct digest surface)
{
	const struct memo_source source = source_of(surface);
	return memo_find(memo, key, &source);
}

static void a_patch_is_found_by_its_key_and_digest_only(void **state)
{
	(void)state;
	struct memo *memo = memo_of(&one, 1);
	struct digest digest = {1, 2};
	assert_null(find(memo, one, digest));
	keep(memo, one, digest, 7);
	const struct patch *found = find(memo, one, digest);
	assert_non_null(found);
	assert_int_equal(found->nt, 7);
	assert_null(find(memo, other, digest));
	assert_null(find(memo, one, (struct digest){1, 3}));
	assert_null(find(memo, one, (struct digest){2, 2}));
	forget(memo);
}

static void a_patch_is_recalled_by_the_newest_window_that_gave_its_surface(void **state)
{
	(void)state;
	struct memo *memo = memo_of(&one, 1);
	const struct digest surface = {1, 2}, first = source_of(surface).window, second = {8, 9};
	struct memo_source source = source_of(surface);
	uint32_t faces = 0;
	assert_null(memo_recall(memo, one, first, &faces));
	keep(memo, one, surface, 7);
	assert_null(memo_recall(memo, other, first, &faces));
	assert_null(memo_recall(memo, one, second, &faces));
	assert_int_equal(faces, 0);
	const struct patch *patch = memo_recall(memo, one, first, &faces);
	assert_int_equal(patch->nt, 7);
	assert_int_equal(faces, 50);
	source.window = second;
	assert_ptr_equal(memo_find(memo, one, &source), patch);
	assert_ptr_equal(memo_recall(memo, one, second, &faces), patch);
	assert_null(memo_recall(memo, one, first, &faces));
	forget(memo);
}

static void a_key_that_nobody_expected_is_not_remembered(void **state)
{
	(void)state;
	struct memo *memo = memo_of(&one, 1);
	keep(memo, other, (struct digest){1, 2}, 7);
	assert_null(find(memo, other, (struct digest){1, 2}));
	forget(memo);
}

static void a_patch_too_large_replaces_the_old_one_by_none(void **state)
{
	(void)state;
	struct memo *memo = memo_of(&one, 1);
	keep(memo, one, (struct digest){1, 2}, 7);
	keep(memo, one, (struct digest){3, 4}, MEMO_BYTES_MAX / 12);
	assert_null(find(memo, one, (struct digest){1, 2}));
	assert_null(find(memo, one, (struct digest){3, 4}));
	forget(memo);
}

/* Far more keys than slots: in one set the first of a slot keeps it, in the next set another one may take it. */
static void of_more_keys_than_slots_none_gets_the_patch_of_another(void **state)
{
	(void)state;
	enum { KEYS = 4 * MEMO_SLOTS };
	static struct patch_key keys[KEYS];
	for (int k = 0; k < KEYS; k++)
		keys[k] = (struct patch_key){k % 16, k / 16 % 16, k / 256};
	struct memo *memo = memo_of(keys, KEYS);
	for (int set = 0; set < 2; set++) {
		int held = 0;
		for (int k = 0; k < KEYS; k++)
			keep(memo, keys[k], (struct digest){1, 2}, 1);
		for (int k = 0; k < KEYS; k++) {
			const struct patch *found = find(memo, keys[k], (struct digest){1, 2});
			assert_true(!found || !patch_key_compare(found->key, keys[k]));
			held += found != NULL;
		}
		assert_in_range(held, MEMO_SLOTS / 4, MEMO_SLOTS);
		memo_expect(memo, keys + KEYS / 2, KEYS / 2);
	}
	forget(memo);
}

static void everything_the_reduction_reads_is_in_the_digest(void **state)
{
	(void)state;
	uint16_t vertex[3][3] = {{1, 2, 3}, {4, 5, 6}, {7, 8, 9}};
	uint32_t triangle[1][3] = {{0, 1, 2}}, member[2] = {0, 1};
	uint8_t kind[3] = {0, 1, 2}, faces[3] = {0, 1, 1};
	bool kept[2] = {true, false};
	struct border_chain chain[1] = {{0, 2, false, 0, 1}};
	const struct surface raw = {.nv = 3, .nt = 1, .vertex = vertex, .triangle = triangle};
	const struct border border = {kind, faces, chain, 1, 2, member, kept};
	const struct digest before = memo_digest(&raw, &border);
	const struct digest again = memo_digest(&raw, &border);
	assert_memory_equal(&before, &again, sizeof before);
	uint8_t *byte[] = {(uint8_t *)vertex + 17, (uint8_t *)triangle + 8, (uint8_t *)member + 4,  kind + 2, faces + 1,
	                   (uint8_t *)kept + 1,    (uint8_t *)&chain->n,    (uint8_t *)&chain->high};
	for (size_t k = 0; k < sizeof byte / sizeof *byte; k++) {
		*byte[k] ^= 1;
		struct digest changed = memo_digest(&raw, &border);
		assert_true(changed.a != before.a && changed.b != before.b);
		*byte[k] ^= 1;
	}
}

int main(void)
{
	const struct CMUnitTest tests[] = {
	    cmocka_unit_test(a_patch_is_found_by_its_key_and_digest_only),
	    cmocka_unit_test(a_patch_is_recalled_by_the_newest_window_that_gave_its_surface),
	    cmocka_unit_test(a_key_that_nobody_expected_is_not_remembered),
	    cmocka_unit_test(a_patch_too_large_replaces_the_old_one_by_none),
	    cmocka_unit_test(of_more_keys_than_slots_none_gets_the_patch_of_another),
	    cmocka_unit_test(everything_the_reduction_reads_is_in_the_digest),
	};
	return cmocka_run_group_tests(tests, NULL, NULL);
}
