#!/bin/sh
# Claim: recordings are MCAP for others too: @mcap/core's readers, CRCs checked, find in files of a rotation, in one taken by
# `facet record` and in a repaired one what `facet info` says. And: files of a rotation, in a row, give the map of the journal.
. "$(dirname "$0")/lib.sh"
set -u

files() { # how many recordings there are at least
    [ "$(ls "$scratch/rec" 2>/dev/null | wc -l)" -ge "$1" ]
}

mkdir "$scratch/sim"
"$facet" simulate building --endless --dir "$scratch/sim" >"$scratch/simulate.log" 2>&1 &
until_true 30 test -s "$scratch/sim/facetd.yaml" || { cat "$scratch/simulate.log"; exit 1; }
{ cat "$scratch/sim/facetd.yaml"; echo "record: {dir: $scratch/rec, max_age: 2s, messages: on}"; } >"$scratch/facetd.yaml"
address=unix:$scratch/sim/facetd.sock
"$facetd" --config "$scratch/facetd.yaml" --journal "$scratch/journal" >"$scratch/log" 2>&1 &
daemon=$!
until_true 30 files 2 || fail "no second file: $(cat "$scratch/log")"
timeout 300 "$facet" record "$address" -o "$scratch/taken.mcap" -d 2 >"$scratch/said" 2>&1 || fail "facet record: $(cat "$scratch/said")"
until_true 60 holds "s['step'] > 60" || fail "no map: $(cat "$scratch/log")"
there=$(ls "$scratch/rec" | wc -l) # two more, each with rows in it, and many before
until_true 60 holds "s['step'] > $(status "s['step']") + 10" && until_true 30 files $((there + 2)) || fail "no further files: $(cat "$scratch/log")"
kill $daemon
wait $daemon || fail "not an orderly end"
first=$(ls "$scratch"/rec/*.mcap | head -n 1)
head -c "$(($(wc -c <"$first") * 2 / 3))" "$first" >"$scratch/cut.mcap"
"$facet" repair "$scratch/cut.mcap" -o "$scratch/repaired.mcap" >/dev/null || fail "facet repair"

# Files of one rotation, one after the other, are the journal.
"$facet" replay "$scratch"/rec/*.mcap -o "$scratch/a.ply" --stats "$scratch/a.json" >/dev/null || fail "the files do not replay"
"$facet" replay "$scratch/journal" --config "$scratch/facetd.yaml" -o "$scratch/b.ply" --stats "$scratch/b.json" >/dev/null || fail "the journal does not replay"
cmp -s "$scratch/a.ply" "$scratch/b.ply" || fail "the recording gives another map than the journal"
number=1 midst=0
for file in "$scratch"/rec/*.mcap; do
    if [ $number -gt 1 ]; then
        replays_midway "file $number of the rotation alone" "$file" "$scratch/journal" "$scratch/facetd.yaml" -1 0
        [ "$rows" -gt 10 ] && [ "$taken" -ge 1 ] && midst=$((midst + 1))
    fi
    number=$((number + 1))
done
# A busy machine may have rows neither for the first seconds nor for the last.
[ $midst -ge 1 ] || fail "no file has rows in it and others before it"

packages=$(tests/npm/install "$build") || { [ $failed -eq 0 ] || exit 1; echo "$packages"; exit 77; }
for file in "$scratch"/rec/*.mcap "$scratch/taken.mcap" "$scratch/repaired.mcap"; do
    "$facet" info --json "$file" >"$scratch/ours.json" || fail "facet info $file"
    node tests/mcap_read.mjs "$packages" "$file" >"$scratch/theirs.json" 2>"$scratch/node.log" || fail "@mcap/core on $file: $(tail -n 5 "$scratch/node.log")"
    python3 - "$scratch/ours.json" "$scratch/theirs.json" "$(basename "$file")" <<'PYTHON' || failed=1
import json, sys
ours, theirs, name = json.load(open(sys.argv[1])), json.load(open(sys.argv[2])), sys.argv[3]
counts = {c["topic"]: c["messages"] for c in ours["channels"] if c["messages"]}
assert ours["whole"] and ours["statistics_agree"] and ours["messages"] > 0, ours
for reader in ("indexed", "streamed"):
    found = theirs[reader]
    assert found["messages"] == ours["messages"] and found["topics"] == counts, f"{name}, {reader}: {found['topics']}, not {counts}"
    assert found["ordered"] and int(found["first"]) == ours["begin_ns"] and int(found["end"]) == ours["end_ns"], f"{name}, {reader}: order or times"
assert theirs["streamed"]["done"], "the footer"
said = theirs["indexed"]["statistics"]
assert int(said["messages"]) == ours["messages"] and said["chunks"] == ours["chunks"], said
assert said["channels"] == len(ours["channels"]) and said["attachments"] == len(ours["attachments"]) == 1, said
assert theirs["indexed"]["attachments"][0][0] == "facetd.yaml" and theirs["indexed"]["metadata"][0][0] == "facetd", "attachment, metadata"
published = sum(c["messages"] for c in ours["channels"] if c["encoding"] == "protobuf")
assert theirs["indexed"]["decoded"] == published, "messages in Foxglove's schemas"
shown = f", {published} published, {theirs['indexed']['entities']} patches with {theirs['indexed']['triangles']} triangles at its end" if published else ""
print(f"note: {name}: {ours['messages']} messages in {ours['chunks']} chunks, the same for @mcap/core's two readers{shown}")
PYTHON
done
exit $failed
