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
    begin=$(date +%s)
    timeout -k 5 "${ROW_TIMEOUT:-120}" sh "$0" --row "$1" >"$ROWS/$1.log" 2>&1 </dev/null
    row_verdict $? $(($(date +%s) - begin)) "$1" "$2" >>"$ROWS/verdicts"
}

# A row that was asked for runs here, when all functions are known, and is the end.
rows_begin() {
    [ -z "$rows_asked_for" ] || { "$rows_asked_for"; exit $?; }
    mkdir -p "$ROWS"
}

# until_true SECONDS COMMAND...: tries every tenth of a second.
until_true() {
    tries=$(($1 * 10))
    shift
    until "$@"; do
        tries=$((tries - 1))
        [ $tries -gt 0 ] || return 1
        sleep 0.1
    done
}

fail() {
    echo "FAILED: $*"
    exit 1
}
