#!/bin/sh
# Law: the simulated CANopen drive is a drive for others too: the master of npm's `canopen` (MIT, not ours) brings it up.
cd "$(dirname "$0")/.." || exit 2
build=$PWD/${FACET_BUILD:-build}
modules=$PWD/build/npm-canopen # for every build; `make clean` takes it away
version=6.2.1

for command in node npm; do
    command -v $command >/dev/null || {
        echo "there is no $command: nobody else's CANopen master"
        exit 77
    }
done
if ! [ -e "$modules/node_modules/canopen/index.js" ]; then
    mkdir -p "$modules"
    timeout 120 npm install --prefix "$modules" --ignore-scripts --no-audit --no-fund --silent canopen@$version >/dev/null 2>&1 || {
        echo "npm cannot fetch canopen@$version: nobody else's CANopen master"
        exit 77
    }
fi
NODE_PATH=$modules/node_modules timeout 600 node tests/canopen_peer.js "$build/tests/canopen_node"
