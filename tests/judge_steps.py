"""Judges every mesh that a client held in tests/e2e_clients.sh against the raw mesh of its step, made from the kept list.

    python3 tests/judge_steps.py BUILD DIR
"""
import concurrent.futures
import glob
import json
import os
import subprocess
import sys

from judge import SOUND, ask, broken

CELL_M = 0.05
BUFFER_BYTES = 16384
BUFFERS = 15 # the stall lasts for twenty of them (tests/clients.c); what its sockets swallow first, the server counts as sent


def raw_meshes(build, out, steps):
    subprocess.run([f"{build}/tests/steps", f"{out}/config.yaml", f"{out}/journal", f"{out}/held", *map(str, steps)],
                   check=True, stdout=subprocess.DEVNULL)


def judged(out, step):
    mesh, raw = f"{out}/held/{step}.ply", f"{out}/held/{step}.raw.ply"
    with open(raw, "rb") as f:
        head = f.read(2000).split(b"end_header")[0].decode("ascii")
    faces_raw = int(head.split("element face ")[1].split()[0])
    if not faces_raw:
        return step, 0, []
    answer = ask([mesh, "--ref", raw, "--tol", "0.03", "--samples", "20000"])
    claims = [*SOUND, "new_open_m==0"]
    if not answer["faces"]: # a speck may go, a surface may not
        claims = [] if faces_raw < 50 else ["faces>=1"]
    else:
        claims += [f"{way}.max<={CELL_M}" for way in ("to_ref", "from_ref")]
        if faces_raw >= 10000:
            claims += [f"{way}.p99<={CELL_M / 4}" for way in ("to_ref", "from_ref")]
    return step, faces_raw, broken(answer, claims)


def stalled_enough(status):
    """The server's own counters, from within the stall: what the clients that had stopped reading missed meanwhile."""
    native = [c for c in status["clients"] if c["kind"] == "native"]
    most = max(c["bytes"] for c in native)
    behind = [most - c["bytes"] for c in native if c["behind"] > 0 and most - c["bytes"] >= BUFFERS * BUFFER_BYTES]
    print(f"note: in the stall the server counts {len(behind)} clients behind by {behind} bytes, buffers are {BUFFER_BYTES}")
    return len(behind) >= 2


def main():
    build, out = sys.argv[1:3]
    steps = sorted(int(os.path.basename(f)[:-4]) for f in glob.glob(f"{out}/held/*.ply"))
    steps = [s for s in steps if s > 0]
    raw_meshes(build, out, steps)
    wrong = 0
    with concurrent.futures.ThreadPoolExecutor(2) as pool:
        results = list(pool.map(lambda s: judged(out, s), steps))
    for step, _, sentences in results:
        for sentence in sentences:
            print(f"step {step}: {sentence}")
            wrong += 1
    print(f"note: {len(steps)} steps held by clients, all judged; {wrong} broken claims; largest raw mesh {max(r[1] for r in results)} faces")
    with open(f"{out}/held/status.json", encoding="utf-8") as f:
        status = next(o for o in map(json.loads, f) if o["class"] == "STATUS")
    if not stalled_enough(status):
        print(f"the stalled clients were not behind enough: {status['clients']}")
        wrong += 1
    if len(steps) < 50 or max(r[1] for r in results) < 10000:
        print("too few or too small meshes to show anything")
        wrong += 1
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
