/* The three doors of HTTP on a robot.
 *
 *   Host    against names of others that lead to us (DNS rebinding)        on loopback, where no token is asked
 *   Origin  against pages of others in the user's browser                  on WebSockets, which browsers do not fence
 *   token   against everybody else                                         beyond loopback; on loopback to change something
 *
 * Tokens are compared by their SHA-256, in constant time: neither their length nor how much of it is right can be
 * measured. Who guesses is kept out after a few tries; that table is small and fixed, and who has more addresses than it
 * holds gains nothing but tries, of which 2^96 are needed. */
#include "daemon/web_guard.h"

#include <arpa/inet.h>
#include <netinet/in.h>
#include <string.h>
#include <strings.h>

#include "config/address.h"
#include "core/model.h"

/* The token */

static bool same_secret(const char *a, const char *b)
{
	char hex_a[65], hex_b[65];
	struct sha256 sha_a, sha_b;
	unsigned differ = 0;

	sha256_init(&sha_a);
	sha256_init(&sha_b);
	sha256_add(&sha_a, a, strlen(a));
	sha256_add(&sha_b, b, strlen(b));
	sha256_hex(&sha_a, hex_a);
	sha256_hex(&sha_b, hex_b);
	for (int i = 0; i < 64; i++)
		differ |= (unsigned)(hex_a[i] ^ hex_b[i]);
	return differ == 0;
}

/* Of `Authorization: Bearer TOKEN`; NULL where it says something else. */
static const char *bearer(const char *authorization)
{
	if (!authorization || strncasecmp(authorization, "Bearer ", 7) != 0)
		return NULL;
	return authorization + 7 + strspn(authorization + 7, " ");
}

enum web_shown web_token_judge(const char *secret, const char *authorization, const char *query)
{
	const char *shown = bearer(authorization);

	if (!shown && authorization && *authorization)
		shown = ""; /* another scheme is no way in */
	if (!shown && query && *query)
		shown = query;
	if (!shown)
		return WEB_SHOWN_NONE;
	return same_secret(secret, shown) && *secret ? WEB_SHOWN_RIGHT : WEB_SHOWN_WRONG;
}

/* Host and Origin */

/* Length of the host in `HOST`, `HOST:PORT`, `[HOST]:PORT`, brackets included; 0: it is none of these. */
static size_t host_len(const char *text)
{
	size_t n = *text == '[' ? strcspn(text, "]") : strcspn(text, ":");
	const char *rest;

	if (*text == '[' && text[n] == ']')
		n++;
	rest = text + n;
	if (*rest == ':')
		rest += 1 + strspn(rest + 1, "0123456789");
	return *rest || strpbrk(text, " /@?#\\") ? 0 : n;
}

static bool same_host(const char *a, const char *b)
{
	const size_t na = host_len(a), nb = host_len(b);

	return na > 0 && na == nb && strncasecmp(a, b, na) == 0;
}

static bool is_loopback(const char *text)
{
	const size_t n = host_len(text);
	struct in_addr v4;
	char name[64];

	if (n == 0 || n >= sizeof(name))
		return false;
	memcpy(name, text, n);
	name[n] = '\0';
	if (strcasecmp(name, "localhost") == 0 || strcmp(name, "[::1]") == 0)
		return true;
	return inet_pton(AF_INET, name, &v4) == 1 && ntohl(v4.s_addr) >> 24 == 127;
}

static bool listens_on_loopback(const struct config *config)
{
	char error[ADDRESS_ERROR_MAX];
	struct address address;

	return address_parse_host(config->listen.http, &address, error) == 0 &&
	       address_check_loopback(&address, error) == 0;
}

bool web_host_good(const struct config *config, const char *host)
{
	if (!host || host_len(host) == 0)
		return false;
	if (!listens_on_loopback(config) || is_loopback(host) || same_host(host, config->listen.http))
		return true;
	for (int i = 0; i < config->listen.origins; i++) {
		const char *listed = strstr(config->listen.origin[i], "://");

		if (listed && same_host(host, listed + 3))
			return true;
	}
	return false;
}

/* Where the scheme's own port is left out, both sides leave it out: a browser writes Host and Origin alike. */
static bool is_own(const struct config *config, const char *origin, const char *host)
{
	const char *scheme = config->listen.has_tls ? "https://" : "http://";
	const size_t n = strlen(scheme);

	return host && strncasecmp(origin, scheme, n) == 0 && strcasecmp(origin + n, host) == 0;
}

bool web_origin_good(const struct config *config, const char *origin, const char *host, const char **ret_listed)
{
	const char *listed = NULL;

	for (int i = 0; origin && i < config->listen.origins; i++)
		if (strcasecmp(origin, config->listen.origin[i]) == 0)
			listed = config->listen.origin[i];
	if (ret_listed)
		*ret_listed = listed;
	return !origin || listed || is_own(config, origin, host);
}

/* Strangers */

static void name_address(const struct sockaddr_storage *from, uint8_t ret[16])
{
	memset(ret, 0, 16);
	if (from->ss_family == AF_INET6)
		memcpy(ret, &((const struct sockaddr_in6 *)from)->sin6_addr, 8);
	if (from->ss_family == AF_INET) {
		ret[10] = ret[11] = 0xff;
		memcpy(ret + 12, &((const struct sockaddr_in *)from)->sin_addr, 4);
	}
}

static int find(const struct web_strangers *strangers, const uint8_t address[16])
{
	for (int i = 0; i < WEB_STRANGERS; i++)
		if (strangers->entry[i].last_ns && memcmp(strangers->entry[i].address, address, 16) == 0)
			return i;
	return -1;
}

int web_strangers_wait_s(const struct web_strangers *strangers, const struct sockaddr_storage *from, int64_t t_ns)
{
	uint8_t address[16];
	int i;

	name_address(from, address);
	i = find(strangers, address);
	if (i < 0 || strangers->entry[i].wrong < WEB_WRONG_MAX || t_ns - strangers->entry[i].last_ns >= WEB_WRONG_NS)
		return 0;
	return (int)((WEB_WRONG_NS - (t_ns - strangers->entry[i].last_ns) + 999999999) / 1000000000);
}

static int make_room(struct web_strangers *strangers)
{
	int oldest = 0;

	for (int i = 1; i < WEB_STRANGERS; i++)
		if (strangers->entry[i].last_ns < strangers->entry[oldest].last_ns)
			oldest = i;
	memset(&strangers->entry[oldest], 0, sizeof(strangers->entry[oldest]));
	return oldest;
}

bool web_strangers_note(struct web_strangers *strangers, const struct sockaddr_storage *from, int64_t t_ns)
{
	uint8_t address[16];
	int i;

	name_address(from, address);
	i = find(strangers, address);
	if (i < 0) {
		i = make_room(strangers);
		memcpy(strangers->entry[i].address, address, 16);
		strangers->entry[i].since_ns = t_ns;
	}
	if (t_ns - strangers->entry[i].since_ns >= WEB_WRONG_NS) {
		strangers->entry[i].since_ns = t_ns;
		strangers->entry[i].wrong = 0;
	}
	strangers->entry[i].last_ns = t_ns > 0 ? t_ns : 1;
	strangers->entry[i].wrong++;
	return strangers->entry[i].wrong == 1 || strangers->entry[i].wrong == WEB_WRONG_MAX;
}
