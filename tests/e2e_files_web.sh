#!/bin/sh
# Law: other people's readers accept what facetd serves as files, and find in it what the daemon says there is.
. "$(dirname "$0")/lib.sh"

command -v curl >/dev/null || {
    echo "curl is not installed"
    exit 77
}
tests/npm/install "$build" >"$scratch/npm" 2>&1 || {
    tail -n 1 "$scratch/npm"
    exit 77
}

begins() { # NAME: facetd on $scratch/NAME.yaml; its page is at $url
    "$facetd" --config "$scratch/$1.yaml" >"$scratch/$1.log" 2>&1 &
    until_true 30 grep -q 'listens on http' "$scratch/$1.log" || {
        echo "FAILED: $1 does not listen: $(cat "$scratch/$1.log")"
        exit 1
    }
    url=$(sed -n 's/.*listens on \(http:.*\)/\1/p' "$scratch/$1.log")
}

status() { # WORD: a number of /status.json
    curl -s "${url}status.json" | grep -o "\"$1\":[0-9]*" | head -n 1 | cut -d: -f2
}

beyond() { # WORD NUMBER
    [ "$(status "$1")" -gt "$2" ]
}

still() { # no row waits, and none is being worked on
    curl -s "${url}status.json" | grep '"idle":true'
}

# A part of the demo building, then no more rows.
"$facet" simulate building --endless --dir "$scratch/robot" -- sleep 3000 >/dev/null 2>&1 &
until_true 30 test -s "$scratch/robot/facetd.yaml" || exit 1
token=0123456789abcdef0123456789abcdef
(umask 077 && echo $token >"$scratch/token")
sed "s|^listen:.*|listen: {native: ['unix:$scratch/robot.sock'], http: '127.0.0.1:0', token_file: '$scratch/token'}|" \
    "$scratch/robot/facetd.yaml" >"$scratch/robot.yaml"
begins robot
until_true 120 beyond step 600 || {
    echo "FAILED: the robot does not map: $(cat "$scratch/robot.log")"
    exit 1
}
python3 - "$scratch/robot.sock" <<'PYTHON' || failed=1
import socket, sys
with socket.socket(socket.AF_UNIX) as s:
    s.connect(sys.argv[1])
    s.sendall(b"?PAUSE\n")
    s.shutdown(socket.SHUT_WR)
    assert b"OK" in b"".join(iter(lambda: s.recv(4096), b""))
PYTHON
until_true 30 still || failed=1
node tests/files_web.mjs "$url" "$build/npm" || failed=1

# A map with nothing in it is a file, too.
cat >"$scratch/empty.yaml" <<YAML
devices: [{name: pose, driver: pose, fixed: {xyz: [0, 0, 0], rpy: [0, 0, 0]}}]
listen: {native: ['unix:$scratch/empty.sock'], http: '127.0.0.1:0'}
YAML
begins empty
node tests/files_web.mjs "$url" "$build/npm" >"$scratch/empty.said" || {
    failed=1
    cat "$scratch/empty.said"
}
exit $failed
