#!/bin/sh
# Law: facet save and facet watch are honest clients: what they write is whole, what goes wrong is one sentence and a status.
cd "$(dirname "$0")/.." || exit 2
build=$PWD/${FACET_BUILD:-build}
facet=$build/facet
scratch=$(mktemp -d)
daemon=
unset FACETD XDG_RUNTIME_DIR FACETD_CONFIG
cleanup() {
    [ -n "$daemon" ] && kill "$daemon" 2>/dev/null
    wait 2>/dev/null
    rm -rf "$scratch"
}
trap cleanup EXIT
trap 'exit 1' INT TERM
failed=0

fail() {
    echo "FAILED: $*"
    failed=1
}

until_true() { # SECONDS COMMAND...: tried five times a second
    tries=$(($1 * 5))
    shift
    while ! "$@" >/dev/null 2>&1; do
        tries=$((tries - 1))
        [ $tries -gt 0 ] || return 1
        sleep 0.2
    done
}

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
refused 2 "will come later" "$facet" save ws://127.0.0.1:7880/ -o "$scratch/none.ply"
refused 1 "cannot be read" "$facet" picture "$scratch/none.ply" -o "$scratch/none.png"
for command in save watch picture; do
    "$facet" $command --help | grep -q '^Usage: facet' || fail "facet $command --help says nothing"
done

"$facet" simulate hall --dir "$scratch/run" -- "$build/facetd" >"$scratch/daemon.log" 2>&1 &
daemon=$!
until_true 30 "$facet" watch --once "$address" || { cat "$scratch/daemon.log"; fail "the daemon does not come up"; exit 1; }

# The same snapshot in every format, of a map that grows meanwhile.
"$facet" save "$address" -o "$scratch/early.ply" --wait-steps 20 --timeout 120 >"$scratch/out" || fail "no snapshot at step 20"
step=$(sed -n 's/.*: step \([0-9]*\),.*/\1/p' "$scratch/out")
[ "${step:-0}" -ge 20 ] || fail "--wait-steps 20 gave step ${step:-none}"
for ending in ply obj stl glb json; do
    FACETD=$address "$facet" save -o "$scratch/map.$ending" >/dev/null || fail "facet save -o map.$ending"
    [ -s "$scratch/map.$ending" ] || fail "map.$ending is empty"
done
"$facet" save "$address" --ascii -o "$scratch/ascii.ply" >/dev/null && grep -q '^format ascii' "$scratch/ascii.ply" || fail "--ascii"
[ "$(cat "$scratch/map.json")" = "[]" ] || fail "map.json is not the list of planes"
"$facet" picture "$scratch/map.ply" -o "$scratch/map.png" --size 160x100 || fail "no picture of the map"
ls "$scratch" | grep -q 'part' && fail "something half written is left"
refused 1 "no whole map of step 99999999" "$facet" save "$address" -o "$scratch/never.ply" --wait-steps 99999999 --timeout 0.5
[ -e "$scratch/never.ply" ] && fail "a map was written that never came"

# Watching: a table, JSON, and a line a second in a pipe that ends with its reader.
"$facet" watch --once "$address" >"$scratch/table" || fail "facet watch --once"
for word in laser servo step triangles memory latency; do
    grep -q "$word" "$scratch/table" || fail "the table does not show $word"
done
"$facet" watch --once --json "$address" | python3 -c '
import json, sys
status = json.loads(sys.stdin.readline())
assert status["class"] == "STATUS" and status["step"] > 0, status
assert {d["name"] for d in status["devices"]} >= {"laser", "servo"}, status' || fail "facet watch --json"
timeout 20 "$facet" watch "$address" | head -n 2 >"$scratch/lines"
[ "$(grep -c '^step [0-9]' "$scratch/lines")" -eq 2 ] || fail "facet watch in a pipe: $(cat "$scratch/lines")"

# A daemon that goes away is said once, and watched again when it is back.
timeout 60 "$facet" watch "$address" >"$scratch/lines" 2>"$scratch/err" &
watch=$!
until_true 20 grep -q '^step' "$scratch/lines" || fail "nothing is watched"
kill "$daemon"
wait "$daemon" 2>/dev/null
until_true 20 grep -q 'facet: ' "$scratch/err" || fail "the loss is not said"
rm -rf "$scratch/run"
mkdir "$scratch/run"
: >"$scratch/lines"
"$facet" simulate hall --dir "$scratch/run" -- "$build/facetd" >"$scratch/daemon.log" 2>&1 &
daemon=$!
until_true 40 grep -q 'step' "$scratch/lines" || fail "the daemon that came back is not watched: $(cat "$scratch/err")"
kill -INT "$watch"
wait "$watch"
exit $failed
