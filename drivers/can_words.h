/* What an end of a CAN link means, and what to do: pure, the same words for the kernel's interfaces and a virtual bus. */
#ifndef FACET_DRIVERS_CAN_WORDS_H
#define FACET_DRIVERS_CAN_WORDS_H

#include <stdbool.h>

bool can_words_hub(const char *connect); /* `unix:PATH`, else an interface */
/* It could not be opened, it was lost: `error` is an errno. */
void can_words_opening(const char *interface, int error, char ret[160]);
void can_words_end(const char *connect, int error, char ret[160]);

#endif
