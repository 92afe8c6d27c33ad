#!/bin/sh
# Laws L2, L4: gcc and clang, -O0 to -O3 with wider instructions, another libm choice and another machine: the same bytes.
. "$(dirname "$0")/lib.sh"
set -eu
golden=$(cat tests/golden.txt)
scan=../shared/data/kurt3d/scan000.3d
status=0
count=0

try() { # NAME RUNNER COMPILER OPTION...
    name=$1 runner=$2
    shift 2
    "$@" -std=c17 -D_GNU_SOURCE -I. -ffp-contract=off -fno-strict-aliasing -o "$scratch/golden" tests/golden.c $(grep -L "<zstd.h>" core/*.c) -lm
    got=$($runner "$scratch/golden")
    [ "$got" = "$golden" ] || { echo "$name: $got, not $golden"; status=1; }
    if [ -f "$scan" ]; then
        real=$($runner "$scratch/golden" 0 "$scan")
        [ "$real" = "${first:=$real}" ] || { echo "$name on a real sweep: $real, not $first"; status=1; }
    fi
    count=$((count + 1))
}

try "gcc -O2" "" gcc -O2
GLIBC_TUNABLES=glibc.cpu.hwcaps=-AVX2,-FMA "$scratch/golden" | grep -qxF "$golden" || { echo "another libm choice: other bytes"; status=1; }

# Meshed every row, every 4 or 10 rows, or once: the same patches (dirty patches are all that changed).
if [ -f "$scan" ]; then
    all=$("$scratch/golden" 0 "${scan%0.3d}0.3d" "${scan%0.3d}1.3d" "${scan%0.3d}2.3d")
    for rows in 1 4 10; do
        some=$("$scratch/golden" $rows "${scan%0.3d}0.3d" "${scan%0.3d}1.3d" "${scan%0.3d}2.3d")
        [ "$some" = "$all" ] || { echo "$rows rows a commit: $some, not $all"; status=1; }
    done
    echo "note: 1, 4, 10 rows a commit and all at once: $all"
fi

try "gcc -O0" "" gcc -O0
if grep -q avx2 /proc/cpuinfo && grep -q fma /proc/cpuinfo; then
    try "gcc -O3 x86-64-v3" "" gcc -O3 -march=x86-64-v3
fi
if command -v clang >/dev/null; then
    try "clang -O0" "" clang -O0
    try "clang -O2" "" clang -O2
fi
if command -v aarch64-linux-gnu-gcc >/dev/null && command -v qemu-aarch64 >/dev/null; then
    try "aarch64" qemu-aarch64 aarch64-linux-gnu-gcc -static -O2
else
    echo "note: aarch64 NOT tried (gcc-aarch64-linux-gnu and qemu-user are not here)"
fi
[ -f "$scan" ] || echo "note: the real sweep was NOT tried (../shared/data/kurt3d is not here)"
echo "note: $count builds, $golden"
exit $status
