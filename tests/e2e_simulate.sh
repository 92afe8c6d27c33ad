#!/bin/sh
# Laws L8, L9: `facet simulate` as its users meet it: devices for anybody, one sentence for what is wrong, and when it
# ends nothing of what it started is left, whoever ended it.
set -u
build=${FACET_BUILD:-build}
facet=$build/facet
out=$(mktemp -d)
trap 'rm -rf "$out"' EXIT
failures=0
unset FACETD FACETD_CONFIG

fail() {
    echo "FAILED: $*"
    failures=$((failures + 1))
}

# refused STATUS WORDS ARGUMENTS...: ends with STATUS and says WORDS on stderr, whose first line names the program
refused() {
    status=$1 words=$2
    shift 2
    timeout 30 "$facet" simulate "$@" >"$out/stdout" 2>"$out/stderr"
    [ $? -eq "$status" ] || fail "simulate $*: status is not $status"
    grep -q -- "$words" "$out/stderr" || fail "simulate $*: does not say '$words' but: $(head -n 2 "$out/stderr")"
    head -n 1 "$out/stderr" | grep -q '^facet' || fail "simulate $*: the sentence does not name the program"
}

gone() { # no process has this text in its command line
    for i in 1 2 3 4 5 6 7 8 9 10; do
        pgrep -f "$1" >/dev/null || return 0
        sleep 0.2
    done
    return 1
}

# Usage
timeout 30 "$facet" simulate --help | grep -q 'profiles:FILE.csv' || fail "--help does not say how sweeps are played"
refused 2 'which scenario'
refused 2 'one word too many' hall kitchen
refused 2 '--fault: not yet' hall --fault noise
refused 2 '--http: not yet' hall --http 127.0.0.1:1
refused 2 'world moves continuously' hall --speed 2
refused 2 'world moves continuously' building --speed max
refused 2 'neither max nor a number' hall --speed fast
refused 2 'neither rtu nor tcp' hall --servo can
refused 2 'whole number' hall --seed -3
refused 2 'oopback' hall --tcp 0.0.0.0:7878
refused 2 'which COMMAND' hall --
refused 1 'there are building and hall' castle
refused 1 'No such file' uos:/nowhere
refused 1 'No such file' profiles:/nowhere.csv
refused 1 'too long' hall --dir "$out/$(printf '%0110d' 0)"
refused 1 'give a --dir' hall --dir /proc/nowhere
echo '0,1000,1001' >"$out/lonely.csv"
refused 1 'pose beside it' "profiles:$out/lonely.csv"
printf '0,1000,1001\n1,1000,x\n' >"$out/bad.csv"
refused 1 'bad.csv: line 2' "profiles:$out/bad.csv"

# COMMAND: its environment, its status, its devices, a fresh directory that goes with it
timeout 30 "$facet" simulate hall -- sh -c 'echo "$FACETD|$FACETD_CONFIG"; ls -l "$(dirname "$FACETD_CONFIG")"; exit 7' >"$out/env"
[ $? -eq 7 ] || fail "COMMAND's status is not handed on"
config=$(sed -n 's/^unix:.*|//p' "$out/env")
grep -q "^address unix:${config%/*}/facetd.sock" "$out/env" || fail "the address is not said"
grep -q 'laser -> /dev/pts' "$out/env" && grep -q 'servo -> /dev/pts' "$out/env" || fail "the devices are not in the directory"
[ -n "$config" ] && [ ! -e "${config%/*}" ] || fail "a fresh directory was left"
timeout 30 "$facet" simulate hall -- /nowhere/program 2>"$out/stderr"
[ $? -eq 127 ] || fail "a COMMAND that is not there: status is not 127"
grep -q '/nowhere/program: No such file' "$out/stderr" || fail "a COMMAND that is not there is not named"

# A directory that was given stays, its links go; the configuration is one that the daemon takes
timeout 30 "$facet" simulate building --dir "$out/given" --servo tcp --tcp 127.0.0.1:7999 -- \
    sh -c "$build/facetd --check-config"' --config "$FACETD_CONFIG"' >"$out/check" 2>&1 || fail "facetd refuses the configuration: $(cat "$out/check")"
[ -e "$out/given/facetd.yaml" ] && [ ! -e "$out/given/laser" ] && [ ! -e "$out/given/servo" ] || fail "given directory: $(ls "$out/given")"
grep -q 'tcp:127.0.0.1:7999' "$out/given/facetd.yaml" || fail "--tcp is not in the configuration"

# Nothing outlives it: what COMMAND left behind, what ignores SIGTERM, and when it is itself ended
timeout 40 "$facet" simulate hall -- sh -c 'sleep 7771 & sleep 0.3'
gone 'sleep 7771' || fail "an orphan of COMMAND outlived it"
timeout 60 "$facet" simulate hall --dir "$out/stopped" -- sh -c 'trap "" TERM; while :; do sleep 0.1; done # deaf-7772' &
simulate=$!
for i in $(seq 100); do [ -e "$out/stopped/facetd.yaml" ] && pgrep -f deaf-7772 >/dev/null && break; sleep 0.1; done
kill -TERM "$(pgrep -f "simulate hall --dir $out/stopped" | tail -n 1)"
wait $simulate
[ $? -eq 143 ] || fail "ended by SIGTERM: status is not 143"
gone deaf-7772 || fail "a COMMAND that ignores SIGTERM outlived it"
[ ! -e "$out/stopped/servo" ] || fail "a link was left after SIGTERM"

# The real thing, short: the hall through facetd into a mesh
cat >"$out/map.sh" <<MAP
"$build/facetd" 2>"$out/facetd.log" & daemon=\$!
for i in \$(seq 60); do
    sleep 1
    "$facet" save -o "$out/hall.ply" >"$out/save.log" 2>&1 && [ "\$(sed -n 's/.*step \([0-9]*\),.*/\1/p' "$out/save.log")" -gt 150 ] && break
done
kill -TERM \$daemon
wait \$daemon
MAP
timeout 120 "$facet" simulate hall -- sh "$out/map.sh" >/dev/null || fail "facetd did not end well: $(tail -n 3 "$out/facetd.log")"
faces=$(sed -n 's/.*, \([0-9]*\) faces.*/\1/p' "$out/save.log")
[ "${faces:-0}" -gt 2000 ] || fail "the hall has no mesh: $(cat "$out/save.log" "$out/facetd.log")"
echo "note: the hall after a few seconds: $(sed 's/^[^:]*: //' "$out/save.log")"

[ "$failures" -eq 0 ] && echo "all well"
exit $((failures > 0))
