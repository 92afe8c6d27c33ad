/* SHA-256 after FIPS 180-4, for the hashes that prove that the same rows give the same bytes (law L2). */
#include "core/model.h"

#include <stdio.h>
#include <string.h>

/* The first 32 bits of the fractional parts of the cube roots of the first 64 primes (4.2.2). */
static const uint32_t round_constant[64] = {
    0x428a2f98, 0x71374491, 0xb5c0fbcf, 0xe9b5dba5, 0x3956c25b, 0x59f111f1, 0x923f82a4, 0xab1c5ed5,
    0xd807aa98, 0x12835b01, 0x243185be, 0x550c7dc3, 0x72be5d74, 0x80deb1fe, 0x9bdc06a7, 0xc19bf174,
    0xe49b69c1, 0xefbe4786, 0x0fc19dc6, 0x240ca1cc, 0x2de92c6f, 0x4a7484aa, 0x5cb0a9dc, 0x76f988da,
    0x983e5152, 0xa831c66d, 0xb00327c8, 0xbf597fc7, 0xc6e00bf3, 0xd5a79147, 0x06ca6351, 0x14292967,
    0x27b70a85, 0x2e1b2138, 0x4d2c6dfc, 0x53380d13, 0x650a7354, 0x766a0abb, 0x81c2c92e, 0x92722c85,
    0xa2bfe8a1, 0xa81a664b, 0xc24b8b70, 0xc76c51a3, 0xd192e819, 0xd6990624, 0xf40e3585, 0x106aa070,
    0x19a4c116, 0x1e376c08, 0x2748774c, 0x34b0bcb5, 0x391c0cb3, 0x4ed8aa4a, 0x5b9cca4f, 0x682e6ff3,
    0x748f82ee, 0x78a5636f, 0x84c87814, 0x8cc70208, 0x90befffa, 0xa4506ceb, 0xbef9a3f7, 0xc67178f2};

static uint32_t rotate(uint32_t x, int n)
{
	return x >> n | x << (32 - n);
}

static void schedule(const uint8_t block[64], uint32_t w[64])
{
	for (int t = 0; t < 16; t++)
		w[t] = (uint32_t)block[4 * t] << 24 | (uint32_t)block[4 * t + 1] << 16 |
		       (uint32_t)block[4 * t + 2] << 8 | block[4 * t + 3];
	for (int t = 16; t < 64; t++) {
		uint32_t s0 = rotate(w[t - 15], 7) ^ rotate(w[t - 15], 18) ^ w[t - 15] >> 3;
		uint32_t s1 = rotate(w[t - 2], 17) ^ rotate(w[t - 2], 19) ^ w[t - 2] >> 10;
		w[t] = w[t - 16] + s0 + w[t - 7] + s1;
	}
}

/* One round on the eight working variables, a .. h; instead of moving them on, the caller renames them. */
static inline void turn(uint32_t a, uint32_t b, uint32_t c, uint32_t *d, uint32_t e, uint32_t f, uint32_t g,
                        uint32_t *h, uint32_t word)
{
	uint32_t sum1 = rotate(e, 6) ^ rotate(e, 11) ^ rotate(e, 25), choice = (e & f) ^ (~e & g);
	uint32_t sum0 = rotate(a, 2) ^ rotate(a, 13) ^ rotate(a, 22), majority = (a & b) ^ (a & c) ^ (b & c);
	uint32_t t1 = *h + sum1 + choice + word;
	*d += t1;
	*h = t1 + sum0 + majority;
}

static void compress(uint32_t state[8], const uint8_t block[64])
{
	uint32_t w[64];
	uint32_t a = state[0], b = state[1], c = state[2], d = state[3];
	uint32_t e = state[4], f = state[5], g = state[6], h = state[7];
	schedule(block, w);
	for (int t = 0; t < 64; t++)
		w[t] += round_constant[t];
	for (int t = 0; t < 64; t += 8) {
		turn(a, b, c, &d, e, f, g, &h, w[t]);
		turn(h, a, b, &c, d, e, f, &g, w[t + 1]);
		turn(g, h, a, &b, c, d, e, &f, w[t + 2]);
		turn(f, g, h, &a, b, c, d, &e, w[t + 3]);
		turn(e, f, g, &h, a, b, c, &d, w[t + 4]);
		turn(d, e, f, &g, h, a, b, &c, w[t + 5]);
		turn(c, d, e, &f, g, h, a, &b, w[t + 6]);
		turn(b, c, d, &e, f, g, h, &a, w[t + 7]);
	}
	const uint32_t result[8] = {a, b, c, d, e, f, g, h};
	for (int i = 0; i < 8; i++)
		state[i] += result[i];
}

void sha256_init(struct sha256 *sha)
{
	/* Of the square roots of the first 8 primes (5.3.3). */
	static const uint32_t start[8] = {0x6a09e667, 0xbb67ae85, 0x3c6ef372, 0xa54ff53a,
	                                  0x510e527f, 0x9b05688c, 0x1f83d9ab, 0x5be0cd19};
	*sha = (struct sha256){0};
	memcpy(sha->h, start, sizeof start);
}

void sha256_add(struct sha256 *sha, const void *data, size_t len)
{
	const uint8_t *from = data;
	while (len) {
		size_t held = sha->len % 64, n = len < 64 - held ? len : 64 - held;
		if (n == 64) {
			compress(sha->h, from);
		} else {
			memcpy(sha->block + held, from, n);
			if (held + n == 64)
				compress(sha->h, sha->block);
		}
		from += n;
		len -= n;
		sha->len += n;
	}
}

void sha256_hex(struct sha256 *sha, char ret_hex[65])
{
	uint64_t bits = sha->len * 8;
	uint8_t tail[8];
	for (int i = 0; i < 8; i++)
		tail[i] = (uint8_t)(bits >> (56 - 8 * i));
	sha256_add(sha, "\x80", 1);
	while (sha->len % 64 != 56)
		sha256_add(sha, "", 1);
	sha256_add(sha, tail, sizeof tail);
	for (int i = 0; i < 8; i++)
		snprintf(ret_hex + 8 * i, 9, "%08x", (unsigned)sha->h[i]);
}
