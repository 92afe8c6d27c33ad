#!/bin/sh
# Law: what docs/devices.md says of faults is what a run shows: its table is the run's, byte for byte.
cd "$(dirname "$0")/.." || exit 2
exec tests/matrix_table "${FACET_BUILD:-build}"
