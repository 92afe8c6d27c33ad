#!/bin/sh
# Laws L4, L6: whatever a client does (reads everything, joins late, stops reading for 20 s over a unix socket or TCP, comes,
# goes and changes its wishes at random), at every COMMIT it holds a sound mesh of one step, and in the end all hold the same bytes.
. "$(dirname "$0")/lib.sh"
set -eu
profiles=../shared/data/captures/tilt/kurt3d_scan0_profiles.csv
[ -f "$profiles" ] || { echo "the real sweeps (../shared/data/captures/tilt) are not here"; exit 77; }
LINES_PLAYED=150 JOIN_S=14 STALL_FROM_S=8 STALL_S=20

grep -v '^#' "$profiles" | head -n "$LINES_PLAYED" >"$scratch/part.csv"
cp "${profiles%_profiles.csv}.pose" "$scratch/part.pose"
mkdir "$scratch/held"

wait_for() { # PID COMMAND...: until it is true, as long as the process lives
    pid=$1
    shift
    until "$@"; do
        kill -0 "$pid" 2>/dev/null || { cat "$scratch"/*.log; exit 1; }
        sleep 0.1
    done
}

# The devices end two seconds after the last line, the daemon and its clients when all of them hold the same.
"$facet" simulate "profiles:$scratch/part.csv" --dir "$scratch/d" >"$scratch/simulator.log" 2>&1 &
simulator=$!
wait_for $simulator grep -qs '^address ' "$scratch/simulator.log"
port=$(python3 -c 'import socket; s = socket.socket(); s.bind(("127.0.0.1", 0)); print(s.getsockname()[1])')
sed -e 's/baud: 500000/baud: 38400/' -e "s|^listen: {native: \[\([^]]*\)\]|listen: {native: [\1, \"tcp:127.0.0.1:$port\"], send_buffer: 16384|" \
    "$scratch/d/facetd.yaml" >"$scratch/config.yaml"
"$facetd" --config "$scratch/config.yaml" --journal "$scratch/journal" 2>"$scratch/daemon.log" &
daemon=$!
wait_for $daemon grep -qs "listens on tcp" "$scratch/daemon.log"
"$build/tests/clients" "$scratch/d/facetd.sock" "$port" "$scratch/held" "$JOIN_S" "$STALL_FROM_S" "$STALL_S" >"$scratch/clients.log" 2>&1 ||
    { cat "$scratch"/*.log; exit 1; }
cat "$scratch/clients.log"
"$facet" save "unix:$scratch/d/facetd.sock" -o "$scratch/saved.ply"
kill $daemon
wait $daemon || { cat "$scratch/daemon.log"; echo "the daemon did not end in order"; exit 1; }
[ "$(grep -c '^\(reads everything\|stalls, unix\|stalls, tcp\|joins late\): ' "$scratch/clients.log")" = 4 ] ||
    { echo "not all clients were compared at the end"; exit 1; }
newest=$(sed -n 's/^reads everything: .* step \([0-9]*\), .*/\1/p' "$scratch/clients.log")
cmp "$scratch/saved.ply" "$scratch/held/$newest.ply" || { echo "the daemon's map at the end is not what the clients hold"; exit 1; }
python3 tests/judge_steps.py "$build" "$scratch"
