/* Two multiplicative hashes of 64 bits side by side: they guard against chance, not against forgery. */
#ifndef FACET_CORE_DIGEST_H
#define FACET_CORE_DIGEST_H

#include <stdint.h>

struct digest {
	uint64_t a, b;
};

static inline void digest_word(struct digest *d, uint64_t word)
{
	d->a = (d->a ^ word) * 0x9fb21c651e98df25ull;
	d->a ^= d->a >> 29;
	d->b = (d->b + word) * 0xd6e8feb86659fd93ull;
	d->b = d->b << 31 | d->b >> 33;
}

#endif
