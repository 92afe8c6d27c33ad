#!/bin/sh
# Claim: a person who opens the page sees the daemon's map. Real Chromium without a screen, WebGL in software, against
# facetd on simulated devices (tests/viewer_e2e.mjs has the claims one by one).
set -u
build=${FACET_BUILD:-build}
tests=$(dirname "$0")
unset FACETD FACETD_CONFIG

command -v node >/dev/null || { echo "node is not installed"; exit 77; }
command -v chromium >/dev/null || { echo "chromium is not installed: apt-get install chromium"; exit 77; }
[ -s build/viewer/pages.h ] || { echo "the page was not built: $(cat build/viewer/left_out)"; exit 77; }
exec timeout -k 5 1800 node "$tests/viewer_e2e.mjs" "$build"
