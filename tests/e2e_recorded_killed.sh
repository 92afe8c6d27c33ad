#!/bin/sh
# Law L7, decision D9: a daemon that is killed while it records leaves a file that replays up to a second before the kill, and
# gives exactly the map of what was handled until then (the journal beside it says what that was).
#   tests/e2e_recorded_killed.sh [ROUNDS]     default 10; `make soak` plays 200
. "$(dirname "$0")/lib.sh"
set -u
rounds=${1:-10}

cat >"$scratch/play.py" <<'PYTHON'
import collections, json, os, random, signal, subprocess, sys, threading, time

sys.path.insert(0, "tests")
sys.dont_write_bytecode = True
import kept_list

build, out, rounds = sys.argv[1], sys.argv[2], int(sys.argv[3])
choose = random.Random(7)
LOST_S = 1.0  # of what the daemon had handled: while a loaded machine lets it wait there is nothing to record
LOOK_S, NAP_S = 2.0, 0.01
late = collections.deque()  # (when, by how much): naps of a hundredth of a second that took longer, s


def nap_on():
    while True:
        begin = time.monotonic()
        time.sleep(NAP_S)
        end = time.monotonic()
        late.append((end, max(0.0, end - begin - NAP_S - 0.001)))
        while late[0][0] < end - LOOK_S:
            late.popleft()


def stood_s():
    """For how long the machine kept somebody waiting who does next to nothing, in the last two seconds: so it did the recorder's thread."""
    return sum(s for _, s in list(late))



def info(path):
    run = subprocess.run([f"{build}/facet", "info", "--json", path], capture_output=True, text=True, timeout=300, check=False)
    assert run.returncode == 0, f"facet info: {run.stderr}"
    return json.loads(run.stdout)


def replay(path, *options):
    stats = f"{out}/stats.json"
    run = subprocess.run([f"{build}/facet", "replay", path, "-o", f"{out}/map.ply", "--stats", stats, *options], capture_output=True, text=True, timeout=600, check=False)
    assert run.returncode == 0, f"facet replay {path}: {run.stderr}"
    return json.load(open(stats, encoding="ascii"))


threading.Thread(target=nap_on, daemon=True).start()
lost_most, waited_most, rows, compared = 0.0, 0.0, 0, 0
for number in range(rounds):
    folder, journal = f"{out}/rec{number}", f"{out}/journal"
    config = f"{out}/facetd.yaml"
    text = open(f"{out}/sim/facetd.yaml", encoding="ascii").read()
    open(config, "w", encoding="ascii").write(text + f"record: {{dir: {folder}}}\n")
    daemon = subprocess.Popen([f"{build}/facetd", "--config", config, "--journal", journal], stderr=subprocess.PIPE, text=True)
    limit = time.monotonic() + 120
    while not (os.path.isdir(folder) and os.listdir(folder)):
        assert daemon.poll() is None and time.monotonic() < limit, "no recording begins"
        time.sleep(0.02)
    time.sleep(choose.uniform(0.3, 3.5))
    daemon.send_signal(signal.SIGKILL)
    stood, killed_ns = stood_s(), time.time_ns()  # log time is the wall clock's, as long as nobody sets that
    daemon.wait()
    files = [f"{folder}/{name}" for name in sorted(os.listdir(folder))]
    assert len(files) == 1, files
    told = info(files[0])
    kept = open(journal, "rb").read()
    lost = (killed_ns - told["end_ns"]) / 1e9
    waited = (killed_ns - max(killed_ns - int(lost * 1e9), kept_list.last_ns(kept))) / 1e9
    lost_most, waited_most = max(lost_most, lost), max(waited_most, waited)
    assert lost - waited <= LOST_S + stood, \
        f"round {number}: {lost:.3f} s are lost, in {waited:.3f} s of which nothing was handled; the machine stood for {stood:.3f} s"
    assert not told["ended"] and told["damaged_bytes"] >= 0
    first = replay(files[0])
    rows += first["rows"]
    # What was recorded gives the map of the same stretch of the journal; that is buffered, so it may be the shorter one.
    begun = kept_list.first(kept, told["records"] + told["ticks"])
    if begun:
        open(f"{out}/cut", "wb").write(begun)
        second = replay(f"{out}/cut", "--config", config)
        assert first["rows"] == second["rows"] and first["hash"] == second["hash"], f"round {number}: another map: {first['rows']} rows, not {second['rows']}"
        compared += 1
    subprocess.run([f"{build}/facet", "repair", files[0], "-o", f"{out}/good.mcap"], check=True, stdout=subprocess.DEVNULL, timeout=300)
    good = info(f"{out}/good.mcap")
    assert good["whole"] and good["statistics_agree"] and good["records"] == told["records"], "the repaired file"
    os.remove(files[0])
print(f"note: {rounds} kills, at most {lost_most:.2f} s lost (the daemon waited for the machine {waited_most:.2f} s at most), {rows} rows replayed, {compared} maps compared with the journal's")
PYTHON

mkdir "$scratch/sim"
"$facet" simulate building --endless --dir "$scratch/sim" >"$scratch/simulate.log" 2>&1 &
until_true 30 test -s "$scratch/sim/facetd.yaml" || give_up "the simulator does not come up"
python3 "$scratch/play.py" "$build" "$scratch" "$rounds"
