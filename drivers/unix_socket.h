/* A unix socket's file survives the program that made it; here it is found out whether that program still lives. */
#ifndef FACET_DRIVERS_UNIX_SOCKET_H
#define FACET_DRIVERS_UNIX_SOCKET_H

#include <sys/un.h>

/* Binds with mode 0660 from the first moment on. The file of a dead program is replaced; 0, -EADDRINUSE: somebody answers
 * there, -ENOTSOCK: a file that is no socket (it is never removed), or -errno. */
int unix_socket_bind(int fd, const struct sockaddr_un *);

#endif
