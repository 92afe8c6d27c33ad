#!/bin/sh
# Law: every decoder of outside bytes has a fuzz target whose kept corpus runs here and reaches at least 90 % of its lines.
. "$(dirname "$0")/lib.sh"
for tool in clang llvm-profdata llvm-cov; do
    command -v $tool >/dev/null 2>&1 || { echo "$tool is not here: install clang and llvm (make deps)"; exit 77; }
done
build=build/fuzz

env -u MAKEFLAGS -u MFLAGS -u MAKELEVEL make -s -j2 config=fuzz fuzz-targets || { echo "the fuzz targets do not build"; exit 1; }

line_coverage() { # TARGET FILES...: percent of their lines
    target=$1
    shift
    llvm-profdata merge -o "$scratch/$target.data" "$scratch/$target.raw" || return
    llvm-cov report "$build/tests/$target" -instr-profile="$scratch/$target.data" "$@" 2>/dev/null | awk '$1 == "TOTAL" { print $10 }'
}

summary=
for source in tests/fuzz_*.c; do
    target=$(basename "$source" .c)
    files=$(sed -n "s/^$target  *//p" tests/fuzz_table)
    [ -n "$files" ] || { fail "$target is not in tests/fuzz_table: say which files it guards"; continue; }
    corpus=tests/corpus/${target#fuzz_}
    [ -n "$(ls "$corpus" 2>/dev/null)" ] || { fail "$target has no corpus in $corpus"; continue; }
    if ! LLVM_PROFILE_FILE="$scratch/$target.raw" timeout -k 5 800 "$build/tests/$target" -runs=0 -timeout=200 "$corpus" >"$scratch/log" 2>&1; then
        grep -E 'ERROR|SUMMARY|runtime error' "$scratch/log" | head -n 5
        fail "$target finds something in its own corpus"
        continue
    fi
    percent=$(line_coverage "$target" $files)
    echo "$target: ${percent:-no} line coverage of $files by $(ls "$corpus" | wc -l) inputs"
    summary="$summary ${target#fuzz_} ${percent:-?}"
    awk -v percent="${percent%\%}" 'BEGIN { exit !(percent >= 90) }' || fail "$target reaches less than 90 % of $files"
done
echo "note: line coverage by the corpora:$summary"
exit $failed
