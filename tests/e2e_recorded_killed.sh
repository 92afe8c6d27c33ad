#!/bin/sh
# Law L7, decision D9: a daemon that is killed while it records leaves a file that replays up to a second before the kill, and
# gives exactly the map of what was handled until then (the journal beside it says what that was).
#   tests/e2e_recorded_killed.sh [ROUNDS]     default 10; tests/soak plays 200
set -u
build=${FACET_BUILD:-build}
rounds=${1:-10}
unset FACETD FACETD_CONFIG
out=$(mktemp -d)
simulator=
trap '[ -z "$simulator" ] || kill "$simulator" 2>/dev/null; wait 2>/dev/null; rm -rf "$out"' EXIT
trap 'exit 1' INT TERM

cat >"$out/play.py" <<'PYTHON'
import json, os, random, signal, struct, subprocess, sys, time

build, out, rounds = sys.argv[1], sys.argv[2], int(sys.argv[3])
choose = random.Random(7)
LOST_S = 1.0
# A chunk is closed at 0.75 s and a tick; on a loaded machine the recorder's thread and the disk may have to wait for their turn.
SLACK_S = float(os.environ.get("RECORDED_SLACK", "0.5"))


def entries(path):
    """Of a kept journal: (kind, end) of each whole entry."""
    data = open(path, "rb").read()
    at = 8
    assert data[:8] == b"FACETJ2\n", "the journal"
    while at < len(data):
        fixed = {1: 4, 2: 22, 3: 8, 4: 8, 5: 8}[data[at]]
        if at + 1 + fixed > len(data):
            return
        n = struct.unpack_from("<I", data, at + 1 + fixed - 4)[0] if data[at] in (1, 2) else 0
        end = at + 1 + fixed + n
        if end > len(data):
            return
        yield data[at], end
        at = end


def info(path):
    run = subprocess.run([f"{build}/facet", "info", "--json", path], capture_output=True, text=True, timeout=60, check=False)
    assert run.returncode == 0, f"facet info: {run.stderr}"
    return json.loads(run.stdout)


def replay(path, *options):
    stats = f"{out}/stats.json"
    run = subprocess.run([f"{build}/facet", "replay", path, "-o", f"{out}/map.ply", "--stats", stats, *options], capture_output=True, text=True, timeout=120, check=False)
    assert run.returncode == 0, f"facet replay {path}: {run.stderr}"
    return json.load(open(stats, encoding="ascii"))


def cut_journal(path, count, cut):
    """The first `count` records and ticks, with the rows that they led to. False: the journal has not so many."""
    seen, at = 0, 8
    for kind, end in entries(path):
        seen += kind in (2, 3)
        if seen > count:
            break
        at = end
    open(cut, "wb").write(open(path, "rb").read()[:at])
    return seen > count


lost_most, rows, compared = 0.0, 0, 0
for number in range(rounds):
    folder, journal = f"{out}/rec{number}", f"{out}/journal"
    config = f"{out}/facetd.yaml"
    text = open(f"{out}/sim/facetd.yaml", encoding="ascii").read()
    open(config, "w", encoding="ascii").write(text + f"record: {{dir: {folder}}}\n")
    daemon = subprocess.Popen([f"{build}/facetd", "--config", config, "--journal", journal], stderr=subprocess.PIPE, text=True)
    limit = time.monotonic() + 30
    while not (os.path.isdir(folder) and os.listdir(folder)):
        assert daemon.poll() is None and time.monotonic() < limit, "no recording begins"
        time.sleep(0.02)
    time.sleep(choose.uniform(0.3, 3.5))
    daemon.send_signal(signal.SIGKILL)
    killed_ns = time.time_ns()  # log time is the wall clock's, as long as nobody sets that
    daemon.wait()
    files = [f"{folder}/{name}" for name in sorted(os.listdir(folder))]
    assert len(files) == 1, files
    told = info(files[0])
    lost = (killed_ns - told["end_ns"]) / 1e9
    lost_most = max(lost_most, lost)
    assert lost <= LOST_S + SLACK_S, f"round {number}: {lost:.3f} s are lost"
    assert not told["ended"] and told["damaged_bytes"] >= 0
    first = replay(files[0])
    rows += first["rows"]
    # What was recorded gives the map of the same stretch of the journal; that is buffered, so it may be the shorter one.
    if cut_journal(journal, told["records"] + told["ticks"], f"{out}/cut"):
        second = replay(f"{out}/cut", "--config", config)
        assert first["rows"] == second["rows"] and first["hash"] == second["hash"], f"round {number}: another map: {first['rows']} rows, not {second['rows']}"
        compared += 1
    subprocess.run([f"{build}/facet", "repair", files[0], "-o", f"{out}/good.mcap"], check=True, stdout=subprocess.DEVNULL, timeout=60)
    good = info(f"{out}/good.mcap")
    assert good["whole"] and good["statistics_agree"] and good["records"] == told["records"], "the repaired file"
    os.remove(files[0])
print(f"note: {rounds} kills, at most {lost_most:.2f} s lost, {rows} rows replayed, {compared} maps compared with the journal's")
PYTHON

mkdir "$out/sim"
"$build/facet" simulate building --endless --dir "$out/sim" >"$out/simulate.log" 2>&1 &
simulator=$!
tries=0
until [ -s "$out/sim/facetd.yaml" ]; do
    tries=$((tries + 1))
    [ $tries -lt 300 ] || { cat "$out/simulate.log"; exit 1; }
    sleep 0.1
done
python3 "$out/play.py" "$build" "$out" "$rounds"
