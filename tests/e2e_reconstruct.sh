#!/bin/sh
# Laws L2, L8: `facet reconstruct` as its users meet it: every input and output, the same bytes with any number of threads,
# one sentence and the documented status for what is wrong, and never half a file.
. "$(dirname "$0")/lib.sh"
set -u

# A room of 4 x 3 x 2.5 m, scanned by a servo that tilts: a raster that anybody can make.
python3 - "$scratch" <<'PY'
import math, struct, sys
out = sys.argv[1]
def cast(d):
    t = [(2.5 if d[0] > 0 else -1.5) / d[0] if abs(d[0]) > 1e-9 else 99, (1.7 if d[1] > 0 else -1.3) / d[1] if abs(d[1]) > 1e-9 else 99,
         (1.6 if d[2] > 0 else -0.9) / d[2] if abs(d[2]) > 1e-9 else 99]
    return min(v for v in t if v > 0)
cloud = []
with open(out + "/scan000.3d", "w") as scan:
    for i in range(120):
        up = math.radians(-50 + i)
        for k in range(181):
            b = math.radians(k)
            d = (math.sin(b) * math.cos(up), -math.cos(b), math.sin(b) * math.sin(up))
            r = round(cast(d) * 1000) / 1000
            p = [r * x for x in d]
            cloud.append(p)
            scan.write("%.6g %.6g %.6g\n" % (-p[1] * 100, p[2] * 100, p[0] * 100))
open(out + "/scan000.pose", "w").write("0 0 0\n0 0 0\n")
open(out + "/turned.pose", "w").write("10 20 30\n0 90 0\n")
open(out + "/list.tum", "w").write("# t x y z qx qy qz qw\n0 0.1 0.2 0.3 0 0 0 1\n")
open(out + "/cloud.xyz", "w").writelines("%.5f %.5f %.5f\n" % tuple(p) for p in cloud)
open(out + "/cloud.pts", "w").writelines(["%d\n" % len(cloud)] + ["%.5f %.5f %.5f 7 255 0 0\n" % tuple(p) for p in cloud])
open(out + "/cloud.ply", "wb").write(b"ply\nformat binary_little_endian 1.0\nelement vertex %d\nproperty double x\nproperty double y\nproperty double z\nend_header\n" % len(cloud)
    + b"".join(struct.pack("<3d", *(round(x, 5) for x in p)) for p in cloud))
open(out + "/cloud.pcd", "w").writelines(["VERSION 0.7\nFIELDS x y z\nSIZE 8 8 8\nTYPE F F F\nCOUNT 1 1 1\nWIDTH %d\nHEIGHT 1\nPOINTS %d\nDATA ascii\n" % (len(cloud), len(cloud))]
    + ["%.5f %.5f %.5f\n" % tuple(p) for p in cloud])
PY

hash_of() { sed 's/.*"hash": "\([0-9a-f]*\)".*/\1/' "$1"; }

good() { # NAME OPTION...: must succeed and write OUT and the figures
    name=$1
    shift
    "$facet" reconstruct --stats "$scratch/$name.json" -o "$scratch/$name.ply" "$@" >"$scratch/log" 2>&1 || fail "$name: $(cat "$scratch/log")"
    [ -s "$scratch/$name.ply" ] || fail "$name: no mesh"
}

refused() { # STATUS WORDS OPTION...: must say WORDS in one line and leave no OUT
    status=$1 words=$2
    shift 2
    rm -f "$scratch/bad.ply"
    "$facet" "$@" >"$scratch/log" 2>&1
    got=$?
    [ $got -eq "$status" ] || fail "status $got, not $status: $*: $(cat "$scratch/log")"
    grep -q -e "$words" "$scratch/log" || fail "'$words' is not in: $(cat "$scratch/log")"
    [ "$(wc -l <"$scratch/log")" -eq 1 ] || fail "more than a line: $(cat "$scratch/log")"
    [ ! -e "$scratch/bad.ply" ] || fail "left a file: $*"
}

# Scans and clouds, every ending, threads.
good scan --cell 0.05 "$scratch/scan000.3d"
good two --cell 0.05 --threads 2 "$scratch/scan000.3d"
cmp -s "$scratch/scan.ply" "$scratch/two.ply" || fail "two threads give another mesh"
[ "$(hash_of "$scratch/scan.json")" = "$(hash_of "$scratch/two.json")" ] || fail "two threads give another hash"
good raw --reduce off "$scratch/scan000.3d"
for kind in pts ply pcd xyz; do
    good "cloud_$kind" "$scratch/cloud.$kind"
done
for kind in pts ply pcd; do
    cmp -s "$scratch/cloud_xyz.ply" "$scratch/cloud_$kind.ply" || fail "the same points as .$kind give another mesh than as .xyz"
done
for kind in obj stl glb; do
    "$facet" reconstruct -o "$scratch/mesh.$kind" "$scratch/scan000.3d" >/dev/null || fail "$kind"
    [ -s "$scratch/mesh.$kind" ] || fail "no $kind"
done
good text --ascii "$scratch/scan000.3d"
head -n 2 "$scratch/text.ply" | grep -q ascii || fail "--ascii is not text"
good turned --pose "$scratch/turned.pose" "$scratch/scan000.3d"
good listed --poses "$scratch/list.tum" "$scratch/scan000.3d"
good still --no-pose "$scratch/scan000.3d"
cmp -s "$scratch/still.ply" "$scratch/scan.ply" || fail "a pose of zeros is not the origin"
! cmp -s "$scratch/listed.ply" "$scratch/scan.ply" || fail "--poses moved nothing"

