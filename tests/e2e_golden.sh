#!/bin/sh
# Law L2: gcc and clang, -O0 to -O3 with wider instructions, another libm choice and another machine: the same bytes.
set -eu
golden=$(cat tests/golden.txt)
scan=../shared/data/kurt3d/scan000.3d
out=$(mktemp -d)
trap 'rm -rf "$out"' EXIT
status=0
count=0

try() { # NAME RUNNER COMPILER OPTION...
    name=$1 runner=$2
    shift 2
    "$@" -std=c17 -D_GNU_SOURCE -I. -ffp-contract=off -fno-strict-aliasing -o "$out/golden" tests/golden.c core/*.c -lm
    got=$($runner "$out/golden")
    [ "$got" = "$golden" ] || { echo "$name: $got, not $golden"; status=1; }
    if [ -f "$scan" ]; then
        real=$($runner "$out/golden" "$scan")
        [ "$real" = "${first:=$real}" ] || { echo "$name on a real sweep: $real, not $first"; status=1; }
    fi
    count=$((count + 1))
}

try "gcc -O2" "" gcc -O2
GLIBC_TUNABLES=glibc.cpu.hwcaps=-AVX2,-FMA "$out/golden" | grep -qxF "$golden" || { echo "another libm choice: other bytes"; status=1; }
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
