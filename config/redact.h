/* A configuration fit to be shown to others: recordings carry one. */
#ifndef FACET_CONFIG_REDACT_H
#define FACET_CONFIG_REDACT_H

#include "core/model.h"

/* Appends the YAML text anew, without comments and without `listen.token_file` and `listen.tls`: where secrets are is nobody's
 * business. 0, -EINVAL (no YAML), -ENOMEM. */
int config_redact(const char *text, size_t len, struct buffer *ret);

#endif
