# facetd. `make` builds the release, `make help` lists the targets.
config ?= release
CC_release := gcc
ifneq ($(origin CC),default)
CC_release := $(CC)
endif
PREFIX ?= /usr/local
DESTDIR ?=
Q := $(if $(V),,@) # make V=1 shows the commands

ifeq ($(config),release)
B := build
else
B := build/$(config)
endif

CC_debug := $(CC_release)
CC_sanitize := clang
CC_thread := clang
CC_fuzz := clang
CC := $(CC_$(config))
FLAGS_release := -O3 -g
FLAGS_debug := -O0 -g
FLAGS_sanitize := -O1 -g -fsanitize=address,undefined -fno-sanitize-recover=all -fno-omit-frame-pointer
FLAGS_thread := -O1 -g -fsanitize=thread -fno-omit-frame-pointer
FLAGS_fuzz := -O1 -g -fsanitize=fuzzer-no-link,address,undefined -fno-sanitize-recover=all -fprofile-instr-generate -fcoverage-mapping
ifeq ($(CC),)
$(error config=$(config) is not known; use release, debug, sanitize, thread or fuzz)
endif

# -ffp-contract=off: the same bytes on every machine (law L2).
PACKAGES := libuv yaml-0.1 jansson libpng libmodbus libsystemd libzstd zlib
have = $(shell pkg-config --exists $(1) 2>/dev/null && echo yes)
# What can be left out, and what the build then says.
ifeq ($(call have,libusb-1.0),yes)
PACKAGES += libusb-1.0
OPTIONS += -DHAVE_USB
else
LEFT_OUT += 'scanners on USB (libusb-1.0-0-dev)'
endif
ifeq ($(call have,libwebsockets),yes)
PACKAGES += libwebsockets
OPTIONS += -DHAVE_WEB
else
LEFT_OUT += 'the page, snapshots, figures and WebSockets (libwebsockets-dev, libwebsockets-evlib-uv)'
endif
CFLAGS_ALL := -std=c17 -D_GNU_SOURCE -I. -I$(B)/gen -MMD -MP -Wall -Wextra -Wshadow -Wstrict-prototypes \
	-Wmissing-prototypes -Wvla -ffp-contract=off -fno-strict-aliasing -pthread $(FLAGS_$(config)) $(OPTIONS) $(CFLAGS) \
	$(shell pkg-config --cflags $(PACKAGES) 2>/dev/null)
LDFLAGS_ALL := -pthread $(FLAGS_$(config)) $(LDFLAGS)
LIBS := $(shell pkg-config --libs $(PACKAGES) 2>/dev/null) -lm

comma := ,
LIBFACET_ABI := 0
VERSION := $(shell cat VERSION 2>/dev/null || echo 0)

