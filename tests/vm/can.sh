# CAN in the guest, for rows: vcan0, a wire without controllers, and can0 - can1, two controllers on one wire. $scratch is a
# folder of the row. busybox has an `ip` of its own that knows no CAN.
ip=/bin/ip
SERVO='{name: servo, driver: can, connect: vcan0, angle: {id: 0x181, length: 16, scale: 0.01deg}, timeout: 1s}'

vcan_up() {
    modprobe -a can_raw vcan || { echo "this kernel has no vcan"; exit 77; }
    $ip link add vcan0 type vcan 2>/dev/null
    $ip link set vcan0 mtu 72 up || fail "vcan0 cannot be set up"
}
controllers_up() {
    modprobe -a can_raw kvaser_pci || { echo "this kernel has no kvaser_pci"; exit 77; }
    [ -e /sys/class/net/can1 ] || { echo "this guest has no CAN controllers"; exit 77; }
    for interface in can0 can1; do
        controller_up $interface || fail "$interface cannot be set up"
    done
}
controller_up() {
    $ip link set "$1" down
    $ip link set "$1" type can bitrate 500000 restart-ms 100 berr-reporting on && $ip link set "$1" up
}

# log_of_angles FRAMES: $scratch/angles.log, as `candump -L` writes it, an angle every 10 ms between -30 and 30 degrees, 37.5 a
# second; and $scratch/truth, what it says.
log_of_angles() {
    /usr/bin/awk -v n="$1" -v log_file=$scratch/angles.log -v truth=$scratch/truth 'BEGIN {
        at = -3000; step = 37
        for (i = 0; i < n; i++) {
            if (at + step > 3000 || at + step < -3000) step = -step
            at += step
            raw = at < 0 ? at + 65536 : at
            printf "(%d.%06d) vcan0 181#%02X%02X\n", 1600000000 + int(i / 100), i % 100 * 10000, raw % 256, int(raw / 256) > log_file
            printf "%d%09d %.12f\n", 1600000000 + int(i / 100), i % 100 * 10000000, at * 0.01 * 3.14159265358979323846 / 180 > truth
        }
    }'
}
# The log again and again; a player ends when its interface does.
play_for_ever() {
    while :; do
        canplayer -I $scratch/angles.log 2>/dev/null
        sleep 0.1
    done &
    player=$!
}
stop_player() {
    [ -z "$player" ] || { kill "$player" 2>/dev/null; killall canplayer 2>/dev/null; wait "$player"; } 2>/dev/null
    player=
}
player=

# counts FILE KEY: of what tests/angles.c printed.
figure() {
    sed -n "s/^$2 //p" "$1"
}
below() { # figure, limit
    /usr/bin/awk -v a="$1" -v b="$2" 'BEGIN { exit !(a != "" && a + 0 <= b + 0) }'
}
said_times() { # N WORDS: it is in the log so often, at least
    [ "$(grep -c -- "$2" $scratch/log)" -ge "$1" ]
}
uptime_ms() {
    sed 's/\([0-9]*\)\.\([0-9][0-9]\).*/\1\20/' /proc/uptime
}

# ---- rows ----

can_log_played() {
    vcan_up
    log_of_angles 1500
    # Patient: while a device that was silent for its `timeout` is set up again, frames pass it by.
    configure "$(echo "$SERVO" | sed 's/timeout: 1s/timeout: 30s/')"
    start_daemon --journal $scratch/journal
    until_true 10 test -s $scratch/journal
    canplayer -I $scratch/angles.log || fail "canplayer: status $?"
    sleep 1
    stop_daemon
    "$BUILD/tests/angles" --sequence $scratch/journal $scratch/facetd.yaml servo $scratch/truth >$scratch/figures ||
        fail "the kept list cannot be read"
    cat $scratch/figures
    [ "$(figure $scratch/figures angles)" = 1500 ] || fail "$(figure $scratch/figures angles) of 1500 angles"
    [ "$(figure $scratch/figures wrong)" = 0 ] || fail "$(figure $scratch/figures wrong) angles are wrong"
    below 95 "$(figure $scratch/figures rate_hz)" && below "$(figure $scratch/figures rate_hz)" 101 ||
        fail "$(figure $scratch/figures rate_hz) Hz instead of 100"
    says 'servo: streaming' || fail "the servo was not said to stream"
    echo "note: 1500 angles, $(figure $scratch/figures rate_hz) Hz, stamps $(figure $scratch/figures late_p99_ms) ms (p99) from the log's"
}

