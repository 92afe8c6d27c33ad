#!/bin/sh
# Laws L7, L9: a pose that jumps under a running daemon is told to its clients, and what `on_jump` says happens: the map goes on;
# the old correction is held, as if nothing had been; or a new map begins, the old one is saved whole, and the kept list of
# each gives it again.
. "$(dirname "$0")/lib.sh"

# A localisation whose map is moved under the robot while the file `moved` exists: it stands between the simulated one and the daemon.
cat >"$scratch/localisation.py" <<'END'
import json, math, os, socket, sys
source, sink, moved = sys.argv[1:]
taken = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
taken.bind(source)
given = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
while True:
    pose = json.loads(taken.recv(4096))
    if os.path.exists(moved):
        angle = math.radians(20)
        x, y, z = pose["position"]
        qx, qy, qz, qw = pose["orientation"]
        c, s = math.cos(angle / 2), math.sin(angle / 2)
        pose["position"] = [x * math.cos(angle) - y * math.sin(angle) + 2, x * math.sin(angle) + y * math.cos(angle) - 1, z]
        pose["orientation"] = [c * qx - s * qy, c * qy + s * qx, c * qz + s * qw, c * qw - s * qz]
    try:
        given.sendto(json.dumps(pose).encode(), sink)
    except OSError:
        pass
END

events() { # EXPRESSION over the list of events e: its value
    python3 -c '
import json, sys
lines = [json.loads(line) for line in open(sys.argv[1])]
e = [line for line in lines if line["class"] not in ("STATUS", "DEVICE")]
value = eval("(" + sys.argv[2] + ")")
print(value)
sys.exit(value is False)' "$dir/events" "$1"
}

sees() {
    events "$1" >/dev/null
}

begin() { # ON_JUMP SIMULATE-OPTIONS...: devices, localisation, daemon and a client that watches
    mode=$1
    shift
    dir=$scratch/$mode
    address=unix:$dir/facetd.sock
    mkdir "$dir" "$dir/archive"
    python3 "$scratch/localisation.py" "$dir/pose.sock" "$dir/moved.sock" "$dir/moved" 2>"$dir/localisation.log" &
    until_true 60 [ -e "$dir/pose.sock" ] || give_up "no localisation"
    "$facet" simulate hall --endless --dir "$dir" "$@" >"$scratch/$mode.simulator.log" 2>&1 &
    until_true 60 [ -s "$dir/facetd.yaml" ] || give_up "the simulator does not come up"
    sed "s|pose.sock\"}|moved.sock\", on_jump: ${mode%-*}}|; \$a map: {archive: \"$dir/archive\"}" "$dir/facetd.yaml" >"$dir/jumps.yaml"
    "$facetd" --config "$dir/jumps.yaml" --journal "$dir/journal" 2>"$scratch/$mode.daemon.log" &
    daemon=$!
    until_true 60 holds "s['step'] >= 60" || give_up "$mode: no map grows"
    "$facet" watch --json "$address" >"$dir/events" 2>"$scratch/$mode.watch.log" &
    until_true 60 [ -s "$dir/events" ] || give_up "$mode: nothing to watch"
}

end() {
    kill "$daemon"
    wait "$daemon" || fail "$mode: the daemon ends with $?"
    end_all
}

# keep: the map goes on, and the way back is told as such.
begin keep
map=$(status "s['map'], s['generation']")
touch "$dir/moved"
until_true 60 sees "len(e) == 1" || give_up "keep: nobody tells of a jump"
events "e[0]['class'] == 'JUMP' and e[0]['device'] == 'pose' and e[0]['done'] == 'keep' and not e[0]['back'] and
        abs(e[0]['angle'] - 0.349) < 0.05 and e[0]['distance'] > 0.5" >/dev/null || fail "keep: $(events e)"
step=$(status "s['step']")
until_true 60 holds "s['step'] > $step + 60" || fail "keep: the map stands after a jump"
rm "$dir/moved"
until_true 60 sees "len(e) == 2 and e[1]['back']" || fail "keep: the way back: $(events e)"
[ "$(status "s['map'], s['generation']")" = "$map" ] || fail "keep: another map"
[ "$(grep -c 'the pose jumped' "$scratch/keep.daemon.log")" = 2 ] || fail "keep: not a line for each jump"
grep -q 'jumped back by .* degrees: the map goes on' "$scratch/keep.daemon.log" || fail "keep: no line of the way back"
holds "d['pose']['jumps'] == 2" || fail "keep: the status counts other jumps"
end

