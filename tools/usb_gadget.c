/* The files of a USB gadget (linux/Documentation/usb/gadget_configfs):
 *
 *   usb_gadget/NAME/idVendor idProduct UDC strings/0x409/... configs/c.1/ffs.NAME -> functions/ffs.NAME
 *
 * and the FunctionFS of ffs.NAME mounted below /run. Folders of configfs are removed in the order opposite to their making;
 * what a simulator that was killed left behind under the same name is removed first. */
#include "tools/usb_gadget.h"

#include <dirent.h>
#include <errno.h>
#include <fcntl.h>
#include <stdio.h>
#include <string.h>
#include <sys/mount.h>
#include <sys/stat.h>
#include <unistd.h>

#define GADGETS     "/sys/kernel/config/usb_gadget"
#define CONTROLLERS "/sys/class/udc"
#define FILE_MAX    256

static int write_file(const char *dir, const char *name, const char *text)
{
	char path[FILE_MAX];
	snprintf(path, sizeof path, "%.160s/%.90s", dir, name);
	const int fd = open(path, O_WRONLY | O_CLOEXEC);
	if (fd < 0)
		return -errno;
	const ssize_t n = write(fd, text, strlen(text));
	const int r = n < 0 ? -errno : 0;
	close(fd);
	return r;
}

static int make_dir(const char *dir, const char *name)
{
	char path[FILE_MAX];
	snprintf(path, sizeof path, "%.160s/%.90s", dir, name);
	return mkdir(path, 0755) < 0 && errno != EEXIST ? -errno : 0;
}

static void remove_dir(const char *dir, const char *name)
{
	char path[FILE_MAX];
	snprintf(path, sizeof path, "%.160s/%.90s", dir, name);
	rmdir(path);
}

static bool controller_used(const char *controller)
{
	char path[FILE_MAX], text[64] = "";
	snprintf(path, sizeof path, CONTROLLERS "/%s/function", controller);
	FILE *f = fopen(path, "re");
	if (f == NULL)
		return false;
	const bool used = fgets(text, sizeof text, f) != NULL && text[0] != '\n';
	fclose(f);
	return used;
}

/* Of several free ones the first by name, so that the first scanner is always on the first port. */
static int find_controller(char ret_name[64])
{
	DIR *dir = opendir(CONTROLLERS);
	if (dir == NULL)
		return -ENODEV;
	char found[64] = "";
	for (struct dirent *entry; (entry = readdir(dir)) != NULL;)
		if (entry->d_name[0] != '.' && strlen(entry->d_name) < sizeof found &&
		    !controller_used(entry->d_name) && (found[0] == '\0' || strcmp(entry->d_name, found) < 0))
			strcpy(found, entry->d_name);
	closedir(dir);
	if (found[0] == '\0')
		return -ENODEV;
	strcpy(ret_name, found);
	return 0;
}

static int describe(const struct usb_gadget *gadget, const struct usb_gadget_params *params)
{
	char strings[FILE_MAX], number[8];
	int r = make_dir(GADGETS, gadget->name);
	snprintf(number, sizeof number, "0x%04x", params->vendor);
	if (r == 0)
		r = write_file(gadget->dir, "idVendor", number);
	snprintf(number, sizeof number, "0x%04x", params->product);
	if (r == 0)
		r = write_file(gadget->dir, "idProduct", number);
	if (r == 0)
		r = make_dir(gadget->dir, "strings/0x409");
	snprintf(strings, sizeof strings, "%s/strings/0x409", gadget->dir);
	if (r == 0 && params->manufacturer != NULL)
		r = write_file(strings, "manufacturer", params->manufacturer);
	if (r == 0 && params->title != NULL)
		r = write_file(strings, "product", params->title);
	if (r == 0 && params->serial != NULL)
		r = write_file(strings, "serialnumber", params->serial);
	return r;
}

static int add_function(const struct usb_gadget *gadget)
{
	char function[64], target[FILE_MAX], link[FILE_MAX];
	snprintf(function, sizeof function, "functions/ffs.%s", gadget->name);
	int r = make_dir(gadget->dir, function);
	if (r == 0)
		r = make_dir(gadget->dir, "configs/c.1");
	snprintf(target, sizeof target, "%s/%s", gadget->dir, function);
	snprintf(link, sizeof link, "%s/configs/c.1/ffs.%s", gadget->dir, gadget->name);
	if (r == 0 && symlink(target, link) < 0 && errno != EEXIST)
		r = -errno;
	if (r == 0 && mkdir(gadget->mount, 0700) < 0 && errno != EEXIST)
		r = -errno;
	if (r == 0 && mount(gadget->name, gadget->mount, "functionfs", MS_NOSUID | MS_NODEV | MS_NOEXEC, "") < 0)
		r = -errno;
	return r;
}

static int failed(const char *name, int r, char error[160])
{
	if (r == -EACCES || r == -EPERM)
		snprintf(error, 160, "%.32s: only root may make a USB device; run it as root", name);
	else if (r == -ENODEV || r == -ENOENT)
		snprintf(
		    error, 160,
		    "%.32s: this kernel has no free USB device controller; modprobe -a dummy_hcd libcomposite usb_f_fs",
		    name);
	else
		snprintf(error, 160, "%.32s: the kernel refuses the USB device (%s)", name, strerror(-r));
	return r;
}

int usb_gadget_create(const struct usb_gadget_params *params, struct usb_gadget *ret, char error[160])
{
	struct usb_gadget gadget;
	memset(&gadget, 0, sizeof gadget);
	snprintf(gadget.name, sizeof gadget.name, "%s", params->name);
	snprintf(gadget.dir, sizeof gadget.dir, GADGETS "/%s", gadget.name);
	snprintf(gadget.mount, sizeof gadget.mount, "/run/usb-gadget-%s", gadget.name);
	if (access(GADGETS, F_OK) < 0)
		mount("none", "/sys/kernel/config", "configfs", 0, NULL); /* if it fails, the next step says so */
	usb_gadget_destroy(&gadget);
	int r = access(GADGETS, F_OK) < 0 ? -errno : 0;
	if (r == 0 && params->controller != NULL)
		snprintf(gadget.controller, sizeof gadget.controller, "%s", params->controller);
	else if (r == 0)
		r = find_controller(gadget.controller);
	if (r == 0)
		r = describe(&gadget, params);
	if (r == 0)
		r = add_function(&gadget);
	if (r < 0) {
		usb_gadget_destroy(&gadget);
		return failed(params->name, r, error);
	}
	*ret = gadget;
	return 0;
}

void usb_gadget_destroy(struct usb_gadget *gadget)
{
	char path[FILE_MAX];
	write_file(gadget->dir, "UDC", "\n");
	umount2(gadget->mount, MNT_DETACH);
	rmdir(gadget->mount);
	snprintf(path, sizeof path, "%s/configs/c.1/ffs.%s", gadget->dir, gadget->name);
	unlink(path);
	remove_dir(gadget->dir, "configs/c.1");
	snprintf(path, sizeof path, "functions/ffs.%s", gadget->name);
	remove_dir(gadget->dir, path);
	remove_dir(gadget->dir, "strings/0x409");
	rmdir(gadget->dir);
}

int usb_gadget_plug(const struct usb_gadget *gadget, bool in)
{
	return write_file(gadget->dir, "UDC", in ? gadget->controller : "\n");
}
