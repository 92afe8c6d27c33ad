#!/bin/sh
# Law: facet save and facet watch are honest clients: what they write is whole, what goes wrong is one sentence and a status.
. "$(dirname "$0")/lib.sh"

refused() { # STATUS WORDS COMMAND...: ends with the status and one line on stderr that has the words
    want=$1 words=$2
    shift 2
    "$@" >"$scratch/out" 2>"$scratch/err"
    status=$?
    [ $status -eq "$want" ] || fail "$*: status $status, not $want"
    [ "$(wc -l <"$scratch/err")" -eq 1 ] || [ "$want" -eq 2 ] || fail "$*: not one sentence: $(cat "$scratch/err")"
    grep -q "$words" "$scratch/err" || fail "$*: '$(cat "$scratch/err")' does not say '$words'"
}

mkdir "$scratch/run"
address=unix:$scratch/run/facetd.sock

# Nobody there, nothing to write to, nothing understood.
refused 1 "no daemon answers at $address" "$facet" save "$address" -o "$scratch/none.ply"
[ -e "$scratch/none.ply" ] && fail "a mesh was written without a daemon"
refused 1 "no daemon answers at $address" "$facet" watch --once "$address"
refused 1 "make its folder first" "$facet" save "$address" -o "$scratch/missing/none.ply"
refused 2 "names no format" "$facet" save "$address" -o "$scratch/none.xyz"
refused 2 "is not an address" "$facet" watch --once somewhere
refused 2 "ssh -L" "$facet" save wss://127.0.0.1:7880/ -o "$scratch/none.ply"
refused 1 "cannot be read" "$facet" picture "$scratch/none.ply" -o "$scratch/none.png"
for command in save watch picture; do
    "$facet" $command --help | grep -q '^Usage: facet' || fail "facet $command --help says nothing"
done

"$facet" simulate hall --endless --dir "$scratch/run" -- "$facetd" >"$scratch/daemon.log" 2>&1 &
daemon=$!
until_true 30 "$facet" watch --once "$address" || { cat "$scratch/daemon.log"; fail "the daemon does not come up"; exit 1; }

# The same snapshot in every format, of a map that grows meanwhile.
"$facet" save "$address" -o "$scratch/early.ply" --wait-steps 20 --timeout 600 >"$scratch/out" || fail "no snapshot at step 20"
step=$(sed -n 's/.*: step \([0-9]*\),.*/\1/p' "$scratch/out")
[ "${step:-0}" -ge 20 ] || fail "--wait-steps 20 gave step ${step:-none}"
for ending in ply obj stl glb json; do
    FACETD=$address "$facet" save -o "$scratch/map.$ending" >/dev/null || fail "facet save -o map.$ending"
    [ -s "$scratch/map.$ending" ] || fail "map.$ending is empty"
done
"$facet" save "$address" --ascii -o "$scratch/ascii.ply" >/dev/null && grep -q '^format ascii' "$scratch/ascii.ply" || fail "--ascii"
[ "$(cat "$scratch/map.json")" = "[]" ] || fail "map.json is not the list of planes"
# The servo looks up first: a map of half a sweep may be all ceiling, and nothing is left below the cut.
"$facet" save "$address" -o "$scratch/look.ply" --wait-steps 220 --timeout 600 >/dev/null || fail "no snapshot at step 220"
"$facet" picture "$scratch/look.ply" -o "$scratch/map.png" --size 160x100 || fail "no picture of the map"
ls "$scratch" | grep -q 'part' && fail "something half written is left"
refused 1 "no whole map of step 99999999" "$facet" save "$address" -o "$scratch/never.ply" --wait-steps 99999999 --timeout 0.5
[ -e "$scratch/never.ply" ] && fail "a map was written that never came"

# Watching: a table, JSON, and a line a second in a pipe that ends with its reader.
"$facet" watch --once "$address" >"$scratch/table" || fail "facet watch --once"
for word in laser servo step triangles memory latency; do
    grep -q "$word" "$scratch/table" || fail "the table does not show $word"