# With odometry: poses come once a second, and a jump is told by what the wheels say. While the wheels are silent no row is
# placed by a guess.
begin keep-odometry --odometry
holds "0 <= d['odometry']['sigma']['position'] < 0.2 and d['odometry']['jumps'] == 0" || fail "odometry: $(status "d['odometry']")"
touch "$dir/moved"
until_true 60 sees "len(e) == 1 and e[0]['done'] == 'keep' and abs(e[0]['angle'] - 0.349) < 0.02" || fail "odometry: $(events e)"
stale=$(status "s['rows']['dropped']['stale pose']")
python3 - "$dir/simulator.sock" <<'END' >/dev/null || fail "odometry: no fault to be had"
import socket, sys
s = socket.socket(socket.AF_UNIX)
s.connect(sys.argv[1])
s.sendall(b"odometry: silence for 4s\n")
print(s.recv(1000))
END
until_true 60 holds "s['rows']['dropped']['stale pose'] > $stale + 50" || fail "odometry: rows are placed without a pose"
until_true 60 holds "d['odometry']['state'] == 'streaming' and d['odometry']['gaps'] >= 1" || fail "odometry: the wheels are not back"
step=$(status "s['step']")
until_true 60 holds "s['step'] > $step + 60" || fail "odometry: the map stands"
sees "len(e) == 1" || fail "odometry: corrections are told as jumps: $(events e)"
echo "note: odometry: $(status "'%.0f mm, %.2f degrees, %d rows dropped in a silence of 4 s' % (1000 * d['odometry']['sigma']['position'], 57.3 * d['odometry']['sigma']['heading'], s['rows']['dropped']['stale pose'])")"
end

# ignore: the map stays sound, as if nothing had been.
begin ignore
touch "$dir/moved"
until_true 60 sees "len(e) == 1 and e[0]['done'] == 'ignore'" || fail "ignore: $(events e)"
step=$(status "s['step']")
until_true 60 holds "s['step'] > $step + 300" || fail "ignore: the map stands after a jump"
say '?PAUSE' >/dev/null
until_true 60 holds "s['queue']['idle']"
timeout 300 "$facet" save "$address" -o "$dir/held.ply" >/dev/null || fail "ignore: no mesh"
# The hall is 15 x 9 m: another frame would put walls elsewhere.
python3 - "$dir/held.ply" "$scratch/ignore.size" <<'END' || fail "ignore: $(cat "$scratch/ignore.size")"
import struct, sys
data = open(sys.argv[1], "rb").read()
head = data[:data.index(b"end_header\n") + 11]
n = int([line for line in head.decode().splitlines() if line.startswith("element vertex")][0].split()[2])
size = sum({"double": 8, "float": 4}[line.split()[1]] for line in head.decode().split("element face")[0].splitlines() if line.startswith("property"))
points = [struct.unpack_from("<3d", data, len(head) + i * size) for i in range(n)]
spans = [max(p[a] for p in points) - min(p[a] for p in points) for a in range(2)]
open(sys.argv[2], "w").write(f"{n} vertices, {spans[0]:.2f} x {spans[1]:.2f} m")
sys.exit(not (n > 100 and spans[0] < 16 and spans[1] < 11))
END
echo "note: ignore: $(cat "$scratch/ignore.size")"
end

# new_map: the old one is in its file, whole, and the kept lists give both.
begin new_map
map=$(status "s['map']")
touch "$dir/moved"
until_true 60 sees "len(e) == 3" || give_up "new_map: $(events e)"
events "[x['class'] for x in e] == ['JUMP', 'MAP', 'SAVED'] and e[0]['done'] == 'new_map' and e[1]['before'] == '$map' and
        e[1]['map'] != '$map' and e[1]['generation'] == 2 and e[2]['map'] == '$map' and e[2]['file'] == '$dir/archive/$map.ply'" \
    >/dev/null || fail "new_map: $(events e)"
holds "s['map'] == '$(events "e[1]['map']")' and s['generation'] == 2" || fail "new_map: the status says another map"
[ "$(ls "$dir/archive")" = "$map.ply" ] || fail "new_map: $(ls "$dir/archive") in the archive"
if [ -x ../shared/tools/meshcheck ]; then
    python3 tests/judge.py "$dir/archive/$map.ply" -- "faces>=100" || fail "new_map: the saved map is not sound"
fi
until_true 60 holds "s['step'] >= 60" || fail "new_map: the new map does not grow"
say '?PAUSE' >/dev/null
until_true 60 holds "s['queue']['idle']"
timeout 300 "$facet" save "$address" -o "$dir/after.ply" >/dev/null || fail "new_map: no mesh after the jump"
end
if [ -x "$build/tests/test_replay" ]; then
    for list in journal:$dir/archive/$map.ply journal.2:$dir/after.ply; do
        "$build/tests/test_replay" "$dir/jumps.yaml" "$dir/${list%%:*}" "$dir/fed.ply" >"$scratch/fed.log" 2>&1 || fail "new_map: $(cat "$scratch/fed.log")"
        cmp "$dir/fed.ply" "${list#*:}" || fail "new_map: ${list%%:*} gives another map"
    done
    [ ! -e "$dir/journal.3" ] || fail "new_map: a third list"
fi
echo "note: new_map: $(grep -o 'saved as.*triangles' "$scratch/new_map.daemon.log" | sed 's|as .*/|as |')"
grep -c AddressSanitizer "$scratch"/*.log | grep -v ':0' && fail "a sanitizer found something"
exit $failed
