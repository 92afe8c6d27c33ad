#!/bin/sh
# Claim: somebody else's Modbus says the same as ours. npm's modbus-serial is the servo that facetd sweeps, by RTU and TCP;
# mbpoll is the master of the simulated servo, by RTU and TCP. And a drive that is not well stops the sweep, said once.
. "$(dirname "$0")/lib.sh"
set -u
tried=0 skipped=

says() { # WORDS: how often the daemon's log has them
    grep -c -- "$1" "$scratch/facetd.log"
}

begins() { # the daemon, on $scratch/facetd.yaml
    "$facetd" --config "$scratch/facetd.yaml" >"$scratch/facetd.log" 2>&1 &
    daemon=$!
    until_true 30 grep -q 'servo: streaming' "$scratch/facetd.log" || {
        fail "$1: facetd does not stream: $(cat "$scratch/facetd.log")"
        return 1
    }
}

# ---- npm's modbus-serial ----

install_peer() {
    command -v node >/dev/null && command -v npm >/dev/null || {
        skipped="node and npm are not installed"
        return 1
    }
    peer=$build/modbus_serial
    mkdir -p "$peer"
    cp tests/modbus_serial/package.json tests/modbus_serial/package-lock.json tests/modbus_serial/servo.js "$peer"
    [ -d "$peer/node_modules/modbus-serial" ] && [ ! "$peer/package-lock.json" -nt "$peer/node_modules/.package-lock.json" ] &&
        return 0
    (cd "$peer" && timeout 120 npm ci --no-audit --no-fund >"$scratch/npm.log" 2>&1) || {
        skipped="npm cannot get modbus-serial: $(tail -n 1 "$scratch/npm.log")"
        return 1
    }
}

# sweep_peer KIND CONNECT: facetd commands the servo that stands there until it has turned six times
sweep_peer() {
    cat >"$scratch/facetd.yaml" <<YAML
devices:
  - {name: servo, driver: modbus, connect: "$2", unit: 7, parity: none, period: 20ms,
     position: {function: 3, address: 101, type: f32, order: CDAB, scale: 1deg},
     target: {function: 16, address: 103, type: f32, order: CDAB, scale: 1deg},
     speed: {function: 6, address: 105, type: u16, scale: 0.1deg}, address_base: 1,
     write: [{address: 111, value: 1, until: {address: 112, mask: 1, value: 1}}], stop: [{address: 111, value: 0}],
     limits: [-21deg, 31deg]}
sweep: {device: servo, from: -20deg, to: 30deg, speed: 60deg, rest: 5deg}
listen: {native: ["unix:$scratch/facetd.sock"]}
YAML
    begins "modbus-serial by $1" || return
    until_true 60 peer_has_turned 6 || fail "modbus-serial by $1 does not sweep"
    ends $daemon
    ends $servo
    python3 - "$1" "$scratch/servo.log" <<'PYTHON' || fail "modbus-serial by $1: $(cat "$scratch/servo.log")"
import json, sys
did = json.loads(open(sys.argv[2]).read().splitlines()[-1])
assert did["turns"] >= 6 and did["refused"] == 0
assert -20.001 <= did["low"] <= -19.999 and 29.999 <= did["high"] <= 30.001, "targets"
assert abs(did["angle"] - 5) < 0.2 and did["enabled"] == 0, "the end"
assert -20.1 <= did["bottom"] < -19.5 and 29.5 < did["top"] <= 30.1, "angles"
print(f"note: modbus-serial by {sys.argv[1]}: {did['targets']} targets, {did['turns']} turns, {did['reads']} reads")
PYTHON
    until_true 10 grep -q 'ends' "$scratch/facetd.log" || fail "modbus-serial by $1: no orderly end"
    tried=$((tried + 1))
}

peer_has_turned() { # TIMES: it is asked while it lives
    kill -USR1 $servo
    sleep 0.2
    [ "$(sed -n 's/.*"turns":\([0-9]*\).*/\1/p' "$scratch/servo.log" | tail -n 1)" -ge "$1" ]
}

play_peer() {
    node "$peer/servo.js" tcp "$scratch/port" >"$scratch/servo.log" 2>&1 &
    servo=$!
    until_true 30 test -s "$scratch/port" && sweep_peer TCP "127.0.0.1:$(cat "$scratch/port")" ||
        fail "modbus-serial by TCP: $(cat "$scratch/servo.log")"
    python3 tests/pty_pair.py "$scratch/line" "$scratch/other" &
    until_true 10 test -e "$scratch/other"
    node "$peer/servo.js" rtu "$scratch/other" >"$scratch/servo.log" 2>&1 &
    servo=$!
    sweep_peer RTU "$scratch/line"
}

# ---- mbpoll ----

# mbpoll once, unit 1, addresses from 0
poll() {
    timeout 60 mbpoll -o 10 -q -1 -0 -B -a 1 "$@" 2>&1
}