done
grep -Eq '^laser .* [0-9.]+ of 37.5 +[0-9.]+/[0-9.]+ ' "$scratch/table" || fail "the table does not show rate and jitter: $(cat "$scratch/table")"
[ "$(head -n 4 "$scratch/table" | wc -L)" -lt 100 ] || fail "the table is wider than a window: $(cat "$scratch/table")"
"$facet" watch --once --json "$address" | python3 -c '
import json, sys
status = json.loads(sys.stdin.readline())
assert status["class"] == "STATUS" and status["step"] > 0, status
devices = {d["name"]: d for d in status["devices"]}
assert devices.keys() >= {"laser", "servo"}, status
timing = devices["laser"]["timing"]
assert timing["expected"] == 37.5 and 0 <= timing["jitter_ms"]["p50"] <= timing["jitter_ms"]["p99"], timing
assert devices["laser"]["note"] == "" and devices["laser"]["silent"] >= 0, devices["laser"]' || fail "facet watch --json"
timeout 120 "$facet" watch "$address" | head -n 2 >"$scratch/lines"
[ "$(grep -c '^step [0-9]' "$scratch/lines")" -eq 2 ] || fail "facet watch in a pipe: $(cat "$scratch/lines")"

# In a window of 80 columns and 24 rows nothing is cut off: lines are folded, the columns of the table fit.
python3 - "$facet" "$address" >"$scratch/window" <<'EOF' || fail "facet watch in a window of 80 columns: $(cat "$scratch/window")"
import fcntl, os, pty, re, signal, struct, sys, termios, time

pid, fd = pty.fork()
if pid == 0:
    fcntl.ioctl(0, termios.TIOCSWINSZ, struct.pack("4H", 24, 80, 0, 0))
    os.execv(sys.argv[1], [sys.argv[1], "watch", sys.argv[2]])
seen, end = b"", time.monotonic() + 120
while seen.count(b"\033[J") < 2 and time.monotonic() < end:
    seen += os.read(fd, 65536)
os.kill(pid, signal.SIGINT)
lines = [re.sub(r"\033\[[?0-9]*[A-Za-z]", "", line) for line in seen.split(b"\033[H")[1].decode().splitlines()]
print("\n".join(lines))
assert max(map(len, lines)) < 80, "wider than the window"
assert re.fullmatch(r"servo .* [0-9,]+", next(line for line in lines if line.startswith("servo")))
assert "until its changes can be sent" in re.sub(r"\s+", " ", " ".join(lines)), "cut off"
assert re.search(r" up \d+:\d\d:\d\d", " ".join(lines[:2])), "cut off"
EOF

# A pose that nobody feeds is open, but nothing streams.
cat >"$scratch/lone.yaml" <<YAML
devices:
  - {name: unfed, driver: pose, listen: "unix:$scratch/unfed.sock"}
listen: {native: ["unix:$scratch/lone.sock"]}
YAML
"$facetd" --config "$scratch/lone.yaml" 2>/dev/null &
lone=$!
is_silent() {
    "$facet" watch --once "unix:$scratch/lone.sock" | grep -q '^unfed .* silent .* 0.0 '
}
until_true 20 is_silent || fail "a pose that nobody feeds is shown as: $("$facet" watch --once "unix:$scratch/lone.sock")"
kill $lone
wait $lone

# The document of the protocol is enough to write a client: this one, from its tables, holds the same map as facet save.
cat >"$scratch/client.py" <<'EOF'
import json, socket, struct, sys, time

def connect():
    s = socket.socket(socket.AF_UNIX)
    s.settimeout(300)
    s.connect(sys.argv[1])
    return s.makefile("rwb")

def ask(stream, line):
    stream.write(line.encode() + b"\n")
    stream.flush()
    return json.loads(stream.readline())

def frames(stream):
    while True:
        length, kind, flags, zero = struct.unpack("<IBBH", stream.read(8))
        assert flags == 0 and zero == 0 and 4 <= length <= (16 << 20) - 4
        yield kind, stream.read(length - 4)