can_error_frames() {
    vcan_up
    log_of_angles 1000
    configure "$SERVO"
    start_daemon
    play_for_ever
    until_true 20 is servo state streaming || fail "the servo does not stream"
    cansend vcan0 00000181#FFFF
    cansend vcan0 181#R
    cansend vcan0 181#11
    until_true 10 at_least servo foreign 1 || fail "the extended frame of the same number is not counted"
    until_true 10 at_least servo remote 1 || fail "the remote frame is not counted"
    until_true 10 at_least servo short 1 || fail "the short frame is not counted"
    cansend vcan0 20000004#0004000000000000
    until_true 10 says 'warns of many errors' || fail "the warning is not said"
    cansend vcan0 20000004#0020000000000000
    until_true 10 says 'error passive' || fail "error passive is not said"
    stop_player
    cansend vcan0 20000040#0000000000000000
    until_true 10 says 'bus-off' || fail "bus-off is not said"
    until_true 10 is_lost servo || fail "a silent servo is not lost"
    status_of servo error | grep -q bus-off || fail "the status does not say why: $(status_of servo error)"
    cansend vcan0 20000100#0000000000000000
    play_for_ever
    until_true 20 is servo state streaming || fail "it does not come back after the restart"
    until_true 10 is servo note '' || fail "the note stays: $(status_of servo note)"
    [ "$(grep -c 'bus-off' $scratch/log)" -le 3 ] || fail "bus-off is said again and again"
    is servo "bus off" 1 || fail "bus off is counted $(status_of servo 'bus off') times"
}
is_lost() {
    [ "$(status_of "$1" state)" != streaming ]
}

can_interface_down() {
    vcan_up
    log_of_angles 1000
    configure "$SERVO"
    $ip link del vcan0
    start_daemon
    until_true 10 says 'there is no interface vcan0' || fail "the missing interface is not said"
    $ip link add vcan0 type vcan
    until_true 10 says 'vcan0 is down: `ip link set vcan0 up' || fail "the interface that is down is not said"
    $ip link set vcan0 mtu 72 up
    play_for_ever
    until_true 20 said_times 1 'servo: streaming' || fail "the servo does not stream"
    ups=
    for time in 2 3; do
        sleep 3 # else it is one that comes and goes, and is believed later
        $ip link set vcan0 down
        until_true 10 said_times $((time - 1)) 'lost: vcan0 was set down' || fail "the end is not said"
        sleep 2
        $ip link set vcan0 up
        began=$(uptime_ms)
        until_true 20 said_times $time 'servo: streaming' || fail "it does not come back"
        ups="$ups $(($(uptime_ms) - began))"
    done
    sleep 3
    $ip link del vcan0
    until_true 10 says 'lost: the interface vcan0 has gone\|lost: vcan0 was set down.*$' || fail "the deletion is not said"
    until_true 10 said_times 2 'there is no interface vcan0' || fail "that it is missing is not said"
    $ip link add vcan0 type vcan
    $ip link set vcan0 mtu 72 up
    began=$(uptime_ms)
    until_true 20 said_times 4 'servo: streaming' || fail "it does not come back after the deletion"
    echo "note: streams again$ups ms after up, $(($(uptime_ms) - began)) ms after it was made anew"
}

