#!/bin/sh
# Claim: Foxglove's own client and recorder receive every live patch and the right deletions (tests/foxglove_peer.mjs).
set -u
build=${FACET_BUILD:-build}
tests=$(dirname "$0")
unset FACETD FACETD_CONFIG

modules=$("$tests/npm/install" "$build") || { echo "$modules"; exit 77; }
exec timeout -k 5 1500 node "$tests/foxglove_peer.mjs" "$build" "$modules"
