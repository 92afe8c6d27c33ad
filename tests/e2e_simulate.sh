#!/bin/sh
# Laws L8, L9: `facet simulate` as its users meet it: devices for anybody, one sentence for what is wrong, and when it
# ends nothing of what it started is left, whoever ended it.
. "$(dirname "$0")/lib.sh"
set -u

# refused STATUS WORDS ARGUMENTS...: ends with STATUS and says WORDS on stderr, whose first line names the program
refused() {
    status=$1 words=$2
    shift 2
    timeout 200 "$facet" simulate "$@" >"$scratch/stdout" 2>"$scratch/stderr"
    [ $? -eq "$status" ] || fail "simulate $*: status is not $status"
    grep -q -- "$words" "$scratch/stderr" || fail "simulate $*: does not say '$words' but: $(head -n 2 "$scratch/stderr")"
    head -n 1 "$scratch/stderr" | grep -q '^facet' || fail "simulate $*: the sentence does not name the program"
}

gone() { # no process has this text in its command line
    for _ in $(seq 150); do
        pgrep -f "$1" >/dev/null || return 0
        sleep 0.2
    done
    return 1
}

# Usage
timeout 200 "$facet" simulate --help | grep -q 'profiles:FILE.csv' || fail "--help does not say how sweeps are played"
refused 2 'which scenario'
refused 2 'one word too many' hall kitchen
refused 2 'no colon behind the device' hall --fault noise
refused 2 'wants a time' hall --fault 'laser: garbage for'
refused 1 "'smoke': laser has no such fault; it has .*crc.*unplug" hall --fault 'laser: smoke'
refused 1 "'radar': no such device; there is laser, servo, pose" hall --fault 'radar: garbage'
refused 2 'none of lms2xx, tim, lms1xx, lms5xx' hall --laser radar
refused 2 'only lms1xx and lms5xx' hall --laser tim --encoder
refused 2 '--laser is for worlds' uos:/nowhere --laser tim
refused 2 '--endless is for worlds' uos:/nowhere --endless
refused 2 '--sent: only the LMS2xx' hall --laser tim --sent /nowhere/sent
refused 1 '--sent /nowhere/sent: No such file' hall --sent /nowhere/sent
refused 2 'only the TiM has a USB port' hall --laser lms1xx --usb
refused 2 '--http: .*not on loopback' hall --http 0.0.0.0:80
refused 2 'world moves continuously' hall --speed 2
refused 2 'world moves continuously' building --speed max
refused 2 'neither max nor a number' hall --speed fast
refused 2 'none of modbus, modbus-tcp, can, canopen' hall --servo cam
refused 2 'paced by the answers of a servo behind Modbus' uos:/nowhere --servo can
refused 2 '--odometry and --truth are for worlds' uos:/nowhere --odometry
refused 2 'neither wheels nor speed' hall --odometry=legs
refused 2 'nothing here is on a CAN bus' hall --can can1
refused 2 'no CAN interface' hall --servo can --can can1:
refused 2 'nothing to count' hall --laser lms1xx --encoder --servo fixed
refused 1 "'smoke': can has no such fault; it has bus-off, .*down, deleted" hall --servo can --fault 'can: smoke'
refused 1 "no such device; there is laser, servo, can, odometry, pose" hall --servo can --odometry --fault 'radar: garbage'
refused 1 '--truth /nowhere/truth: No such file' hall --truth /nowhere/truth
refused 2 'whole number' hall --seed -3
refused 2 'oopback' hall --tcp 0.0.0.0:7878
refused 2 'which COMMAND' hall --
refused 1 'there are building and hall' castle
refused 1 'No such file' uos:/nowhere
refused 1 'No such file' profiles:/nowhere.csv
refused 1 'too long' hall --dir "$scratch/$(printf '%0110d' 0)"
refused 1 'give a --dir' hall --dir /proc/nowhere
echo '0,1000,1001' >"$scratch/lonely.csv"
refused 1 'pose beside it' "profiles:$scratch/lonely.csv"
printf '0,1000,1001\n1,1000,x\n' >"$scratch/bad.csv"
refused 1 'bad.csv: line 2' "profiles:$scratch/bad.csv"

# COMMAND: its environment, its status, its devices, a fresh directory that goes with it
timeout 200 "$facet" simulate hall -- sh -c 'echo "$FACETD|$FACETD_CONFIG"; ls -l "$(dirname "$FACETD_CONFIG")"; exit 7' >"$scratch/env"
[ $? -eq 7 ] || fail "COMMAND's status is not handed on"
config=$(sed -n 's/^unix:.*|//p' "$scratch/env")
grep -q "^address unix:${config%/*}/facetd.sock" "$scratch/env" || fail "the address is not said"
grep -q 'laser -> /dev/pts' "$scratch/env" && grep -q 'servo -> /dev/pts' "$scratch/env" || fail "the devices are not in the directory"
[ -n "$config" ] && [ ! -e "${config%/*}" ] || fail "a fresh directory was left"
timeout 200 "$facet" simulate hall -- /nowhere/program 2>"$scratch/stderr"
[ $? -eq 127 ] || fail "a COMMAND that is not there: status is not 127"
grep -q '/nowhere/program: No such file' "$scratch/stderr" || fail "a COMMAND that is not there is not named"

