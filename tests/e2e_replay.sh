#!/bin/sh
# Laws L7, L2: a drive, live and replayed in every way there is, is one map: kept journal and recording, all files of a rotation in
# any order, any batches, threads and speeds, another compiler without optimisation, through facet and through facetd, after
# seeking there and back, at its own pace, half and a tenth of it, and taken apart into what people have (captures, a candump log, a
# list of poses). A CARMEN log and a folder of scans give what is in them.
. "$(dirname "$0")/lib.sh"
address=unix:$scratch/sim/facetd.sock

until_holds() { # EXPRESSION
    until_true 120 holds "$1" || give_up "never was: $1"
}

same() { # TITLE ARGUMENT...
    title=$1
    shift
    got=$(hash_of "$@")
    [ "$got" = "$wanted" ] || fail "$title: $got, not $wanted"
}

# Live: a map, a reset in full flight, another map with rows refused in between; recorded in files of 3 s and as journals.
cat >"$scratch/live" <<LIVE
sed '/^record:/d' "$scratch/sim/facetd.yaml" >"$scratch/live.yaml"
echo "record: {dir: $scratch/recorded, max_age: 3s}" >>"$scratch/live.yaml"
exec "$facetd" --config "$scratch/live.yaml" --journal "$scratch/journal"
LIVE
mkdir "$scratch/recorded"
"$facet" simulate building --endless --laser tim --servo can --dir "$scratch/sim" -- sh "$scratch/live" >"$scratch/live.log" 2>&1 &
daemon=$!
until_holds "s['step'] > 15"
say '?RESET' >/dev/null
until_holds "s['generation'] > 1 and s['step'] > 15"
say '?PAUSE' >/dev/null
sleep 1
say '?RESUME' >/dev/null
until_holds "s['generation'] > 1 and s['step'] > 60"
say '?PAUSE' >/dev/null
until_holds "s['queue']['idle']"
"$facet" save "$address" -o "$scratch/live.ply" >/dev/null || fail "the live map was not saved"
kill "$daemon"
wait "$daemon" 2>/dev/null
[ "$failed" -eq 0 ] || { cat "$scratch/live.log"; exit 1; }

wanted=$(hash_of --config "$scratch/live.yaml" "$scratch/journal.2")
cmp -s "$scratch/out.ply" "$scratch/live.ply" || fail "the journal's map is not the one that the live daemon's client held"
grep -q ' [1-9][0-9]* not applied' "$scratch/told" || fail "no row was refused: $(cat "$scratch/told")"
echo "note: live: $(head -1 "$scratch/told" | sed 's/.*: //')"

