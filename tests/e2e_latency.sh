#!/bin/sh
# The benchmark of latency judges itself (design, numbers to reach): every row that is counted stands in the histogram once, quantiles are
# in order, nothing arrives before it was sent, and what lies beyond the look-ahead is less than the whole. No time is judged.
set -eu
build=${FACET_BUILD:-build}
out=$(mktemp -d)
trap 'rm -rf "$out"' EXIT
unset FACETD FACETD_CONFIG

cat >"$out/inside" <<'END'
sed 's|variant: 180/0.5|variant: 180/1|' "$FACETD_CONFIG" >"$2/facetd.yaml"
"$1/facetd" --config "$2/facetd.yaml" 2>"$2/daemon.log" &
"$1/bench/latency" "$2/sent" 3 >"$2/latency" 2>"$2/error" || status=$?
kill $!
wait
exit "${status:-0}"
END
timeout 600 "$build/facet" simulate hall --servo can --endless --sent "$out/sent" -- sh "$out/inside" "$build" "$out" >"$out/simulate" ||
    { cat "$out/simulate" "$out/error" "$out/daemon.log"; exit 1; }
cat "$out/latency"

# Every profile has its line: it left after it was measured, and after the one before.
awk '{ if (NF != 2 || $1 <= $2 || $1 <= before) { print "a line that cannot be: " $0; bad = 1 } before = $1 }
     END { if (NR < 20) { print NR " profiles only"; bad = 1 } exit bad }' "$out/sent"
awk '/^latency/ { for (i = 1; i < NF; i++) if ($i == "n") n = $(i + 1) }
     / p50 .* max / { gsub(/[,:]/, "")
                      for (i = 1; i < NF; i++) q[$i] = $(i + 1)
                      if (!(q["p50"] > 0 && q["p50"] <= q["p90"] && q["p90"] <= q["p99"] && q["p99"] <= q["max"])) bad = 1
                      p50[++shown] = q["p50"] }
     / (<|>=) / { whole += $3; beyond += $4; bins++ }
     / rows dropped: / { dropped = 1 }
     END { if (!(n > 0 && whole == n && beyond == n && bins == 12 && shown == 2 && p50[2] < p50[1] && dropped && !bad)) {
               print "a histogram that cannot be: " n ", " whole ", " beyond ", " bins ", " shown; exit 1 } }' "$out/latency"