# simulated_robot ARGUMENTS...: its servo a CANopen drive at can1, the daemon's configuration at can0.
simulated_robot() {
    controllers_up
    # A drive has a processor of its own: on this one it comes first.
    /usr/bin/chrt -f 10 "$FACET" simulate hall --servo canopen --endless --can can1:can0 --truth $scratch/truth --dir $scratch/robot "$@" \
        >$scratch/said 2>&1 &
    robot=$!
    until_true 60 grep -q 'faults are ordered' $scratch/said || fail "the robot does not start"
    # This machine is slow: a slow line, a scanner that looks at few places, SYNCs at half the pace, and turns so gentle that a
    # SYNC without an answer, as there are some where both ends have one processor, still bends no angle; coarse cells.
    sed 's/speed: 30deg/speed: 37.5deg/; s|baud: 500000, variant: 180/0.5|baud: 38400, variant: 100/1|; s/sync: 10ms/sync: 20ms/; s/acceleration: 300deg/acceleration: 150deg/; s|unix:[^"]*facetd.sock|unix:/run/facetd.sock|' $scratch/robot/facetd.yaml >$scratch/facetd.yaml
    echo 'map: {cell: 0.2}' >>$scratch/facetd.yaml
}
stop_robot() {
    ended $robot
    robot=
}
robot=
# turns_of TRUTH: how often the axis went the other way, by more than a degree.
turns_of() {
    /usr/bin/awk '!/^#/ { at = $2 * 57.29578
        if (way == 0 || (at - far) * way > 0) { if (way == 0 && (at - first) ^ 2 > 1) way = at > first ? 1 : -1; far = at }
        else if ((far - at) * way > 1) { way = -way; far = at; turns++ }
        if (NR == 1) first = at }
        END { print turns + 0 }' "$1"
}
seconds_swept=${SWEPT:-60}

# Where the axis truly was is known to the simulator; where the daemon believed it to be, at the time of each beam, follows
# from the frames and their stamps in its journal.
can_swept() {
    simulated_robot
    start_daemon --journal $scratch/journal
    until_true 60 is servo state streaming || fail "the servo does not stream: $(status_of servo error)"
    until_true 60 rows_applied || fail "nothing is mapped"
    sleep "$seconds_swept"
    "$FACET" save -o $scratch/map.ply || fail "no mesh is published"
    faces=$(sed -n 's/^element face //p' $scratch/map.ply)
    rows=$(grep -o '"applied":[0-9]*' $STATUS | tail -n 1 | cut -d: -f2)
    sweeps=$(grep -o '"sweeps":[0-9]*' $STATUS | tail -n 1 | cut -d: -f2)
    stop_daemon
    "$BUILD/tests/angles" --beams laser $scratch/journal $scratch/facetd.yaml servo $scratch/truth >$scratch/figures ||
        fail "the kept list cannot be read"
    cat $scratch/figures
    echo "note: beams: $(figure $scratch/figures beam_errors), angle error p50 $(figure $scratch/figures beam_error_p50_deg), p99 $(figure $scratch/figures beam_error_p99_deg), max $(figure $scratch/figures beam_error_max_deg) degree"
    echo "note: angles: $(figure $scratch/figures angles) at $(figure $scratch/figures rate_hz) Hz, p99 $(figure $scratch/figures error_p99_deg), max $(figure $scratch/figures error_max_deg) degree; $rows rows, $sweeps sweeps, $faces faces"
    # What is judged is where an angle is said to be, not how many this processor can carry: of 50 a second.
    below 48 "$(figure $scratch/figures rate_hz)" ||
        skip "this machine is too busy: $(figure $scratch/figures rate_hz) of 50 angles a second"
    [ "${faces:-0}" -ge 500 ] || fail "the mesh has only $faces faces"
    turns=$(turns_of $scratch/truth)
    echo "note: the axis turned $turns times"
    # At 37.5 degrees a second there and back takes 6.4 s; this machine may be late with what begins the next.
    [ "$turns" -ge $((seconds_swept / 6)) ] || fail "the axis turned only $turns times in $seconds_swept s"
    [ "${sweeps:-0}" -ge $((seconds_swept / 10)) ] || fail "only $sweeps sweeps in $seconds_swept s"
    [ "$(figure $scratch/figures beam_errors)" -ge $((seconds_swept * 500)) ] || fail "too few beams"
    below "$(figure $scratch/figures beam_error_p99_deg)" 0.05 || fail "the angle's error is above 0.05 degree"
}

