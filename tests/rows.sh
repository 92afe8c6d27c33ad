# Rows of a tier. A script sources this file, defines its functions, says `rows_begin`, then `row FUNCTION 'claim'` for each.
# Every row is a process of its own with a limit; its verdict is one line in $ROWS/verdicts, its output in $ROWS/FUNCTION.log.
# A row that ends with 77 is skipped and says why on its last line; `note: ...` lines (figures) are shown.
ROWS=${ROWS:?the folder for verdicts}

rows_asked_for=
[ "${1:-}" != --row ] || rows_asked_for=$2

row_verdict() { # STATUS SECONDS FUNCTION CLAIM
    log=$ROWS/$3.log
    case $1 in
    0) echo "ok      $4 ($2 s)$(sed -n 's/^note: /  /p' "$log" | head -n 8 | tr '\n' ';')" ;;
    77) echo "SKIPPED $4: $(tail -n 1 "$log")" ;;
    *) echo "FAILED  $4 (status $1, $2 s)"; tail -n "${ROW_TAIL:-40}" "$log" | sed 's/^/    /' ;;
    esac
}

row() {
    case " ${ONLY:-$1} " in *" $1 "*) ;; *) return ;; esac
    begin=$(date +%s)
    timeout -k 5 "${ROW_TIMEOUT:-300}" sh "$0" --row "$1" >"$ROWS/$1.log" 2>&1 </dev/null
    row_verdict $? $(($(date +%s) - begin)) "$1" "$2" >>"$ROWS/verdicts"
}

# A row that was asked for runs here, when all functions are known, and is the end.
rows_begin() {
    [ -z "$rows_asked_for" ] || { "$rows_asked_for"; exit $?; }
    mkdir -p "$ROWS"
}

# until_true SECONDS COMMAND...: tries five times a second.
until_true() {
    last=$(($(date +%s) + $1))
    shift
    until "$@"; do
        [ "$(date +%s)" -le $last ] || return 1
        sleep 0.2
    done
}

fail() {
    echo "FAILED: $*"
    exit 1
}

# status_of DEVICE KEY: of the daemon at $FACETD, e.g. `status_of laser state`; counters have the same names as in the status.
# It is asked anew, unless $STATUS is a file that gathers its status every second: a program costs much in a slow guest.
status_of() {
    { [ -n "${STATUS:-}" ] && grep "\]}$" "$STATUS" | tail -n 1 || timeout 20 "$FACET" watch --once --json 2>/dev/null; } |
        sed 's/{"name":/\n&/g' | grep "^{\"name\":\"$1\"" | grep -o "\"$2\":[^,}]*" | head -n 1 | sed 's/^[^:]*://; s/"//g'
}
is() { # DEVICE KEY VALUE
    [ "$(status_of "$1" "$2")" = "$3" ]
}
at_least() { # DEVICE KEY VALUE, whole numbers
    now=$(status_of "$1" "$2" | cut -d. -f1)
    [ "${now:--1}" -ge "$3" ]
}
