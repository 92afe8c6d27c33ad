#!/bin/sh
# Laws L4, L6: whatever a client does (reads everything, joins late, stops reading for 20 s over a unix socket or TCP, comes,
# goes and changes its wishes at random), at every COMMIT it holds a sound mesh of one step, and in the end all hold the same bytes.
set -eu
profiles=../shared/data/captures/tilt/kurt3d_scan0_profiles.csv
[ -f "$profiles" ] || { echo "the real sweeps (../shared/data/captures/tilt) are not here"; exit 77; }
build=${FACET_BUILD:-build}
out=$(mktemp -d)
simulator='' daemon=''
unset FACETD XDG_RUNTIME_DIR FACETD_CONFIG
cleanup() {
    for pid in $daemon $simulator; do kill -KILL "$pid" 2>/dev/null || :; done
    wait 2>/dev/null || :
    rm -rf "$out"
}
trap cleanup EXIT
trap 'exit 1' INT TERM
LINES_PLAYED=150 JOIN_S=14 STALL_FROM_S=8 STALL_S=20

grep -v '^#' "$profiles" | head -n "$LINES_PLAYED" >"$out/part.csv"
cp "${profiles%_profiles.csv}.pose" "$out/part.pose"
mkdir "$out/held"

wait_for() { # PID COMMAND...: until it is true, as long as the process lives
    pid=$1
    shift
    until "$@"; do
        kill -0 "$pid" 2>/dev/null || { cat "$out"/*.log; exit 1; }
        sleep 0.1
    done
}

# The devices end two seconds after the last line, the daemon and its clients when all of them hold the same.
"$build/facet" simulate "profiles:$out/part.csv" --dir "$out/d" >"$out/simulator.log" 2>&1 &
simulator=$!
wait_for $simulator grep -qs '^address ' "$out/simulator.log"
port=$(python3 -c 'import socket; s = socket.socket(); s.bind(("127.0.0.1", 0)); print(s.getsockname()[1])')
sed -e 's/baud: 500000/baud: 38400/' -e "s|^listen: {native: \[\([^]]*\)\]|listen: {native: [\1, \"tcp:127.0.0.1:$port\"], send_buffer: 16384|" \
    "$out/d/facetd.yaml" >"$out/config.yaml"
"$build/facetd" --config "$out/config.yaml" --journal "$out/journal" 2>"$out/daemon.log" &
daemon=$!
wait_for $daemon [ -S "$out/d/facetd.sock" ]
"$build/tests/clients" "$out/d/facetd.sock" "$port" "$out/held" "$JOIN_S" "$STALL_FROM_S" "$STALL_S" >"$out/clients.log" 2>&1 ||
    { cat "$out"/*.log; exit 1; }
cat "$out/clients.log"
"$build/facet" save "unix:$out/d/facetd.sock" -o "$out/saved.ply"
kill $daemon
wait $daemon || { cat "$out/daemon.log"; echo "the daemon did not end in order"; exit 1; }
daemon=''
[ "$(grep -c '^\(reads everything\|stalls, unix\|stalls, tcp\|joins late\): ' "$out/clients.log")" = 4 ] ||
    { echo "not all clients were compared at the end"; exit 1; }
newest=$(sed -n 's/^reads everything: .* step \([0-9]*\), .*/\1/p' "$out/clients.log")
cmp "$out/saved.ply" "$out/held/$newest.ply" || { echo "the daemon's map at the end is not what the clients hold"; exit 1; }
python3 tests/judge_steps.py "$build" "$out"