set -- "$scratch"/recorded/*.mcap
[ $# -ge 2 ] || fail "the recording was not rotated: $*"
same "its recording, $# files" "$@"
same "the folder of the recording" "$scratch/recorded"
backwards=
for file; do backwards="$file $backwards"; done
# shellcheck disable=SC2086
same "the files in another order" $backwards
same "both journals" --config "$scratch/live.yaml" "$scratch/journal" "$scratch/journal.2"
same "a batch per row" --batch row "$@"
same "a batch a second, two threads" --batch second --threads 2 "$@"
same "20 times as fast" --speed 20 "$@"
# A file alone begins in mid-drive with its snapshot and an empty map; the same one each time, whatever the pace.
alone=$(ls -S "$@" | head -n 1)
wanted=$(hash_of "$alone")
cp "$scratch/out.ply" "$scratch/alone.ply"
[ -n "$wanted" ] && [ "$wanted" != none ] || fail "a file alone"
same "a file alone, once more" --batch row "$alone"
for file; do
    [ "$(hash_of "$file")" != none ] || fail "$file alone"
done
for speed in 0.5 1; do # these take their time, so they have it from here on
    sed "s|$scratch/sim/facetd.sock|$scratch/pace$speed.sock|" "$scratch/live.yaml" >"$scratch/pace$speed.yaml"
    "$facetd" --config "$scratch/pace$speed.yaml" --speed $speed --replay "$alone" >"$scratch/pace$speed.log" 2>&1 &
    eval "pace_${speed#*.}=$!"
done
wanted=$(hash_of "$@")

if command -v clang >/dev/null; then
    make -s -j2 config=debug CC=clang B="$scratch/clang" "$scratch/clang/facet" >"$scratch/err" 2>&1
    if [ -x "$scratch/clang/facet" ]; then
        facet=$scratch/clang/facet
        same "clang -O0" "$@"
        same "clang -O0, two threads, a batch per row" --threads 2 --batch row "$@"
        facet=$build/facet
    else
        fail "clang -O0 does not build: $(head -3 "$scratch/err")"
    fi
else
    echo "note: another compiler was NOT tried (clang is not here)"
fi

# Through the daemon: at two speeds, then back to the middle and forward to the end again.
replayed() { # TITLE
    "$facet" save "$address" -o "$scratch/replayed.ply" >/dev/null || fail "$1: not saved"
    cmp -s "$scratch/replayed.ply" "$scratch/live.ply" || fail "$1: another map"
}
mkdir -p "$scratch/sim"
for speed in max 30; do
    "$facetd" --config "$scratch/live.yaml" --speed $speed --replay "$@" >"$scratch/replay.log" 2>&1 &
    daemon=$!
    until_holds "s['replay']['state'] == 'ended'"
    replayed "facetd --replay --speed $speed"
    if [ $speed = max ]; then
        middle=$(status "(s['replay']['begin'] + s['replay']['end']) / 2")
        generation=$(status "s['generation']")
        say '?PAUSE' >/dev/null
        say "?SEEK={\"t\": $middle}" >/dev/null
        until_holds "s['replay']['state'] == 'paused'"
        [ "$(status "s['generation'] > $generation")" = True ] || fail "seeking back is no new generation"
        say "?SEEK={\"t\": 1}" | grep -q ERROR || fail "a seek out of the recording was not refused"
        say '?RESUME' >/dev/null
        until_holds "s['replay']['state'] == 'ended'"
        replayed "there and back"
    fi
    kill "$daemon"
    wait "$daemon" || fail "the daemon ended badly: $(tail -3 "$scratch/replay.log")"
done

# At a tenth: it is slow indeed, stands while it is paused, is sought in both ways and ends at once when it is told to.
paced() { # SPEED PROCESS: at its end
    until_holds "s['replay']['state'] == 'ended'"
    "$facet" save "$address" -o "$scratch/paced.ply" >/dev/null || fail "--speed $1: not saved"
    cmp -s "$scratch/paced.ply" "$scratch/alone.ply" || fail "--speed $1: another map"
    ends "$2" || fail "--speed $1: the daemon ended badly: $(tail -3 "$scratch/pace$1.log")"
}

seek() { # WHAT, e.g. "t": 17
    say "?SEEK={$1}" | grep -q '"OK"' || fail "?SEEK={$1} was refused"
}

place() { # SHARE of the recording
    status "s['replay']['begin'] + $1 * (s['replay']['end'] - s['replay']['begin'])"
}

# shellcheck disable=SC2154
{
    address=unix:$scratch/pace0.5.sock
    paced 0.5 "$pace_5"
    address=unix:$scratch/pace1.sock
    seek "\"t\": $(place 0.3)"
    until_holds "s['replay']['state'] in ('playing', 'ended')"
    seek "\"t\": $(place 0.7)"
    paced 1 "$pace_1"
}
sed "s|$scratch/sim/facetd.sock|$scratch/slow.sock|" "$scratch/live.yaml" >"$scratch/pace0.1.yaml"
address=unix:$scratch/slow.sock
began=$(date +%s.%N)
"$facetd" --config "$scratch/pace0.1.yaml" --speed 0.1 --replay "$alone" >"$scratch/pace0.1.log" 2>&1 &
slow=$!
until_holds "s['replay']['state'] == 'playing' and s['replay']['position'] > s['replay']['begin']"
ran=$(status "s['replay']['position'] - s['replay']['begin']")
awk -v ran="$ran" -v began="$began" -v now="$(date +%s.%N)" 'BEGIN { exit !(ran <= 0.1 * (now - began) + 0.02) }' || fail "--speed 0.1: $ran s are played already"
say '?PAUSE' >/dev/null
until_holds "s['replay']['state'] == 'paused'"
stood=$(status "s['replay']['position']")
sleep 0.5
[ "$(status "s['replay']['position']")" = "$stood" ] || fail "--speed 0.1: it goes on while it is paused"
seek "\"t\": $(place 0.6)"
seek "\"t\": $(place 0.2)"
say '?RESUME' >/dev/null
until_holds "s['replay']['state'] == 'playing'"
seek '"speed": "max"'
paced 0.1 $slow

# In parts: the list before the reset, and what can be made of it. When the loop read a frame, a candump log does not tell: the
# list is put into the order of the parts, and rows wait long enough for all orders to be the same to them.
(cat "$scratch/live.yaml" && echo 'map: {hold: 1s}') >"$scratch/held.yaml"
scanner=$(sed -n 's/.*driver: tim, connect: "\([^"]*\)".*/\1/p' "$scratch/live.yaml")
python3 tests/journal_parts.py "$scratch/journal" "$scratch/part" 0 1 2 "$scanner" || fail "the journal was not taken apart"
wanted=$(hash_of --config "$scratch/held.yaml" "$scratch/part.ended")
same "a capture, a candump log and poses" --config "$scratch/held.yaml" "$scratch/part.pcap" "$scratch/part.log" "$scratch/part.jsonl"
same "the capture as pcapng" --config "$scratch/held.yaml" "$scratch/part.pcapng" "$scratch/part.log" "$scratch/part.jsonl"
same "these in another order" --config "$scratch/held.yaml" "$scratch/part.jsonl" "$scratch/part.pcap" "$scratch/part.log"