# The figures.
python3 - "$scratch" <<'PY' || fail "figures"
import json, os, sys
s, raw = (json.load(open(sys.argv[1] + f)) for f in ("/scan.json", "/raw.json"))
keys = "points rows sweeps blocks patches cells faces_raw faces planes reduction batches seconds peak_rss_bytes hash".split()
assert list(s) == keys, list(s)
assert list(s["seconds"]) == "read assemble integrate extract reduce write total".split()
assert s["rows"] == 120 and s["sweeps"] == 1 and s["points"] == 120 * 181, s
assert raw["faces"] == raw["faces_raw"] == s["faces_raw"] and raw["reduction"] == 0
assert abs(s["reduction"] - (1 - s["faces"] / s["faces_raw"])) < 1e-5
assert all(v >= 0 for v in s["seconds"].values()) and s["seconds"]["total"] >= s["seconds"]["integrate"] > 0
assert s["peak_rss_bytes"] > 1 << 20 and len(s["hash"]) == 64
PY

# What is wrong is said, by name.
cd "$scratch" || exit 1
case $facet in /*) ;; *) facet=$OLDPWD/$facet ;; esac
bad="reconstruct -o bad.ply"
printf '1 2 3\n4 five 6\n' >wrong.3d
printf '0 0 0\n0 0\n' >wrong.pose
cp scan000.3d lonely.3d
head -c 20000 cloud.ply >cut.ply
printf 'ply\nformat binary_little_endian 1.0\nelement vertex 4000000000\nproperty float x\nproperty float y\nproperty float z\nend_header\nxx' >huge.ply
: >empty.xyz
mkdir folder closed folder.ply
mkfifo pipe.xyz
# shellcheck disable=SC2086
{
    refused 1 '^facet: absent.3d: .*No such file' $bad absent.3d
    refused 1 '^facet: wrong.3d:2: ' $bad --no-pose wrong.3d
    refused 1 '^facet: wrong.pose:[0-9]*: ' $bad scan000.3d --pose wrong.pose
    refused 1 'there is no lonely.pose beside it' $bad lonely.3d
    refused 1 '^facet: cut.ply: .*cut' $bad cut.ply
    refused 1 '^facet: huge.ply: ' $bad huge.ply
    refused 1 '^facet: empty.xyz: no points' $bad empty.xyz
    refused 1 '^facet: pipe.xyz: ' $bad pipe.xyz
    refused 1 '^facet: scan000.3d/inside.3d: ' $bad scan000.3d/inside.3d
    echo '0 1 2 3 0 0 0 0' >none.tum
    refused 1 'none.tum:1: qx qy qz qw have the length 0' $bad --poses none.tum scan000.3d
    refused 1 'list.tum: has 1 poses for 2 inputs' $bad --poses list.tum scan000.3d scan000.3d
    refused 1 '^facet: nowhere/bad.ply: ' reconstruct -o nowhere/bad.ply scan000.3d
    refused 1 '^facet: folder.ply: ' reconstruct -o folder.ply scan000.3d
    refused 1 '^facet: nowhere/s.json: ' $bad --stats nowhere/s.json scan000.3d
    refused 2 '--field hoppe' $bad --field hoppe scan000.3d
    refused 2 '--field direct' $bad --field direct scan000.3d
    refused 2 '--planes on' $bad --planes on scan000.3d
    refused 2 'drive.mcap: .mcap' $bad drive.mcap
    refused 2 'cloud.csv: .csv' $bad cloud.csv
    refused 2 'mesh.foo: ' $bad mesh.foo
    refused 2 'out.xyz: ' reconstruct -o out.xyz scan000.3d
    refused 2 '--cell 0' $bad --cell 0 scan000.3d
    refused 2 '--cell five' $bad --cell five scan000.3d
    refused 2 '--reduce maybe' $bad --reduce maybe scan000.3d
    refused 2 '--threads 0' $bad --threads 0 scan000.3d
    refused 2 '--threads 1.5' $bad --threads 1.5 scan000.3d
    refused 2 'exclude each other' $bad --no-pose --pose turned.pose scan000.3d
    refused 2 'no input' reconstruct -o bad.ply
    refused 2 'no output' reconstruct scan000.3d
}
for command in calibrate bench decimate; do
    refused 2 "$command: this command comes in a later version" $command x
done
refused 2 'there is no such command' juggle
"$facet" reconstruct --nonsense >log 2>&1
[ $? -eq 2 ] || fail "an unknown option is not status 2"
"$facet" --version | grep -q '^facet ' || fail "--version"
"$facet" --help | grep -q reconstruct || fail "--help"
"$facet" reconstruct --help | grep -q tolerance || fail "reconstruct --help"

# A folder that cannot be written is found before the work; an older file stays as it is when the input is bad.
if [ "$(id -u)" -ne 0 ]; then
    chmod a-w closed
    refused 1 'closed/bad.ply: .*choose a folder' reconstruct -o closed/bad.ply scan000.3d
fi
echo old >kept.ply
"$facet" reconstruct -o kept.ply --no-pose wrong.3d 2>/dev/null
[ "$(cat kept.ply)" = old ] || fail "an older file was touched"
ls -A | grep -q '\.part$' && fail "parts of files are left"
[ $failed -eq 0 ] && echo "note: clouds as .xyz .pts .ply .pcd and a raster, 1 and 2 threads: the same bytes"
exit $failed