# A directory that was given stays, its links go; the configuration is one that the daemon takes
timeout 200 "$facet" simulate building --dir "$scratch/given" --servo tcp --tcp 127.0.0.1:7999 -- \
    sh -c "$build/facetd --check-config"' --config "$FACETD_CONFIG"' >"$scratch/check" 2>&1 || fail "facetd refuses the configuration: $(cat "$scratch/check")"
[ -e "$scratch/given/facetd.yaml" ] && [ ! -e "$scratch/given/laser" ] && [ ! -e "$scratch/given/servo" ] || fail "given directory: $(ls "$scratch/given")"
grep -q 'tcp:127.0.0.1:7999' "$scratch/given/facetd.yaml" || fail "--tcp is not in the configuration"

# Nothing outlives it: what COMMAND left behind, what ignores SIGTERM, and when it is itself ended
timeout 200 "$facet" simulate hall -- sh -c 'sleep 7771 & sleep 0.3'
gone 'sleep 7771' || fail "an orphan of COMMAND outlived it"
timeout 400 "$facet" simulate hall --dir "$scratch/stopped" -- sh -c 'trap "" TERM; while :; do sleep 0.1; done # deaf-7772' &
simulate=$!
for _ in $(seq 600); do [ -e "$scratch/stopped/facetd.yaml" ] && pgrep -f deaf-7772 >/dev/null && break; sleep 0.1; done
kill -TERM "$(pgrep -f "simulate hall --dir $scratch/stopped" | tail -n 1)"
wait $simulate
[ $? -eq 143 ] || fail "ended by SIGTERM: status is not 143"
gone deaf-7772 || fail "a COMMAND that ignores SIGTERM outlived it"
[ ! -e "$scratch/stopped/servo" ] || fail "a link was left after SIGTERM"

# The real thing, short: the hall through facetd into a mesh, with every scanner
cat >"$scratch/map.sh" <<'MAP'
"$facetd" 2>"$scratch/$laser.log" & daemon=$!
for i in $(seq 400); do
    sleep 1
    "$facet" save -o "$scratch/$laser.ply" >"$scratch/$laser.save" 2>&1 || continue
    [ "$(sed -n 's/.*step \([0-9]*\),.*/\1/p' "$scratch/$laser.save")" -gt "$steps" ] &&
        [ "$(sed -n 's/.*, \([0-9]*\) faces.*/\1/p' "$scratch/$laser.save")" -gt "$faces" ] && break
done
kill -TERM $daemon
wait $daemon
MAP
export build facet out laser steps faces

# map LASER STEPS FACES [OPTIONS...]: after so many steps and seconds enough the hall has more than so many faces
map() {
    laser=$1 steps=$2 faces=$3
    shift 3
    timeout 600 "$facet" simulate hall --endless "$@" -- sh "$scratch/map.sh" >"$scratch/$laser.said" || fail "$laser: facetd did not end well: $(tail -n 3 "$scratch/$laser.log")"
    made=$(sed -n 's/.*, \([0-9]*\) faces.*/\1/p' "$scratch/$laser.save")
    [ "${made:-0}" -gt "$faces" ] || fail "$laser: the hall has no mesh: $(cat "$scratch/$laser.save" "$scratch/$laser.log")"
    grep -q '^laser: profiles [1-9]' "$scratch/$laser.said" || fail "$laser: what the scanner did is not said"
    echo "note: the hall, $laser, after a few seconds: $(sed 's/^[^:]*: //' "$scratch/$laser.save")"
}
map lms2xx 150 2000 --servo canopen-cyclic --odometry
map tim 60 2000 --laser tim
map lms1xx 150 2000 --laser lms1xx --servo can --odometry=speed
map lms5xx 80 2000 --laser lms5xx --servo modbus-tcp --encoder

# Every other servo, all at once: its angle places rows, and nothing of it is lost or refused. A machine that stands still for longer
# than a silent servo is borne loses it by the rules; then the same is tried again.
try_servo() {
    for try in 1 2 3 4 5; do
        map "$1" 40 300 --servo "$1" --truth "$scratch/$1.truth"
        lost=$(grep 'servo: lost\|servo: not ready' "$scratch/$1.log") || break
        echo "note: $1: try $try: $lost"
    done
    [ -z "$lost" ] || fail "$1: was lost in each of $try tries: $lost"
    grep -q "; servo $1: angle [-0-9.]* deg, speed" "$scratch/$1.said" || fail "$1: what the servo did is not said"
    [ "$(awk 'NF == 6' "$scratch/$1.truth" | wc -l)" -gt 500 ] || fail "$1: the truth is not written"
    exit "$failed"
}
pids=
for servo in canopen canopen-velocity encoder inclinometer fixed; do
    (failed=0; try_servo "$servo") &
    pids="$pids $!"
