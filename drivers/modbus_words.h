/* What the end of a Modbus line or connection means, and what to do: pure, the same words for libmodbus and a virtual bus. */
#ifndef FACET_DRIVERS_MODBUS_WORDS_H
#define FACET_DRIVERS_MODBUS_WORDS_H

/* `connect`: a path (serial) or HOST:PORT; `unit`: of the device; `error`: an errno. */
void modbus_words_end(const char *connect, int unit, int error, char ret[160]);

#endif
