#!/bin/sh
# Claim: the page is left out, in one line, where node or its packages cannot be had, and nothing is written into the tree.
set -u
cd "$(dirname "$0")/.." || exit 1
out=$(mktemp -d)
trap 'rm -rf "$out"' EXIT
failures=0

fail() {
    echo "FAILED: $*"
    failures=$((failures + 1))
}

tree() {
    find viewer -newer "$out/begin" -print
}

touch "$out/begin"
mkdir "$out/bin"
for command in sh env dirname mkdir find grep cmp cp touch rm cat timeout sed; do
    ln -s "$(command -v $command)" "$out/bin/$command"
done
PATH=$out/bin viewer/build "$out/none" >"$out/log" 2>&1 || fail "without node it is no failure: $(cat "$out/log")"
[ -e "$out/none/pages.h" ] && [ ! -s "$out/none/pages.h" ] || fail "without node the list of pages is not empty"
grep -q node "$out/none/left_out" || fail "without node it does not say what is missing"

if command -v node >/dev/null && command -v npm >/dev/null; then
    # A registry that nobody serves stands for a machine without network.
    npm_config_registry=http://127.0.0.1:9/ npm_config_cache="$out/cache" viewer/build "$out/offline" >"$out/log" 2>&1 ||
        fail "without network it is no failure: $(cat "$out/log")"
    [ -e "$out/offline/pages.h" ] && [ ! -s "$out/offline/pages.h" ] || fail "without network the list of pages is not empty"
    grep -q packages "$out/offline/left_out" || fail "without network it does not say what is missing"
fi
[ -z "$(tree)" ] || fail "written into the tree: $(tree)"
[ $failures -eq 0 ]
