/* The certificate and its key: what cannot be used is told before anybody tries. */
#include "daemon/web.h"

#ifdef HAVE_WEB

#include <errno.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <syslog.h>
#include <time.h>
#include <unistd.h>

#include "daemon/web_parts.h"

#define CERTIFICATE_MAX (256u << 10)
#define EXPIRES_SOON_S  (14 * 86400)

/* Empty: it is good; else a sentence. `ret_soon`: days until it
 * expires, if these are few, else -1. */
static void judge_certificate(const struct config *config, int *ret_soon, char error[320])
{
	union lws_tls_cert_info_results info = {0};
	struct lws_x509_cert *x509 = NULL;
	const char *path = config->listen.certificate;
	FILE *file = fopen(path, "re");
	char *text = calloc(1, CERTIFICATE_MAX);
	size_t n = file && text ? fread(text, 1, CERTIFICATE_MAX - 1, file) : 0;

	*ret_soon = -1;
	error[0] = '\0';
	if (n == 0)
		snprintf(error, 320, "listen.tls.certificate: %.120s cannot be read (%s)", path,
		         file ? "it is empty" : strerror(errno));
	else if (lws_x509_create(&x509) || lws_x509_parse_from_pem(x509, text, n + 1))
		snprintf(error, 320, "listen.tls.certificate: %.120s is no certificate in PEM", path);
	else if (lws_x509_info(x509, LWS_TLS_CERT_INFO_VALIDITY_TO, &info, 0) == 0 && info.time < time(NULL))
		snprintf(error, 320, "listen.tls.certificate: %.120s has expired; renew it", path);
	else if (info.time && info.time - time(NULL) < EXPIRES_SOON_S)
		*ret_soon = (int)((info.time - time(NULL)) / 86400);
	if (x509)
		lws_x509_destroy(&x509);
	if (file)
		fclose(file);
	free(text);
}

bool web_check_tls(const struct web *web, char error[320])
{
	const struct config *config = web->site.config;
	char text[200];
	int days;

	if (!config->listen.has_tls)
		return true;
	if (access(config->listen.key, R_OK) < 0) {
		snprintf(error, 320, "listen.tls.key: %.120s cannot be read (%s)", config->listen.key, strerror(errno));
		return false;
	}
	judge_certificate(config, &days, error);
	if (days >= 0) {
		snprintf(text, sizeof(text), "listen.tls.certificate expires in %d days; renew it", days);
		web_log(web, LOG_WARNING, text);
	}
	return error[0] == '\0';
}

#endif
