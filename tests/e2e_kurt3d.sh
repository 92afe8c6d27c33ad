#!/bin/sh
# Laws L4, L5: three real sweeps become a sound, complete mesh with a fifth of the faces, within the bounds.
. "$(dirname "$0")/lib.sh"
set -eu
data=../shared/data/kurt3d
[ -d "$data" ] || { echo "the real sweeps (../shared/data/kurt3d) are not here"; exit 77; }
scans="$data/scan000.3d $data/scan001.3d $data/scan002.3d"
clouds="--cloud $data/scan000.3d --cloud $data/scan001.3d --cloud $data/scan002.3d"

reconstruct() { # NAME OPTION...
    name=$1
    shift
    # shellcheck disable=SC2086
    "$facet" reconstruct "$@" --stats "$scratch/$name.json" -o "$scratch/$name.ply" ${inputs:-$scans}
}

fewer() { # RAW REDUCED SHARE
    python3 - "$scratch/$1.json" "$scratch/$2.json" "$3" <<'PY'
import json, sys
raw, reduced = (json.load(open(f)) for f in sys.argv[1:3])
share = 1 - reduced["faces"] / raw["faces"]
print(f"note: {raw['faces']} -> {reduced['faces']} faces, {100 * share:.1f} % fewer, CPU {reduced['seconds']['total']:.2f} s, "
      f"{reduced['peak_rss_bytes'] >> 20} MB")
sys.exit(share < float(sys.argv[3]))
PY
}

reconstruct raw --cell 0.05 --planes off --reduce off
reconstruct out --cell 0.05
fewer raw out 0.80
# shellcheck disable=SC2086
python3 tests/judge.py "$scratch/raw.ply" $clouds -- 'complete>=0.95' 'ghost<=0.05'
# shellcheck disable=SC2086
python3 tests/judge.py "$scratch/out.ply" --ref "$scratch/raw.ply" --tol 0.03 $clouds -- 'new_open_m==0' 'to_ref.p99<=0.0125' \
    'from_ref.p99<=0.0125' 'to_ref.max<=0.05' 'from_ref.max<=0.05' 'complete>=0.95' 'ghost<=0.05'
# shellcheck disable=SC2086
python3 tests/judge.py "$scratch/out.ply" $clouds --far 0.1 -- 'ghost<=0.005'

# One and two threads give the same bytes.
reconstruct one --cell 0.05 --threads 1
reconstruct two --cell 0.05 --threads 2
cmp "$scratch/one.ply" "$scratch/two.ply"
cmp "$scratch/one.ply" "$scratch/out.ply"

# Other cells, and each sweep alone, are as sound.
for cell in 0.1 0.03; do
    reconstruct raw_c --cell "$cell" --reduce off
    reconstruct out_c --cell "$cell"
    python3 tests/judge.py "$scratch/out_c.ply" --ref "$scratch/raw_c.ply" --tol "$(python3 -c "print(0.6 * $cell)")" -- 'new_open_m==0'
done
for scan in $scans; do
    inputs=$scan
    reconstruct raw_s --cell 0.05 --reduce off
    reconstruct out_s --cell 0.05
    fewer raw_s out_s 0.80
    python3 tests/judge.py "$scratch/out_s.ply" --ref "$scratch/raw_s.ply" --tol 0.03 -- 'new_open_m==0' 'to_ref.p99<=0.0125' 'from_ref.p99<=0.0125'
done