# ---- a drive steered by hand, as its manual says it ----

# sdo_write DATA, sdo_read INDEX_LOW_FIRST: to node 5; the answer comes by candump.
sdo_write() {
    cansend can0 "605#$1"
}
statusword() {
    : >$scratch/dump
    cansend can0 605#4041600000000000
    until_true 30 grep -q ' 585#4B416000' $scratch/dump || fail "the drive does not tell its status word"
    sed -n 's/.* 585#4B416000\(..\)\(..\).*/\2\1/p' $scratch/dump | tail -n 1
}
# state_is MASK VALUE: of the status word, as in CiA 402.
state_is() {
    [ $((0x$(statusword) & $1)) -eq $(($2)) ]
}
step_to() { # CONTROLWORD_LOW_FIRST MASK VALUE NAME
    sdo_write 2B406000$1"0000"
    until_true 30 state_is "$2" "$3" || fail "not '$4' after control word $1, but $(statusword)"
}
position_deg() {
    : >$scratch/dump
    cansend can0 605#4064600000000000
    until_true 30 grep -q ' 585#43646000' $scratch/dump || fail "the drive does not tell its position"
    raw=$(sed -n 's/.* 585#43646000\(..\)\(..\)\(..\)\(..\).*/\4\3\2\1/p' $scratch/dump | tail -n 1)
    /usr/bin/awk -v v=$((0x$raw)) 'BEGIN { print (v > 2147483647 ? v - 4294967296 : v) / 1000 }'
}
arrived() {
    state_is 0x0400 0x0400
}

# boots: is reset, and says so; candump may not have listened yet.
boots() {
    cansend can0 000#8105
    sleep 0.5
    grep -q ' 705#00' $scratch/dump
}

can_by_hand() {
    simulated_robot
    candump -L can0 >$scratch/dump 2>/dev/null &
    others=$!
    until_true 30 boots || fail "no boot-up message"
    cansend can0 000#0105 # start it
    sleep 1
    state_is 0x4F 0x40 || fail "it begins with status word $(statusword), not 'switch on disabled'"
    sdo_write 2F60600001000000 # profile position
    sdo_write 2381600060EA0000 # 60 degrees a second
    step_to 0600 0x6F 0x21 "ready to switch on"
    step_to 0700 0x6F 0x23 "switched on"
    step_to 0F00 0x6F 0x27 "operation enabled"
    sdo_write 237A600010270000 # 10 degrees
    step_to 1F00 0x1000 0x1000 "set-point acknowledged"
    step_to 0F00 0x1000 0x0000 "set-point bit taken back"
    until_true 30 arrived || fail "it does not arrive: $(statusword)"
    at=$(position_deg)
    below "$at" 10.01 && below 9.99 "$at" || fail "it stands at $at degrees, not at 10"
    step_to 0200 0x4F 0x40 "switch on disabled after a quick stop"
    echo "note: NMT 01, control words 6, 7, F, 1F by SDO: stands at $at degrees, status word $(statusword)"
}

# ---- a wire that goes away, and heartbeats that stay away ----

# moves: in the last half second that the simulator wrote.
moves() {
    tail -n 500 $scratch/truth | /usr/bin/awk '{ if (NR > 1 && $2 != last) n++; last = $2 } END { exit !(n > 100) }'
}
# stands: since a second and a half.
stands() {
    tail -n 1500 $scratch/truth | /usr/bin/awk '{ if (NR > 1 && $2 != last) n++; last = $2 } END { exit NR < 1500 || n > 0 }'
}
# amid: 30 degrees and more from both ends of the sweep, -65 and 45, where it would stand for a moment anyway.
amid() {
    is_within -35 15
}
is_within() { # DEGREES DEGREES
    tail -n 2 $scratch/truth | head -n 1 | /usr/bin/awk -v a="$1" -v b="$2" '{ at = $2 * 57.29578; exit !(a <= at && at <= b) }'
}

