#!/bin/sh
# Law L6: beside clients that do not read and readers of two forms, the running daemon encodes each patch once for all of them
# (its own counters), and who stalls is told behind. A short run of the benchmark; its times are not judged.
set -eu
build=${FACET_BUILD:-build}
out=$(mktemp -d)
trap 'rm -rf "$out"' EXIT
unset FACETD FACETD_CONFIG

FACET_BUILD=$build timeout 800 bench/stalled 1 2 20 8 >"$out/stalled" 2>&1 || { cat "$out/stalled"; exit 1; }
grep -q '^20 clients stalled: ' "$out/stalled" && grep -q '^ratio, .*; 20 of the clients shown were behind$' "$out/stalled" ||
    { cat "$out/stalled"; exit 1; }
grep -q '^encodes: no /metrics' "$out/stalled" && { echo "a daemon without its page has no counters to ask"; exit 77; }
# Four of the readers would code every patch four times, each for itself.
awk '/^encodes: / { native = $2; coded = $9; if (native > 0 && coded > 0 && coded < 2 * native) good = 1 } END { exit !good }' "$out/stalled" ||
    { cat "$out/stalled"; echo "patches are not encoded once for all"; exit 1; }
grep '^encodes: ' "$out/stalled" | sed 's/^/note: /'
