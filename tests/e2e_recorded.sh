#!/bin/sh
# Claim: recordings are MCAP for others too: @mcap/core's readers, CRCs checked, find in files of a rotation, in one taken by
# `facet record` and in a repaired one what `facet info` says. And: files of a rotation, in a row, give the map of the journal.
set -u
build=${FACET_BUILD:-build}
tests=$(dirname "$0")
unset FACETD FACETD_CONFIG
out=$(mktemp -d)
simulator= daemon=
trap 'kill $daemon $simulator 2>/dev/null; wait 2>/dev/null; rm -rf "$out"' EXIT
trap 'exit 1' INT TERM
failed=0

fail() {
    echo "FAILED: $*"
    failed=1
}

until_true() { # SECONDS COMMAND...
    last=$(($(date +%s) + $1))
    shift
    until "$@" 2>/dev/null; do
        [ "$(date +%s)" -le $last ] || return 1
        sleep 0.1
    done
}

files() { # how many recordings there are at least
    [ "$(ls "$out/rec" 2>/dev/null | wc -l)" -ge "$1" ]
}

mkdir "$out/sim"
"$build/facet" simulate building --endless --dir "$out/sim" >"$out/simulate.log" 2>&1 &
simulator=$!
until_true 30 test -s "$out/sim/facetd.yaml" || { cat "$out/simulate.log"; exit 1; }
{ cat "$out/sim/facetd.yaml"; echo "record: {dir: $out/rec, max_age: 2s, messages: on}"; } >"$out/facetd.yaml"
"$build/facetd" --config "$out/facetd.yaml" --journal "$out/journal" >"$out/log" 2>&1 &
daemon=$!
until_true 30 files 2 || fail "no second file: $(cat "$out/log")"
timeout 60 "$build/facet" record "unix:$out/sim/facetd.sock" -o "$out/taken.mcap" -d 2 >"$out/said" 2>&1 || fail "facet record: $(cat "$out/said")"
until_true 30 files 3 || fail "no third file: $(cat "$out/log")"
kill $daemon
wait $daemon || fail "not an orderly end"
daemon=
first=$(ls "$out"/rec/*.mcap | head -n 1)
head -c "$(($(wc -c <"$first") * 2 / 3))" "$first" >"$out/cut.mcap"
"$build/facet" repair "$out/cut.mcap" -o "$out/repaired.mcap" >/dev/null || fail "facet repair"

# Files of one rotation, one after the other, are the journal.
"$build/facet" replay "$out"/rec/*.mcap -o "$out/a.ply" --stats "$out/a.json" >/dev/null || fail "the files do not replay"
"$build/facet" replay "$out/journal" --config "$out/facetd.yaml" -o "$out/b.ply" --stats "$out/b.json" >/dev/null || fail "the journal does not replay"
cmp -s "$out/a.ply" "$out/b.ply" || fail "the recording gives another map than the journal"

packages=$("$tests/npm/install" "$build") || { [ $failed -eq 0 ] || exit 1; echo "$packages"; exit 77; }
for file in "$out"/rec/*.mcap "$out/taken.mcap" "$out/repaired.mcap"; do
    "$build/facet" info --json "$file" >"$out/ours.json" || fail "facet info $file"
    node "$tests/mcap_read.mjs" "$packages" "$file" >"$out/theirs.json" 2>"$out/node.log" || fail "@mcap/core on $file: $(tail -n 5 "$out/node.log")"
    python3 - "$out/ours.json" "$out/theirs.json" "$(basename "$file")" <<'PYTHON' || failed=1
import json, sys
ours, theirs, name = json.load(open(sys.argv[1])), json.load(open(sys.argv[2])), sys.argv[3]
counts = {c["topic"]: c["messages"] for c in ours["channels"] if c["messages"]}
assert ours["whole"] and ours["statistics_agree"] and ours["messages"] > 10, ours
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
