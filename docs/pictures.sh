#!/bin/sh
# Makes the pictures in docs/ anew: the three real sweeps (../shared/data) and the demo building, raw and reduced.
# Takes about a minute and a half; the building is driven live, so its pictures differ a little from run to run.
set -eu
cd "$(dirname "$0")/.."
facet=build/facet
data=../shared/data/kurt3d
out=$(mktemp -d)
trap 'rm -rf "$out"' EXIT
export out

draw() { # MESH NAME OPTION...
    mesh=$1 name=$2
    shift 2
    "$facet" picture "$mesh" --size 1200x750 "$@" -o "docs/$name.png"
}

if [ -d "$data" ]; then
    "$facet" reconstruct --reduce off -o "$out/raw.ply" "$data"/scan00?.3d
    "$facet" reconstruct -o "$out/reduced.ply" "$data"/scan00?.3d
    draw "$out/raw.ply" kurt3d_raw --view 25,40 --cut 1.5
    draw "$out/reduced.ply" kurt3d_reduced --view 25,40 --cut 1.5
    draw "$out/reduced.ply" kurt3d_edges --view 25,40 --cut 1.5 --edges
fi

# shellcheck disable=SC2016
"$facet" simulate building --dir "$out/d" -- sh -c '
    build/facetd --journal "$out/journal" & sleep 41; build/facet save -o "$out/building.ply"; kill $!; wait'
sed 's/^map: {/map: {reduce: off, /; t; $a map: {reduce: off}' "$out/d/facetd.yaml" >"$out/raw.yaml"
grep -c '^map:' "$out/raw.yaml" | grep -qx 1
build/tests/steps "$out/raw.yaml" "$out/journal" "$out/building_raw.ply"
draw "$out/building.ply" building --view 50,50
draw "$out/building.ply" building_edges --view 50,50 --edges
draw "$out/building_raw.ply" building_raw --view 50,50
