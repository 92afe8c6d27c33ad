# What the tests in shell begin with:  . "$(dirname "$0")/lib.sh"
# A test then stands at the top of the tree, apart from any daemon of its user's, and has
#   $build $facet $facetd   what is tested, as absolute paths
#   $scratch                a folder that goes with the test, and so does every process that it started in the background
#   $failed                 0; 1 once something failed. `exit $failed` ends a test
# shellcheck shell=sh disable=SC2034,SC2154
cd "$(dirname "$0")/.." || exit 2
build=${FACET_BUILD:-build}
case $build in /*) ;; *) build=$PWD/$build ;; esac
facet=$build/facet facetd=$build/facetd
unset FACETD FACETD_CONFIG XDG_RUNTIME_DIR
scratch=$(mktemp -d) || exit 2
failed=0
export build facet facetd scratch

# Processes are asked to end, also those that were stopped, and get half a minute for it.
end_all() {
    jobs -p >"$scratch/jobs" # not in a subshell, which has no jobs
    pids=$(cat "$scratch/jobs")
    [ -n "$pids" ] || return 0
    # shellcheck disable=SC2086
    {
        kill $pids
        kill -CONT $pids
        (sleep 30 && exec kill -KILL $pids) &
        killer=$!
        for pid in $pids; do wait "$pid"; done
        kill $killer
        wait $killer
    } >/dev/null 2>&1
    return 0
}
trap 'set +e; end_all; chmod -R u+w "$scratch"; rm -rf "$scratch"' EXIT
trap 'exit 1' INT TERM

fail() {
    echo "FAILED: $*"
    failed=1
}

# Nothing that follows would make sense.
give_up() {
    fail "$@"
    for log in "$scratch"/*.log; do
        [ ! -s "$log" ] || { echo "--- ${log##*/}"; tail -n 40 "$log"; }
    done
    exit 1
}

skip() { # WHY
    echo "$*"
    exit 77
}

# How many times as long as is said here is waited for what is sure to come: the machine may be slow, or busy with others.
patience=5

until_true() { # SECONDS COMMAND...: tried five times a second, unheard
    last=$(($(date +%s) + $1 * patience))
    shift
    until "$@" >/dev/null 2>&1; do
        [ "$(date +%s)" -le $last ] || return 1
        sleep 0.2
    done
}

ends() { # PROCESS: is asked to, and has; its status
    kill "$1" 2>/dev/null
    wait "$1" 2>/dev/null
}

# The daemon at $address, unix:PATH.
say() { # COMMAND: its answer, one line of JSON
    python3 - "${address#unix:}" "$1" <<'PYTHON'
import json, socket, sys
s = socket.socket(socket.AF_UNIX)
s.settimeout(120)
s.connect(sys.argv[1])
s.sendall(sys.argv[2].encode() + b"\n")
for line in s.makefile():
    if json.loads(line)["class"] != "VERSION":
        print(line, end="")
        break
PYTHON
}

status() { # EXPRESSION over its status s and devices d by name: the value; 1 where that is false, or there is none
    timeout 120 "$facet" watch --once --json "$address" 2>/dev/null | python3 -c '
import json, sys
line = sys.stdin.readline()
if not line: sys.exit(1)
s = json.loads(line)
d = {device["name"]: device for device in s["devices"]}
value = eval(sys.argv[1])
print(value)
sys.exit(value is False)' "$1" 2>/dev/null
}

holds() { # EXPRESSION
    status "$1" >/dev/null
}

hash_of() { # ARGUMENT... of facet replay: of the map, which is in $scratch/out.ply; what was said is in $scratch/told
    "$facet" replay -o "$scratch/out.ply" "$@" >"$scratch/told" 2>"$scratch/err" || { cat "$scratch/err"; echo none; }
    sed -n 's/^hash //p' "$scratch/told"
}

# A recording from the midst of a drive gives the map of the rows from then on: of the drive's whole list (which a daemon that ended in
# order has kept) without the rows before it, fed by another program.
replays_midway() { # TITLE RECORDING JOURNAL CONFIG [BEFORE ROWS]: more than so many before it (10), so many in it at least (1)
    "$facet" info --json "$2" >"$scratch/told.json" || { fail "$1: facet info"; return; }
    python3 tests/kept_list.py --ended before "$3" "$scratch/told.json" "$scratch/before" || { fail "$1: it begins at no tick"; return; }
    hash_of --config "$4" "$scratch/before" >/dev/null
    rows=$(awk '/ not applied, map/ { print $4 + $6 }' "$scratch/told")
    python3 tests/kept_list.py --ended from "$3" "$scratch/told.json" "$scratch/from" "$rows" || { fail "$1: it holds more than the list"; return; }
    wanted=$("$build/tests/steps" "$4" "$scratch/from" "$scratch/from.ply")
    got=$(hash_of "$2")
    [ "$got" = "${wanted%% *}" ] || fail "$1: $got, not $wanted"
    cmp -s "$scratch/out.ply" "$scratch/from.ply" || fail "$1: another mesh"
    taken=$(awk '/ not applied, map/ { print $4 }' "$scratch/told")
    [ "$rows" -gt "${5:-10}" ] && [ "$taken" -ge "${6:-1}" ] || fail "$1: $rows rows before it and $taken in it are too few"
    echo "note: $1: $taken rows after $rows others"
}