# This machine may itself be held up, by whoever shares its processor. How long it was at most is watched beside.
watch_standstills() {
    echo 0 >$scratch/standstill
    while sleep 0.2 && read -r up rest </proc/uptime; do
        now=${up%.*}${up#*.}0
        over=$((now - ${before:-$now} - 200))
        [ $over -le "$(cat $scratch/standstill)" ] || echo $over >$scratch/standstill
        before=$now
    done &
    others=$!
}
# Lost although nothing was done to it, or not come: where the machine stood still for a heartbeat or longer that says nothing
# of facetd.
starved_or_fail() {
    ! stood_still 1000 || skip "this machine is too busy: it stood still for $standstill ms, and $*"
    fail "$* (this machine stood still for $standstill ms at most)"
}
stood_still() { # MS
    standstill=$(cat $scratch/standstill)
    [ "${standstill:=0}" -ge "$1" ]
}
# untouched: sweeps, amid its way, and was not lost since $lost was counted.
untouched() {
    until_true 60 amid || starved_or_fail "it does not sweep through the middle"
    sleep 1.2 # the status is of the last second
    losses=$(status_of servo losses)
    [ "$losses" = "$lost" ] || starved_or_fail "the servo was lost by itself: $losses times, $lost before"
}
sweeps_again() { # WHEN: $again, the ms since $began
    until_true 60 moves_or_starved
    moves || starved_or_fail "it does not sweep $1: $(status_of servo note)"
    again=$(($(uptime_ms) - began))
    sleep 1.2
    lost=$(status_of servo losses)
}
moves_or_starved() { # for so long that the drive missed heartbeats
    moves || stood_still 2500
}
# The drive has to stop by itself: while it is within its sweep, and not because that is over.
stops() { # WHY
    until_true 30 stands || starved_or_fail "it moves on $1"
    is_within -63 43 || starved_or_fail "it stopped at the end of its sweep only, $1"
}

# Without the scanner, whose rays are too much for this machine beside. Heartbeats of a second, a slow SYNC and a gentle sweep:
# three seconds in which nothing was heard are somebody's doing, and those after them still belong to the same way.
can_heartbeats() {
    simulated_robot
    sed -i '/name: laser/,/tilt: servo/d; s/heartbeat: 200ms/heartbeat: 1s, timeout: 5s/; s/sync: 20ms/sync: 50ms/
        s/speed: 37.5deg/speed: 2deg/' $scratch/facetd.yaml
    watch_standstills
    start_daemon
    until_true 90 is servo state streaming || starved_or_fail "the servo does not stream: $(status_of servo error)"
    until_true 60 moves || starved_or_fail "it does not sweep"
    lost=0
    untouched
    kill -STOP $daemon
    began=$(uptime_ms)
    stops "while facetd is stopped"
    stood=$(($(uptime_ms) - began))
    kill -CONT $daemon
    began=$(uptime_ms)
    sweeps_again "after facetd was stopped"
    echo "note: stands $stood ms after facetd was stopped, sweeps $again ms after it goes on"
    untouched
    $ip link set can0 down
    until_true 20 says 'servo: .*can0 was set down' || starved_or_fail "the end of the interface is not said"
    stops "without a master"
    $ip link set can0 up
    began=$(uptime_ms)
    sweeps_again "after the interface is back"
    echo "note: sweeps $again ms after the interface is up"
    # Pulled out, and plugged in.
    untouched
    device=$(/usr/bin/readlink -f /sys/class/net/can0/device)
    echo 1 >"$device/remove"
    until_true 20 says 'there is no interface can0\|the interface can0 has gone' || starved_or_fail "that it was pulled out is not said"
    stops "with its wire pulled out"
    echo 1 >/sys/bus/pci/rescan
    until_true 20 test -e /sys/class/net/can0 || starved_or_fail "the kernel does not find it again"
    controller_up can0 || starved_or_fail "it cannot be set up again"
    began=$(uptime_ms)
    sweeps_again "after it was plugged in again"
    echo "note: sweeps $again ms after it was plugged in again; this machine stood still for $(cat $scratch/standstill) ms at most"
}
