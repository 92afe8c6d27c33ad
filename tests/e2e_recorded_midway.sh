#!/bin/sh
# Law L7: rows dropped by load, a recording begun in mid-drive, and one that the daemon leaves behind. A queue of one row drops rows
# on any machine; the drive's own recording and its journal leave out the same ones. What `facet record` and `?RECORD` take from the
# midst gives the map of the rows from then on, as feeding the whole list without the rows before gives it.
. "$(dirname "$0")/lib.sh"
address=unix:$scratch/sim/facetd.sock

until_holds() { # EXPRESSION
    until_true 120 holds "$1" || give_up "never was: $1"
}

stands() { # no row is taken any more, and none is being worked on
    say '?PAUSE' >/dev/null
    until_holds "s['queue']['idle']"
}

begin() { # OPTION...: a daemon on the simulated devices
    rm -f "$scratch/sim/facetd.sock"
    "$facetd" --config "$scratch/facetd.yaml" "$@" 2>"$scratch/daemon.log" &
    daemon=$!
    until_holds "s['step'] > 10"
}

took() { # FILE: `facet record` takes something
    [ -s "$1" ] && [ "$(wc -c <"$1")" -gt 20000 ]
}

mkdir "$scratch/sim"
"$facet" simulate building --endless --laser lms1xx --dir "$scratch/sim" >"$scratch/simulate.log" 2>&1 &
until_true 30 test -s "$scratch/sim/facetd.yaml" || give_up "the simulator does not come up"
{ sed '/^record:/d' "$scratch/sim/facetd.yaml"; echo "record: {dir: $scratch/rec}"; } >"$scratch/facetd.yaml"

# Rows dropped by load: what the clients hold is what recording and journal give.
begin --queue 1 --journal "$scratch/journal"
until_holds "s['step'] > 60 and s['rows']['dropped']['queue full'] > 20"
"$facet" record "$address" -o "$scratch/taken.mcap" >"$scratch/taken" 2>&1 &
taker=$!
until_true 60 took "$scratch/taken.mcap" || give_up "facet record takes nothing: $(cat "$scratch/taken")"
before=$(status "s['rows']['dropped']['queue full']")
step=$(status "s['step']")
until_holds "s['step'] > $step + 60 and s['rows']['dropped']['queue full'] > $before + 10"
stands
"$facet" save "$address" -o "$scratch/live.ply" >/dev/null || fail "the live map was not saved"
full=$(status "s['rows']['dropped']['queue full']")
kill -INT $taker
wait $taker || fail "facet record ended with $?: $(cat "$scratch/taken")"
say '?RECORD={"enable":false}' | grep -q RECORD || fail "the recording does not end"
whole=$(ls "$scratch"/rec/*.mcap)
hash=$(hash_of "$whole")
cmp -s "$scratch/out.ply" "$scratch/live.ply" || fail "its recording gives another map than the drive"
refused=$(sed -n 's/.* rows, \([0-9]*\) not applied.*/\1/p' "$scratch/told")
[ "${refused:-0}" -ge "$full" ] || fail "$full rows found the queue full, ${refused:-none} are left out"

# ?RECORD in mid-drive, and the daemon's end while `facet record` runs: both files are ended in order, which is said once.
say '?RECORD={"enable":true}' | grep -q RECORD || fail "no recording begins"
say '?RESUME' >/dev/null
"$facet" record "$address" -o "$scratch/left.mcap" >"$scratch/left" 2>&1 &
taker=$!
until_true 60 took "$scratch/left.mcap" || give_up "facet record takes nothing: $(cat "$scratch/left")"
step=$(status "s['step']")
until_holds "s['step'] > $step + 60"
ends $daemon || fail "the daemon ended with $?"
wait $taker
code=$?
[ $code -eq 1 ] || fail "facet record ends with $code when the daemon does"
grep -q '^facet: .*left.mcap: the recording ended: .*; the file is whole up to there$' "$scratch/left" && [ "$(grep -c '^facet' "$scratch/left")" -eq 1 ] ||
    fail "facet record says: $(cat "$scratch/left")"
for file in "$whole" "$scratch/taken.mcap" "$scratch/left.mcap" "$scratch"/rec/*.mcap; do
    "$facet" info --json "$file" >"$scratch/told.json"
    python3 -c 'import json, sys; j = json.load(open(sys.argv[1])); sys.exit(not (j["whole"] and j["ended"] and j["statistics_agree"]))' \
        "$scratch/told.json" || fail "$file has no footer: $("$facet" info "$file")"
done
"$facet" info --json "$whole" >"$scratch/told.json"
python3 tests/kept_list.py --ended first "$scratch/journal" "$scratch/told.json" "$scratch/first" || fail "the recording holds more than the list"
same=$(hash_of --config "$scratch/facetd.yaml" "$scratch/first")
[ -n "$hash" ] && [ "$same" = "$hash" ] || fail "the recording gives $hash, the journal $same"
echo "note: $full rows found the queue full: drive, recording and journal give $(echo "$hash" | cut -c1-16)"
replays_midway "facet record in mid-drive" "$scratch/taken.mcap" "$scratch/journal" "$scratch/facetd.yaml"
for second in "$scratch"/rec/*.mcap; do :; done
[ "$second" != "$whole" ] || fail "?RECORD began no second file"
replays_midway "?RECORD in mid-drive" "$second" "$scratch/journal" "$scratch/facetd.yaml"
replays_midway "facet record when the daemon ended" "$scratch/left.mcap" "$scratch/journal" "$scratch/facetd.yaml"

# The daemon is killed while `facet record` runs: said once, and what came can be made whole.
begin --journal "$scratch/killed"
"$facet" record "$address" -o "$scratch/cut.mcap" >"$scratch/cut" 2>&1 &
taker=$!
until_true 60 took "$scratch/cut.mcap" || give_up "facet record takes nothing: $(cat "$scratch/cut")"
sleep 2
kill -KILL $daemon
wait $taker
code=$?
wait $daemon 2>/dev/null
[ $code -eq 1 ] || fail "facet record ends with $code when the daemon is killed"
grep -q '^facet: .*cut.mcap: the daemon ended; the file holds what came until then' "$scratch/cut" && [ "$(wc -l <"$scratch/cut")" -eq 1 ] ||
    fail "facet record says: $(cat "$scratch/cut")"
"$facet" repair "$scratch/cut.mcap" -o "$scratch/good.mcap" >/dev/null || fail "facet repair"
"$facet" info --json "$scratch/good.mcap" >"$scratch/told.json"
python3 -c 'import json, sys; j = json.load(open(sys.argv[1])); sys.exit(not (j["whole"] and j["statistics_agree"] and j["records"] > 20))' \
    "$scratch/told.json" || fail "what was repaired: $("$facet" info "$scratch/good.mcap")"
cut=$(hash_of "$scratch/cut.mcap")
good=$(hash_of "$scratch/good.mcap")
[ -n "$cut" ] && [ "$cut" = "$good" ] || fail "cut: $cut, repaired: $good"
exit $failed
