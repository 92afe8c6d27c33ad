#!/bin/sh
# Law: who may, gets over HTTP and WebSockets what the daemon has, whole; who may not is told so; and nobody costs it more
# than a bounded piece of memory.
cd "$(dirname "$0")/.." || exit 2
build=${FACET_BUILD:-build}
command -v python3 >/dev/null || {
    echo "python3 is not installed"
    exit 77
}
exec timeout -k 5 1500 python3 tests/web_judge.py "$build"
