#!/bin/sh
# Claim: the page is left out, in one line, where node or its packages cannot be had, and nothing is written into the tree.
. "$(dirname "$0")/lib.sh"
set -u

tree() {
    find viewer -newer "$scratch/begin" -print
}

touch "$scratch/begin"
mkdir "$scratch/bin"
for command in sh env dirname mkdir find grep cmp cp touch rm cat timeout sed; do
    ln -s "$(command -v $command)" "$scratch/bin/$command"
done
PATH=$scratch/bin viewer/build "$scratch/none" >"$scratch/log" 2>&1 || fail "without node it is no failure: $(cat "$scratch/log")"
[ -e "$scratch/none/pages.h" ] && [ ! -s "$scratch/none/pages.h" ] || fail "without node the list of pages is not empty"
grep -q node "$scratch/none/left_out" || fail "without node it does not say what is missing"

if command -v node >/dev/null && command -v npm >/dev/null; then
    # A registry that nobody serves stands for a machine without network.
    npm_config_registry=http://127.0.0.1:9/ npm_config_cache="$scratch/cache" viewer/build "$scratch/offline" >"$scratch/log" 2>&1 ||
        fail "without network it is no failure: $(cat "$scratch/log")"
    [ -e "$scratch/offline/pages.h" ] && [ ! -s "$scratch/offline/pages.h" ] || fail "without network the list of pages is not empty"
    grep -q packages "$scratch/offline/left_out" || fail "without network it does not say what is missing"
fi
[ -z "$(tree)" ] || fail "written into the tree: $(tree)"
exit $failed