def read_patch(data):
    x, y, z, version, first, last, nv, nt, nr = struct.unpack_from("<3iQqqHHH", data)
    assert first <= last and nv >= 3 and nt and nr
    at = 42
    vertices = [v for v in struct.iter_unpack("<3H", data[at:at + 6 * nv])]
    assert all(c <= 4096 for v in vertices for c in v)
    at += 6 * nv
    assert sum(run[2] for run in struct.iter_unpack("<IBH", data[at:at + 7 * nr])) == nt
    at += 7 * nr
    triangles = list(struct.iter_unpack("<3B" if nv <= 256 else "<3H", data[at:]))
    assert len(triangles) == nt and all(i < nv for t in triangles for i in t)
    return (x, y, z), [tuple(4096 * k + c for k, c in zip((x, y, z), v)) for v in vertices], triangles, version

def read_map():
    stream = connect()
    stream.write(struct.pack("<IBBHB3xI6f", 36, 2, 0, 0, 0, 0, *[0.0] * 6))
    stream.flush()
    patches, announced, step = {}, None, None
    for kind, data in frames(stream):
        if kind == 1:
            major, minor, map_id, generation, cell, hello_step, t = struct.unpack("<HH16sIdQq", data)
            assert major == 1 and cell == 0.05 and generation == 1 and abs(t / 1e9 - time.time()) < 60
        elif kind == 3:
            step, count, removals, reset = struct.unpack("<QIIB", data)
            assert reset == 1 and removals == 0
        elif kind == 4:
            key, vertices, triangles, version = read_patch(data)
            assert key not in patches and version <= step
            patches[key] = vertices, triangles
        elif kind == 8:
            assert struct.unpack("<Q", data)[0] == step and len(patches) == count
            return step, len({v for vs, _ in patches.values() for v in vs}), sum(len(t) for _, t in patches.values())

lines = connect()
assert ask(lines, "?PAUSE")["class"] == "VERSION"
assert json.loads(lines.readline()) == {"class": "OK", "command": "PAUSE"}
assert ask(lines, "?NONSENSE")["class"] == "ERROR"
assert ask(lines, '?WATCH={"enable":false}') == {"class": "WATCH", "enable": False}
status = ask(lines, "?STATUS;")
assert status["paused"] is True
while not ask(lines, "?STATUS;")["queue"]["idle"]:
    time.sleep(0.1)
now = read_map()
print("step %d, %d vertices, %d faces" % now)
EOF
python3 "$scratch/client.py" "${address#unix:}" >"$scratch/documented" || fail "a client written from docs/protocol.md"
"$facet" save "$address" -o "$scratch/paused.ply" >"$scratch/out" || fail "facet save of a paused map"
grep -qF "$(cat "$scratch/documented")" "$scratch/out" ||
    fail "a client written from docs/protocol.md holds $(cat "$scratch/documented"), facet save $(cat "$scratch/out")"
echo "note: a client written from the document holds $(cat "$scratch/documented")"

# A daemon that goes away is said once, and watched again when it is back.
timeout 600 "$facet" watch "$address" >"$scratch/lines" 2>"$scratch/err" &
watch=$!
until_true 20 grep -q '^step' "$scratch/lines" || fail "nothing is watched"
kill "$daemon"
wait "$daemon" 2>/dev/null
until_true 20 grep -q 'facet: .*; trying again every second' "$scratch/err" || fail "the loss is not said: $(cat "$scratch/err")"
rm -rf "$scratch/run"
mkdir "$scratch/run"
: >"$scratch/lines"
"$facet" simulate hall --endless --dir "$scratch/run" -- "$facetd" >"$scratch/daemon.log" 2>&1 &
daemon=$!
until_true 40 grep -q 'step' "$scratch/lines" || fail "the daemon that came back is not watched: $(cat "$scratch/err")"
kill -INT "$watch"
wait "$watch"
exit $failed
