/* The folder of recordings: names of files that say when they began and of which map they are, and room for them. */
#ifndef FACET_DAEMON_RECORDING_FOLDER_H
#define FACET_DAEMON_RECORDING_FOLDER_H

#include "daemon/recording.h"

#define RECORDING_PATH_MAX 512

/* Begins a file under a name that was not there; the folder is made where it is missing. Its descriptor, or -errno: -ENOSPC where
 * less than RECORDER_ROOM_BYTES are free. `ret_path` names what was tried. */
int recording_folder_open(const char *dir, const struct recording_begin *, char ret_path[RECORDING_PATH_MAX]);

/* The oldest recordings go until all of them, the one at `path` included, which stays, are within `keep` bytes. Other files in the
 * folder are not ours and are neither counted nor removed. */
void recording_folder_keep(const char *dir, uint64_t keep, const char *path);

#endif
