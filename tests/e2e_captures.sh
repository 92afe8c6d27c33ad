#!/bin/sh
# Law: what real scanners sent arrives through the whole daemon as it does in the decoder: over TCP, after the daemon's own
# dialogue, every scan of a capture is a profile, and nothing else is.
. "$(dirname "$0")/lib.sh"
captures=../shared/data/captures
[ -e "$captures/cola_b/lms111_20210302.txt" ] || { echo "the captures are not here: $captures"; exit 77; }
command -v python3 >/dev/null 2>&1 || { echo "python3 is not here: install it (make deps)"; exit 77; }

counts() { # NAME VALUE...: the scanner's counters have them; else says which do not
    timeout 120 "$facet" watch --once --json "unix:$scratch/facetd.sock" 2>/dev/null | python3 -c '
import json, sys
devices = {device["name"]: device for device in json.loads(sys.stdin.readline())["devices"]}
counters, wanted = devices["laser"]["counters"], sys.argv[1:]
wrong = [f"{counters[name]} {name}, not {value}" for name, value in zip(wanted[::2], wanted[1::2]) if counters[name] != int(value)]
print(*wrong, sep=", ")
sys.exit(bool(wrong))' "$@" 2>/dev/null
}

has() {
    counts "$@" >/dev/null
}

# A captured telegram of an LMS200 in the place of a simulated one's first measurements.
play_lms200() {
    rm -f "$scratch"/*.log
    "$facet" simulate hall --dir "$scratch/sim" >"$scratch/simulator.log" 2>&1 &
    wrong="the simulator does not come up"
    until_true 60 [ -e "$scratch/sim/laser" ] || return 1
    python3 tests/lms2xx_peer.py "$scratch/sim/laser" "$scratch/line" "$captures/lms2xx/lms200_b0_361_mm_real.bin" 20 >"$scratch/peer.log" 2>&1 &
    wrong="the peer does not come up"
    until_true 60 [ -e "$scratch/line" ] || return 1
    cat >"$scratch/facetd.yaml" <<YAML
devices:
  - {name: laser, driver: lms2xx, port: "$scratch/line", baud: 38400, variant: 180/0.5, tilt: 0deg}
  - {name: robot, driver: pose, fixed: {xyz: [0, 0, 0], rpy: [0, 0, 0]}}
listen: {native: ["unix:$scratch/facetd.sock"]}
YAML
    "$facetd" --config "$scratch/facetd.yaml" 2>"$scratch/daemon.log" &
    daemon=$!
    wrong="the daemon does not ask for measurements"
    until_true 60 grep -q played "$scratch/peer.log" || return 1
    set -- profiles 20 malformed 0 'raster unknown' 0 'mode unknown' 0 'mode without ranges' 0
    until_true 60 has "$@"
    wrong=$(counts "$@") || return 1
    end_all
    summary="$summary lms200 20"
}

summary='' more=''
wrong=''
play_once() { # as play; 1: see $wrong
    capture=$1 driver=$2 profiles=$3
    shift 3
    rm -f "$scratch/port" "$scratch"/*.log "$scratch/facetd.sock"
    python3 tests/cola_peer.py "$captures/$capture" "$scratch/port" >"$scratch/peer.log" 2>&1 &
    wrong="the peer does not come up"
    until_true 60 [ -e "$scratch/port" ] || return 1
    cat >"$scratch/facetd.yaml" <<YAML
devices:
  - {name: laser, driver: $driver, connect: "127.0.0.1:$(cat "$scratch/port")", tilt: 0deg$more}
  - {name: robot, driver: pose, fixed: {xyz: [0, 0, 0], rpy: [0, 0, 0]}}
listen: {native: ["unix:$scratch/facetd.sock"]}
YAML
    "$facetd" --config "$scratch/facetd.yaml" 2>"$scratch/daemon.log" &
    daemon=$!
    wrong="the daemon does not take it to its end"
    until_true 60 grep -q played "$scratch/peer.log" || return 1
    set -- profiles "$profiles" 'check sum' 0 malformed 0 implausible 0 'scans lost' 0 'too long' 0 'bad start' 0 "$@"
    until_true 60 has "$@"
    sleep 0.5 # nothing comes twice
    wrong=$(counts "$@") || return 1
    wrong="the daemon did not say that it streams"
    grep -q 'laser: streaming' "$scratch/daemon.log" || return 1
    wrong="the daemon did not end well"
    kill -TERM $daemon
    wait $daemon || return 1
    daemon=''
}

play() { # CAPTURE DRIVER PROFILES [NAME VALUE]...; $more: keys of the device
    for try in 1 2 3; do
        if play_once "$@"; then
            end_all
            summary="$summary $(basename "$1") $3"
            return
        fi
        end_all
        # On a busy machine the peer may stand still for so long that the daemon gives it up; then it is played again.
        grep -q 'client went' "$scratch/peer.log" || break
    done
    echo "FAILED: $1: $wrong (try $try)"
    sed 's/^/    /' "$scratch/daemon.log" "$scratch/peer.log"
    failed=1
}

more=''
play cola_a/tim561_stream.bin tim 24 'duplicates' 0
play cola_a/tim571_name_sRA.bin tim 1
play cola_b/lms111_20210302.txt lms1xx 172 'duplicates' 3
play cola_b/lms511_20210301.txt lms5xx 136 'duplicates' 0
play cola_b/sick_scan_xd_test.pcapng tim 16
more=', encoder: {scale: 0.01deg}'
play cola_a/lms5xx_encoder_rssi8_name_time_sRA.bin lms5xx 1 tilts 1
if ! play_lms200; then
    echo "FAILED: the LMS200's telegram: $wrong"
    sed 's/^/    /' "$scratch"/*.log
    failed=1
fi
[ $failed -eq 0 ] && echo "note: profiles decoded by the daemon, all there are:$summary"
exit $failed
