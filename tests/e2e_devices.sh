#!/bin/sh
# Law: `facet devices` lists what is plugged in, each with a line that is a right configuration as it stands, and says why
# one of them cannot be opened. On simulated machines (tests/usb_bed.c).
. "$(dirname "$0")/lib.sh"
bed=$build/tests/usb_bed

has() { # FILE SENTENCE
    grep -qF -- "$2" "$1" || { fail "not said: $2"; sed 's/^/    /' "$1"; }
}

"$bed" -- true >"$scratch/bed" 2>&1
status=$?
if [ $status -eq 77 ]; then
    tail -n 1 "$scratch/bed"
    exit 77
fi

# Nothing there: a sentence that helps, and no failure.
"$bed" -- "$facet" devices >"$scratch/none" 2>&1 || fail "nothing plugged in is no failure"
has "$scratch/none" "nothing found: no scanner on USB (19a2:5001), no serial line, no CAN interface."

# Two scanners, one without a serial number, two adapters, one of which udev gave no name.
"$bed" --scanner 1-1=16160456 --scanner 1-2.3 --adapter ttyUSB0=A5XK3RJT --adapter ttyUSB1= -- \
    "$facet" devices >"$scratch/many" 2>&1 || fail "status $? with devices"
has "$scratch/many" 'SICK TiM561, serial number 16160456, port 1-1, /dev/bus/usb/001/010'
has "$scratch/many" '- {name: laser, driver: tim, connect: "usb:16160456"}'
has "$scratch/many" '- {name: laser2, driver: tim, connect: "usb:1-2.3"}'
has "$scratch/many" "/dev/ttyUSB0, FTDI FT232R USB UART, 0403:6001, serial number A5XK3RJT, port 1-20, driver ftdi_sio"
has "$scratch/many" "port: '/dev/serial/by-id/usb-FTDI_FT232R_USB_UART_A5XK3RJT-if00-port0', baud: 500000}"
has "$scratch/many" "! the adapter holds bytes back for 16 ms"
has "$scratch/many" "port: '/dev/ttyUSB1', baud: 500000}"
has "$scratch/many" "! it has no name of its own: after the next plugging its twin may be /dev/ttyUSB1"
"$bed" --adapter ttyUSB7= -- "$facet" devices >"$scratch/alone" 2>&1
has "$scratch/alone" "port: 'usb:0403:6001', baud: 500000}"

# The lines, pasted as they stand.
{ echo "devices:"; grep -h '^ *- {' "$scratch/many"; } >"$scratch/pasted.yaml"
[ "$(wc -l <"$scratch/pasted.yaml")" -eq 5 ] || fail "not four lines to paste"
{ echo "devices:"; grep '^ *- {' "$scratch/alone"; } >"$scratch/alone.yaml"
"$facetd" --check-config --config "$scratch/alone.yaml" || fail "what is pasted is no right configuration"
"$facetd" --check-config --config "$scratch/pasted.yaml" || fail "what is pasted is no right configuration"
grep -- '- {name: laser, driver: lms1xx' "$scratch/many" | sed 's/.*looked for: /devices: [/; s/- {/{/; s/}$/}]/' >"$scratch/ethernet.yaml"
"$facetd" --check-config --config "$scratch/ethernet.yaml" || fail "the line for Ethernet is no right configuration"

"$bed" --scanner 1-1=16160456 --adapter ttyUSB0=A5XK3RJT -- "$facet" devices --json >"$scratch/json" || fail "--json"
python3 -c '
import json, sys
usb, serial = json.load(open(sys.argv[1]))["devices"]
assert usb["kind"] == "usb" and usb["serial"] == "16160456" and usb["port"] == "1-1" and usb["usable"] and not usb["notes"], usb
assert serial["kind"] == "serial" and serial["id"] == "0403:6001" and serial["driver"] == "ftdi_sio", serial
# The adapter is a pseudo-terminal here, and others on this machine may hold one that looks alike.
assert serial["usable"] or "in use by" in serial["notes"][0], serial
assert "usb:16160456" in usb["yaml"], usb' "$scratch/json" || fail "the JSON says something else"

# CAN interfaces: as they are, and what would bring them up; the loopback interface is none.
"$bed" --can can0=0x400c1,up,16 --can vcan0=0xc1,unknown,72 -- "$facet" devices >"$scratch/can" 2>&1 || fail "status $? with CAN"
has "$scratch/can" "CAN interfaces (what is on the bus they do not say"
has "$scratch/can" "  can0, driver kvaser_pci, up"
has "$scratch/can" "- {name: servo, driver: canopen, connect: can0, node: 1}"
has "$scratch/can" "  vcan0, virtual, up, FD"
{ echo "devices:"; grep '^ *- {' "$scratch/can"; } >"$scratch/can.yaml"
"$facetd" --check-config --config "$scratch/can.yaml" || fail "what is pasted is no right configuration"
"$bed" --can can1=0x40080,down,16 -- "$facet" devices >"$scratch/down" 2>&1
has "$scratch/down" "  can1, driver kvaser_pci, down"
has "$scratch/down" '! `ip link set can1 up type can bitrate 500000 restart-ms 100` brings it up'
"$bed" --can can1=0x40081,down,16 -- "$facet" devices >"$scratch/off" 2>&1
has "$scratch/off" "  can1, driver kvaser_pci, up, its controller is off"
has "$scratch/off" '`ip link set can1 type can restart` starts it again'

# A port that somebody has open.
"$bed" --adapter ttyUSB0=A5XK3RJT -- sh -c 'exec 5<>/dev/ttyUSB0; exec "$0" devices' "$facet" >"$scratch/held" 2>&1
has "$scratch/held" "! in use by facet (process"

# As a user without the group. The copy is for a user who may not read this folder.
if [ "$(id -u)" -eq 0 ] && command -v setpriv >/dev/null 2>&1; then
    chmod 755 "$scratch" && cp "$facet" "$scratch/facet"
    "$bed" --locked --scanner 1-1=16160456 -- setpriv --reuid 65534 --regid 65534 --clear-groups \
        "$scratch/facet" devices >"$scratch/locked" 2>&1 || fail "a missing permission is no failure of the list"
    has "$scratch/locked" "! /dev/bus/usb/001/010: no permission, and no group has it; install the udev rule 70-facetd.rules"
else
    echo "note: not root; a missing permission is not tried"
fi
exit $failed
