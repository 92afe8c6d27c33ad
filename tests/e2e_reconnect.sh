#!/bin/sh
# Law L9: devices that vanish under a running daemon cost what they would have seen and nothing else: they stream again by
# themselves when they are back, the map goes on from where it stood, and the log has a line for each change, not for each try.
. "$(dirname "$0")/lib.sh"
address=unix:$scratch/d/facetd.sock

# shellcheck disable=SC2120
start_devices() { # ARGUMENTS...
    "$facet" simulate hall --dir "$scratch/d" "$@" >>"$scratch/simulator.log" 2>&1 &
    simulator=$!
    until_true 60 [ -e "$scratch/d/servo" ] && until_true 60 [ -e "$scratch/d/facetd.yaml" ] ||
        give_up "the simulator does not come up"
}

step_of() {
    status 's["step"]'
}

lines() { # PATTERN: how often the daemon's log says it
    grep -c "$1" "$scratch/daemon.log"
}

ALL='all(device["state"] == "streaming" for device in d.values())'
start_devices
"$facetd" --config "$scratch/d/facetd.yaml" 2>"$scratch/daemon.log" &
daemon=$!
until_true 60 holds "$ALL and s['step'] >= 20" || give_up "the devices do not stream"

# Pulled out: the nodes go, as udev takes them, and nobody may meet a stranger's terminal of the same number.
rm -f "$scratch/d/laser" "$scratch/d/servo"
kill -KILL $simulator
wait $simulator 2>/dev/null
# Ten tries of both, so that a line for each would be seen.
until_true 60 holds 'all(d[name]["state"] != "streaming" and d[name]["losses"] >= 5 for name in ("laser", "servo"))' ||
    give_up "the devices are not lost"
before=$(step_of)
map=$(status 's["map"], s["generation"]')
tries=$(status 'd["laser"]["losses"] + d["servo"]["losses"]')
kill -0 $daemon || give_up "the daemon ended with its devices"

# Plugged in again.
start_devices
begin=$(date +%s)
[ "$(step_of)" -ge "$before" ] || fail "the map fell back from step $before"
until_true 60 holds "$ALL" || give_up "the devices do not come back"
until_true 60 holds "$ALL and s['step'] >= $before + 20" || give_up "the map does not grow again after step $before: $(step_of)"
after=$(step_of)
[ "$(status 's["map"], s["generation"]')" = "$map" ] || fail "it is another map now"
echo "note: $tries tries while the devices were away, $(wc -l <"$scratch/daemon.log") lines of log, step $before to $after $(($(date +%s) - begin)) s after their return"

[ "$(wc -l <"$scratch/daemon.log")" -lt 20 ] || fail "the log is flooded"
for name in laser servo; do
    # A loaded machine may lose a device once more; then it says so, and that it came back.
    lost=$(lines "$name: lost") streaming=$(lines "$name: streaming") refused=$(lines "$name: not ready")
    [ "$lost" -ge 1 ] && [ "$streaming" -eq $((lost + 1)) ] || fail "$name: lost $lost times, streaming $streaming times"
    [ "$refused" -ge 1 ] || fail "$name: nothing says why it does not come back"
    [ "$(grep "$name: not ready" "$scratch/daemon.log" | sed 's/.*not ready/not ready/; s/ (.*//' | sort | uniq -d | wc -l)" -le $((lost - 1)) ] ||
        fail "$name: the same reason is told again and again"
done
kill -TERM $daemon
wait $daemon || fail "the daemon did not end well"
[ $failed -eq 0 ] || cat "$scratch/daemon.log"
exit $failed