done
for pid in $pids; do
    wait "$pid" || failed=1
done

# A bus that goes, as the daemon sees it and says it: once each
cat >"$scratch/order.py" <<'ORDER'
import os, socket, sys
s = socket.socket(socket.AF_UNIX)
s.connect(os.path.join(os.path.dirname(os.environ["FACETD"].removeprefix("unix:")), "simulator.sock"))
f = s.makefile("rw")
for line in sys.argv[1:]:
    f.write(line + "\n")
    f.flush()
    print(f.readline().strip())
ORDER
cat >"$scratch/bus.sh" <<'BUS'
"$facetd" 2>"$scratch/bus.log" & daemon=$!
streams() { # so many times
    for i in $(seq 1500); do
        [ "$(grep -ac 'facetd: servo: streaming' "$scratch/bus.log")" -ge $1 ] && break
        sleep 0.1
    done
}
streams 1
python3 "$scratch/order.py" 'can: bus-off for 1s'
streams 2
python3 "$scratch/order.py" 'can: down for 1s'
streams 3
kill -TERM $daemon
wait $daemon
BUS
timeout 600 "$facet" simulate hall --endless --servo can -- sh "$scratch/bus.sh" >"$scratch/bus.said"
[ "$(grep -ac 'facetd: servo: streaming' "$scratch/bus.log")" -ge 3 ] || fail "the servo does not come back with its bus: $(cat "$scratch/bus.log")"
for loss in bus-off 'whoever carried CAN frames there has gone'; do
    [ "$(grep -ac "facetd: servo: lost: .*$loss" "$scratch/bus.log")" -eq 1 ] || fail "the loss of the bus is not said once each: $(cat "$scratch/bus.log")"
done
grep -q 'can: frames [1-9].*dropped [1-9].*errors 2' "$scratch/bus.said" || fail "what the bus did is not said: $(cat "$scratch/bus.said")"

# Faults: ordered by the command line and at the socket, seen by the daemon, and recovered from
cat >"$scratch/faults.sh" <<'FAULTS'
"$facetd" 2>"$scratch/faults.log" & daemon=$!
laser() { # the laser's lines of the log
    grep -a 'facetd: laser: ' "$scratch/faults.log"
}
loses() { # it was away, whether it had streamed by then or not
    for i in $(seq 1500); do
        laser | grep -q 'laser: lost\|laser: not ready' && return 0
        sleep 0.1
    done
    echo "it did not lose the scanner"
}
streams() { # so many times the laser began to stream, and it does
    for i in $(seq 1500); do
        [ "$(laser | grep -c 'laser: streaming')" -ge "$1" ] && laser | tail -n 1 | grep -q 'laser: streaming' && return 0
        sleep 0.1
    done
    echo "it did not stream for the time number $1"
}
loses
streams 1
before=$(laser | grep -c 'laser: streaming')
python3 "$scratch/order.py" 'laser: garbage for 200ms' # the one at 1s may have come before the daemon
for i in $(seq 600); do
    python3 "$scratch/order.py" status | grep -q 'garbage [1-9]' && break
    sleep 0.1
done
python3 "$scratch/order.py" 'laser: smoke' '{"fault": "laser: power for 500ms"}' status '{"status": true}'
streams $((before + 1))
kill -TERM $daemon
wait $daemon
FAULTS
for laser in lms2xx tim; do
    timeout 600 "$facet" simulate hall --endless --laser $laser --fault 'laser: unplug at 2s for 6s' --fault 'laser: garbage at 1s for 200ms' -- sh "$scratch/faults.sh" >"$scratch/faults.said"
    ! grep 'did not' "$scratch/faults.said" || fail "$laser does not come back: $(cat "$scratch/faults.log")"
    grep -q 'laser: lost' "$scratch/faults.log" || fail "$laser: facetd does not say that it lost the scanner"
    grep -q "^error: 'smoke': laser has no such fault; it has" "$scratch/faults.said" || fail "a wrong order is not refused"
    grep -q '^{"ok":true}$' "$scratch/faults.said" || fail "an order in JSON is not taken"
    grep -q '^laser: profiles [1-9]' "$scratch/faults.said" || fail "the status is not said"
    grep -q '^{"ok":true,"status":"laser: profiles' "$scratch/faults.said" || fail "the status is not said in JSON"
    grep -q 'garbage [1-9][0-9]* bytes' "$scratch/faults.said" || fail "$laser: no garbage was sent: $(tail -n 1 "$scratch/faults.said")"
    echo "note: faults, $laser: $(tail -n 1 "$scratch/faults.said")"
done

[ "$failed" -eq 0 ] && echo "all well"
exit $failed