position() { # TRANSPORT...: in 0.001 degree
    poll -r 0 -c 1 -t 4:int "$@" | sed -n 's/^\[0\]:[[:space:]]*\(-\{0,1\}[0-9]*\).*/\1/p'
}

stands_at() { # COUNTS TRANSPORT...
    at=$1
    shift
    [ "$(position "$@")" = "$at" ]
}

play_master() { # KIND TRANSPORT...: from one end to the other and back, and what it refuses
    kind=$1
    shift
    for target in 20000 -35000 0; do
        # A word a register, high first: -35000 is 0xffff7748.
        high=$(((target >> 16) & 65535)) low=$((target & 65535))
        poll -r 4 -t 4 "$@" -- 3 3392 | grep -q 'Written 2' || fail "mbpoll by $kind: the speed is not taken" # 200 degrees/s
        poll -r 2 -t 4 "$@" -- $high $low | grep -q 'Written 2' || fail "mbpoll by $kind: a target is not taken"
        until_true 20 stands_at $target "$@" || fail "mbpoll by $kind: it does not reach $target but $(position "$@")"
    done
    poll -r 400 -c 1 -t 4 "$@" | grep -qi 'illegal data address' || fail "mbpoll by $kind: register 400 is there"
    [ "$(poll -r 0 -c 2 -t 3:hex "$@" | grep -c '0x0000')" -eq 2 ] || fail "mbpoll by $kind: no input registers"
    tried=$((tried + 1))
    echo "note: mbpoll by $kind: three targets reached"
}

simulates() { # KIND: without a daemon
    mkdir "$scratch/$1"
    "$facet" simulate hall --endless --servo "$1" --dir "$scratch/$1" >"$scratch/simulate.log" 2>&1 &
    simulator=$!
    until_true 30 test -s "$scratch/$1/facetd.yaml" || fail "the simulator does not begin: $(cat "$scratch/simulate.log")"
}

address_of() { # KIND: HOST:PORT of its servo
    sed -n 's/.*driver: modbus, connect: "\([^"]*\)".*/\1/p' "$scratch/$1/facetd.yaml"
}

# ---- a drive that is not well ----

orders() { # SENTENCE: a fault
    printf '%s\n' "$1" | python3 -c '
import socket, sys
s = socket.socket(socket.AF_UNIX)
s.connect(sys.argv[1])
s.sendall(sys.stdin.buffer.read())
s.recv(1000)' "$scratch/modbus-tcp/simulator.sock"
}

stands() { # by TCP, beside facetd
    before=$(position -p "$port" 127.0.0.1)
    sleep 0.5
    [ -n "$before" ] && [ "$before" = "$(position -p "$port" 127.0.0.1)" ]
}

moves() {
    ! stands
}

trouble_stops() { # CASE SENTENCE WORDS: ordered, it stops the sweep, which is said once
    begins "$1" || return
    until_true 30 moves || fail "$1: it does not sweep"
    orders "$2"
    until_true 30 grep -q -- "$3" "$scratch/facetd.log" || fail "$1: nobody says '$3': $(cat "$scratch/facetd.log")"
    until_true 10 stands || fail "$1: it still moves"
    sleep 3
    stands || fail "$1: it moves again"
    [ "$(says "$3")" -eq 1 ] || fail "$1: said $(says "$3") times: $(cat "$scratch/facetd.log")"
    ends $daemon
    tried=$((tried + 1))
}

trouble() {
    port=$(address_of modbus-tcp | sed 's/.*://')
    sed -e '/name: laser/,/tilt: servo/d' -e '/name: pose/d' -e "s|unix:[^\"]*facetd.sock|unix:$scratch/facetd.sock|" \
        "$scratch/modbus-tcp/facetd.yaml" >"$scratch/facetd.yaml"
    sed 's/to: 45deg/to: 50.5deg/' "$scratch/facetd.yaml" >"$scratch/beyond.yaml"
    "$facetd" --check-config --config "$scratch/beyond.yaml" >"$scratch/beyond.log" 2>&1 && fail "a target beyond the limits is taken"
    grep -q "sweep.to: lies outside the limits of 'servo'" "$scratch/beyond.log" || fail "limits: $(cat "$scratch/beyond.log")"
    trouble_stops 'an axis that is stuck' 'servo: stuck for 20s' 'the sweep stopped: servo '
    sleep 20 # by now the axis was stuck for its 20 s and more
    trouble_stops 'a fault that stays' 'servo: fault for 30s' 'that its reset did not clear'
}

if install_peer; then
    play_peer
fi
if command -v mbpoll >/dev/null; then
    simulates modbus
    play_master RTU -m rtu -b 115200 -P none "$(address_of modbus)"
    ends $simulator
    simulates modbus-tcp
    play_master TCP -p "$(address_of modbus-tcp | sed 's/.*://')" 127.0.0.1
    trouble
    ends $simulator
else
    skipped="$skipped${skipped:+; }mbpoll is not installed"
fi
[ $failed -eq 0 ] || exit 1
[ -z "$skipped" ] || {
    echo "note: $tried rows played"
    echo "$skipped"
    exit 77
}
