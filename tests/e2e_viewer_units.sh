#!/bin/sh
# Claim: the page's codec, mirror, arrays and lengths hold what they say (tests/viewer_unit.mjs), without a browser.
command -v node >/dev/null || { echo "node is not installed"; exit 77; }
out=$(node "$(dirname "$0")/viewer_unit.mjs" 2>&1) || { echo "$out"; exit 1; }
echo "note: $(echo "$out" | sed -n 's/^# pass \(.*\)/\1 claims hold/p')"