# Refusals name the file and what to do.
refused() { # WORDS ARGUMENT...
    words=$1
    shift
    "$facet" replay -o "$scratch/out.ply" "$@" >"$scratch/out" 2>"$scratch/err" && fail "$*: was taken"
    grep -q "$words" "$scratch/err" || fail "$*: '$(cat "$scratch/err")' does not say '$words'"
}
echo hello >"$scratch/hello"
refused 'is no recording' "$scratch/hello"
refused 'give it with --config' "$scratch/part.log"
head -c 1100000 /dev/zero | tr '\0' '#' >"$scratch/large.yaml"
refused 'more than 1 MB' --config "$scratch/large.yaml" "$scratch/part.log"
refused 'cannot be replayed together' --config "$scratch/live.yaml" "$scratch/part.log" "$scratch/journal"
sed 's/connect: unix:[^,}]*/connect: can7/' "$scratch/live.yaml" | sed 's/connect: "unix:[^"]*"/connect: can7/' >"$scratch/other.yaml"
refused 'no device of the configuration is on can0' --config "$scratch/other.yaml" "$scratch/part.log"
refused 'cannot be read' "$scratch/nothing"

# A CARMEN log with a tilt channel is the room that it was made of.
printf 'map: {hold: 1s}\ndevices:\n  - {name: laser, driver: carmen, tilt: laser}\n  - {name: pose, driver: pose, listen: "unix:/nowhere"}\n' >"$scratch/room.yaml"
python3 tests/carmen_room.py write "$scratch/room.log"
[ "$(hash_of --config "$scratch/room.yaml" --ascii "$scratch/room.log")" != none ] || fail "a CARMEN log is not replayed"
python3 tests/carmen_room.py judge "$scratch/out.ply" || fail "a CARMEN log is not the room that it was made of"

if [ -d ../shared/data/kurt3d ]; then
    "$facet" reconstruct -o "$scratch/k.ply" ../shared/data/kurt3d/scan00?.3d >/dev/null
    hash_of ../shared/data/kurt3d >/dev/null
    cmp -s "$scratch/k.ply" "$scratch/out.ply" || fail "a folder of scans replayed is not what reconstruct makes of it"
else
    echo "note: scans were NOT tried (../shared/data/kurt3d is not here)"
fi
exit $failed
