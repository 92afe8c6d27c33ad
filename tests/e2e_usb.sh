#!/bin/sh
# Law: a scanner on USB streams from the daemon's start, comes back by itself when it was pulled out, and no byte of what
# it sent while it was there is lost. The daemon, real libusb, a simulated usbfs and a simulated TiM561 (tests/usb_bed.c).
. "$(dirname "$0")/lib.sh"
bed=$build/tests/usb_bed

wait_for() { # SECONDS FILE SENTENCE [TIMES]
    left=$(($1 * 10 * patience))
    while [ "$(cat "$2" 2>/dev/null | grep -cF -- "$3")" -lt "${4:-1}" ]; do
        [ $left -gt 0 ] || { fail "not within $1 s: $3"; sed 's/^/    /' "$2"; return 1; }
        left=$((left - 1))
        sleep 0.1
    done
}
configure() { # FILE CONNECT
    cat >"$scratch/$1.yaml" <<END
devices:
  - {name: laser, driver: tim, connect: "$2"}
listen: {native: ["unix:$scratch/$1.sock"]}
END
}

"$bed" -- true >"$scratch/bed" 2>&1
if [ $? -eq 77 ]; then
    tail -n 1 "$scratch/bed"
    exit 77
fi

if ! ldd "$facetd" | grep -q libusb; then
    echo "built without libusb: install libusb-1.0-0-dev (make deps)"
    exit 77
fi

# Halted once, pulled out, plugged in again under another address.
configure one usb:16160456
"$bed" --scanner 1-1=16160456 --halt 2 --unplug 4,2 -- sh -c 'echo $$ >"$1/daemon"; exec "$0" --config "$1/one.yaml"' \
    "$facetd" "$scratch" >"$scratch/one" 2>&1 &
bed_pid=$!
wait_for 20 "$scratch/one" "laser: streaming"
wait_for 20 "$scratch/one" "laser: lost: the scanner at usb:1-1 is gone: unplugged, without power, or restarted"
wait_for 20 "$scratch/one" "laser: not ready: usb:16160456: no scanner is plugged in on USB"
wait_for 20 "$scratch/one" "bed: plugged in"
wait_for 20 "$scratch/one" "laser: streaming" 2
sleep 1
"$facet" watch --once --json "unix:$scratch/one.sock" >"$scratch/status" || fail "facet watch"
python3 - "$scratch/status" "$scratch/one" <<'END' || { fail "what came over USB is not what was sent"; cat "$scratch/one"; }
import json, re, sys
status = json.load(open(sys.argv[1]))
laser = status["devices"][0]
counters = laser["counters"]
assert laser["state"] == "streaming" and laser["opens"] >= 2 and laser["losses"] >= 1, laser
for reason in ("check sum", "bad start", "too long", "garbage bytes", "malformed", "implausible"):
    assert counters[reason] == 0, (reason, counters)
assert counters["cut"] <= 1, counters  # one may have been on its way when the plug was pulled
assert counters["profiles"] > 5, counters
waits = [float(s) for s in re.findall(r"first request of 1-1 after ([0-9.]+)", open(sys.argv[2]).read())]
log = open(sys.argv[2]).read()
lost = log.count("laser: lost") - log.count("laser: lost: no scan")  # a machine that stands still loses it as well
assert lost == 1, log  # by the pulled plug, not by the halt
assert len(waits) == 2 and waits[1] < 60, waits  # 2 s on a machine that has the time
print(f"note: {counters['profiles']} profiles; first request {waits[1]:.2f} s after the scanner was back")
END
kill -TERM "$(cat "$scratch/daemon")"
wait $bed_pid || fail "the daemon ended with status $?"

# Twins: `usb` alone says which two there are, a serial number finds its own.
configure both usb
timeout 400 "$bed" --scanner 1-1=16160456 --scanner 1-2=18220118 -- "$facetd" --config "$scratch/both.yaml" \
    >"$scratch/both" 2>&1 &
configure second usb:18220118
timeout 400 "$bed" --scanner 1-1=16160456 --scanner 1-2=18220118 -- "$facetd" --config "$scratch/second.yaml" \
    >"$scratch/second" 2>&1 &
wait_for 20 "$scratch/both" "2 scanners are plugged in; write one of these as \`connect\`: usb:16160456, usb:18220118"
wait_for 20 "$scratch/second" "bed: first request of 1-2"
wait_for 20 "$scratch/second" "laser: streaming"
grep -q "first request of 1-1" "$scratch/second" && fail "the wrong scanner was asked"
exit $failed
