/* How likely a zero is at every decision of a coded patch before the patch has taught it, in 1/256 (core/coded.c). */
#ifndef FACET_CORE_CODED_TABLE_H
#define FACET_CORE_CODED_TABLE_H

#include <stdint.h>

#define CODED_CONTEXTS 1156

extern const uint8_t coded_table[CODED_CONTEXTS];

#endif