objects = $(patsubst %.c,$(B)/obj/%.o,$(1))
CORE := $(wildcard core/*.c)
CONFIG := $(wildcard config/*.c)
DRIVERS := $(wildcard drivers/*.c)
DAEMON := $(filter-out daemon/facetd.c,$(wildcard daemon/*.c))
TOOLS := $(filter-out tools/facet.c,$(wildcard tools/*.c))
TESTS := $(patsubst tests/%.c,%,$(wildcard tests/test_*.c))
PROGRAMS := clients steps usb_bed gadget canopen_node angles
BENCHES := $(patsubst bench/%.c,%,$(wildcard bench/*.c))
RIGGED := $(filter test_rig test_cola_sessions test_matrix_% test_chaos test_servos test_snapshot,$(TESTS)) # they stand on tests/rig*.c
THREADED := test_worker test_archive test_server test_replay test_modbus_bus test_sim_servo test_sim_drive test_client test_recorder
FUZZ := $(patsubst tests/%.c,%,$(wildcard tests/fuzz_*.c))
LIBRARIES := $(B)/libtools.a $(B)/libdaemon.a $(B)/libdrivers.a $(B)/libconfig.a $(B)/libcore.a

.SECONDARY:
.PHONY: all tests check check-systemd check-vm check-vm-systemd demo bench soak fuzz lint format deps install clean help run-check run-demo needed
all: needed $(B)/facetd $(B)/facet $(B)/libfacet.so.$(LIBFACET_ABI) $(B)/libfacet.a
tests: needed $(addprefix $(B)/tests/,$(TESTS) $(PROGRAMS)) $(addprefix $(B)/bench/,$(BENCHES))

help:
	@echo 'make [config=release|debug|sanitize|thread]   build/facetd and build/facet'
	@echo 'make check   install what tests need, build, run them      make demo   a simulated robot, a mesh, a picture'
	@echo 'make check-systemd | check-vm | check-vm-systemd   the daemon under a real systemd, a real kernel, both'
	@echo 'make bench   figures of docs/features.md                   make fuzz   every fuzz target, FUZZ_SECONDS=300 each'
	@echo 'make soak    ten minutes of faults                         make lint   layers, warnings, format, static checks'
	@echo 'make format | deps | install DESTDIR= PREFIX= | clean'

# A missing package is named before the compiler trips over it.
needed:
	@missing=$$(tools/deps --missing build) || { echo "make: missing packages: $$(echo $$missing); run 'make deps'" >&2; exit 1; }
	@for what in $(LEFT_OUT); do echo "  without $$what: 'make deps' installs it"; done

$(B)/obj/%.o: %.c Makefile | needed
	@mkdir -p $(@D)
	@echo '  CC   $<'
	$(Q)$(CC) $(CFLAGS_ALL) -DFACET_VERSION='"$(VERSION)"' -c -o $@ $<

$(B)/libcore.a: $(call objects,$(CORE))
$(B)/libconfig.a: $(call objects,$(CONFIG))
$(B)/libdrivers.a: $(call objects,$(DRIVERS))
$(B)/libdaemon.a: $(call objects,$(DAEMON))
$(B)/libtools.a: $(call objects,$(TOOLS))
$(B)/lib%.a:
	@mkdir -p $(@D)
	@rm -f $@
	$(Q)ar rcs $@ $^

# libfacet: what a client needs of the core, without a name of ours but facet_*.
LIBFACET := $(wildcard tools/libfacet*.c) config/address.c $(addprefix core/,native.c coded.c coded_table.c patch.c model.c sha256.c)
$(B)/pic/%.o: %.c Makefile | needed
	@mkdir -p $(@D)
	@echo '  CC   $< (libfacet)'
	$(Q)$(CC) $(CFLAGS_ALL) -fPIC -fvisibility=hidden -c -o $@ $<
$(B)/libfacet.so.$(LIBFACET_ABI): $(patsubst %.c,$(B)/pic/%.o,$(LIBFACET))
	@echo '  LD   $@'
	$(Q)$(CC) $(LDFLAGS_ALL) -shared -Wl,-soname,$(@F) $(if $(filter release debug,$(config)),-Wl$(comma)--no-undefined) -o $@ $^ -lzstd -lm
$(B)/libfacet.a: $(patsubst %.c,$(B)/pic/%.o,$(LIBFACET))
	@rm -f $@
	$(Q)ld -r -o $(B)/pic/libfacet.o $^
	$(Q)objcopy --localize-hidden $(B)/pic/libfacet.o
	$(Q)ar rcs $@ $(B)/pic/libfacet.o

$(B)/facetd: $(B)/obj/daemon/facetd.o $(filter-out $(B)/libtools.a,$(LIBRARIES))
	@echo '  LD   $@'
	$(Q)$(CC) $(LDFLAGS_ALL) -o $@ $^ $(LIBS)
$(B)/facet: $(B)/obj/tools/facet.o $(LIBRARIES)
	@echo '  LD   $@'
	$(Q)$(CC) $(LDFLAGS_ALL) -o $@ $^ $(LIBS)
$(addprefix $(B)/tests/,$(RIGGED)): $(patsubst %.c,$(B)/obj/%.o,$(wildcard tests/rig*.c)) $(B)/obj/tests/matrix.o
$(B)/tests/test_%: $(B)/obj/tests/test_%.o $(LIBRARIES)
	@mkdir -p $(@D)
	@echo '  LD   $@'
	$(Q)$(CC) $(LDFLAGS_ALL) -o $@ $(filter %.o,$^) $(filter %.a,$^) $(LIBS) -lcmocka
# A simulated usbfs (tests/usbfs.h) under real libusb.
ifeq ($(call have,umockdev-1.0),yes)
$(B)/obj/tests/test_cola_usb.o $(B)/obj/tests/usb_bed.o: CFLAGS_ALL += -DHAVE_UMOCKDEV $(shell pkg-config --cflags umockdev-1.0)
$(B)/tests/test_cola_usb $(B)/tests/usb_bed: LIBS += $(shell pkg-config --libs umockdev-1.0)
endif
# The viewer's page, one for all configurations, embedded by daemon/page.c. Without node or its packages it is left out.
PAGE := build/viewer
PAGE_SOURCES := $(wildcard viewer/*)
$(PAGE)/pages.h: $(PAGE_SOURCES) $(if $(wildcard $(PAGE)/left_out),again)
	@viewer/build $(PAGE)
	@[ ! -e $(PAGE)/left_out ] || echo "  without the viewer's page: $$(cat $(PAGE)/left_out)"
.PHONY: again
$(B)/obj/daemon/page.o: $(PAGE)/pages.h
$(B)/obj/daemon/page.o: CFLAGS_ALL += -I$(PAGE)
$(addprefix $(B)/tests/,$(PROGRAMS)): $(B)/tests/%: $(B)/obj/tests/%.o $(LIBRARIES)
	@mkdir -p $(@D)
	@echo '  LD   $@'
	$(Q)$(CC) $(LDFLAGS_ALL) -o $@ $^ $(LIBS)
$(B)/bench/%: $(B)/obj/bench/%.o $(LIBRARIES)
	@mkdir -p $(@D)
	@echo '  LD   $@'
	$(Q)$(CC) $(LDFLAGS_ALL) -o $@ $^ $(LIBS)
$(B)/tests/fuzz_%: $(B)/obj/tests/fuzz_%.o $(LIBRARIES)
	@mkdir -p $(@D)
	@echo '  LD   $@'
	$(Q)$(CC) $(LDFLAGS_ALL) -fsanitize=fuzzer -o $@ $^ $(LIBS)

# Purposes are installed first and the build starts in a second make, whose pkg-config then knows them.
check:
	@tools/deps build optional check check-$$(uname -m)
	@tools/deps browser || echo "check: without a browser the viewer's tests are skipped" >&2
	@$(MAKE) --no-print-directory config=$(config) run-check
run-check: all tests
	@tests/run $(B)
ifeq ($(config),sanitize)
	@$(MAKE) --no-print-directory config=thread all $(addprefix build/thread/tests/,$(THREADED))
	@echo 'under ThreadSanitizer:'
	@tests/run build/thread $(addprefix build/thread/tests/,$(THREADED))
endif

# Real kernels and a real systemd; what cannot be had here is a skipped row (tests/tier).
check-systemd check-vm check-vm-systemd:
	@tools/deps build
	@$(MAKE) --no-print-directory config=$(config) all $(addprefix $(B)/tests/,$(PROGRAMS))
	@tests/tier $(@:check-%=%) $(B)

demo:
	@tools/deps build
	@$(MAKE) --no-print-directory run-demo
run-demo: all
	@tools/demo

bench:
	@tools/deps build check bench
	@$(MAKE) --no-print-directory all $(addprefix $(B)/bench/,$(BENCHES))
	@bench/run

soak: all tests
	@echo 'an hour of chaos in virtual time:'
	@$(B)/tests/test_chaos 3600
	@tests/soak $(B)
	@echo '200 kills while recording:'
	@tests/soak $(B) kills 200

FUZZ_SECONDS ?= 300
fuzz:
	@tools/deps build optional check check-$$(uname -m)
	@$(MAKE) --no-print-directory config=fuzz run-fuzz
.PHONY: run-fuzz fuzz-targets
fuzz-targets: needed $(addprefix $(B)/tests/,$(FUZZ))
run-fuzz: fuzz-targets
	@tests/fuzz $(B) $(FUZZ_SECONDS)

lint:
	@tools/deps build check lint
	@tools/lint
format:
	@clang-format -i $(shell git ls-files '*.c' '*.h')

deps:
	@tools/deps build optional check check-$$(uname -m) lint bench

install: all
	install -d $(DESTDIR)$(PREFIX)/bin $(DESTDIR)$(PREFIX)/lib/systemd/system $(DESTDIR)$(PREFIX)/lib/sysusers.d \
		$(DESTDIR)$(PREFIX)/lib/udev/rules.d $(DESTDIR)$(PREFIX)/share/doc/facetd
	install -m 755 $(B)/facetd $(B)/facet $(DESTDIR)$(PREFIX)/bin
	install -d $(DESTDIR)$(PREFIX)/include $(DESTDIR)$(PREFIX)/lib/pkgconfig
	install -m 644 tools/facet.h $(DESTDIR)$(PREFIX)/include/facet.h
	install -m 644 $(B)/libfacet.a $(DESTDIR)$(PREFIX)/lib/libfacet.a
	install -m 755 $(B)/libfacet.so.$(LIBFACET_ABI) $(DESTDIR)$(PREFIX)/lib/libfacet.so.$(LIBFACET_ABI)
	ln -sf libfacet.so.$(LIBFACET_ABI) $(DESTDIR)$(PREFIX)/lib/libfacet.so
	sed 's|@PREFIX@|$(PREFIX)|g; s|@VERSION@|$(VERSION)|g' tools/libfacet.pc.in > $(DESTDIR)$(PREFIX)/lib/pkgconfig/libfacet.pc
	sed 's|@PREFIX@|$(PREFIX)|g' systemd/facetd.service.in > $(DESTDIR)$(PREFIX)/lib/systemd/system/facetd.service
	sed 's|@PREFIX@|$(PREFIX)|g' systemd/facetd.socket.in > $(DESTDIR)$(PREFIX)/lib/systemd/system/facetd.socket
	install -m 644 systemd/70-facetd.rules $(DESTDIR)$(PREFIX)/lib/udev/rules.d/70-facetd.rules
	install -m 644 systemd/dynamic-user.conf $(DESTDIR)$(PREFIX)/share/doc/facetd/dynamic-user.conf
	install -m 644 systemd/facetd.sysusers $(DESTDIR)$(PREFIX)/lib/sysusers.d/facetd.conf
	install -m 644 config/facetd.yaml $(DESTDIR)$(PREFIX)/share/doc/facetd/facetd.yaml

clean:
	rm -rf build demo

-include $(shell find $(B)/obj $(B)/pic -name '*.d' 2>/dev/null)
