"""Lists kept by `facetd --journal`, for scripts: what of them is one recording (daemon/journal.c draws the entries).

    kept_list.py [--ended] first JOURNAL RECORDING OUT          the beginning of the list that a recording holds, which began with it
    kept_list.py before JOURNAL RECORDING OUT         what came before a recording that began in the midst of it
    kept_list.py from JOURNAL RECORDING OUT ROWS      the list up to the recording's end, its first ROWS rows not applied: what a map
                                                      is that knows nothing of the time before the recording

RECORDING is the output of `facet info --json`. Status 1 where the list, which is buffered, has not so many entries; with --ended the
daemon ended in order, and the list is whole.
"""
import json
import struct
import sys

SNAPSHOT, RECORD, TICK, NOT_APPLIED, CLOCK = range(1, 6)
ENDED = "--ended" in sys.argv
FIXED = {SNAPSHOT: 4, RECORD: 22, TICK: 8, NOT_APPLIED: 8, CLOCK: 8}


def entries(data):
    """(kind, begin, end) of each whole entry."""
    assert data[:8] == b"FACETJ2\n", "the journal"
    at = 8
    while at < len(data):
        kind, fixed = data[at], FIXED[data[at]]
        if at + 1 + fixed > len(data):
            return
        n = struct.unpack_from("<I", data, at + 1 + fixed - 4)[0] if kind in (SNAPSHOT, RECORD) else 0
        end = at + 1 + fixed + n
        if end > len(data):
            return
        yield kind, at, end
        at = end


def last_ns(data):
    """Log time of the last record or tick."""
    return max(struct.unpack_from("<q", data, at + 1)[0] for kind, at, _ in entries(data) if kind in (RECORD, TICK))


def first(data, count):
    """The first `count` records and ticks, with the rows that they led to; None: it has not so many, or these may be all that a
    kill left of it."""
    end = 8
    for kind, at, behind in entries(data):
        count -= kind in (RECORD, TICK)
        if count < 0:
            return data[:end]
        end = behind
    return data if ENDED and count == 0 else None


def before(data, begin_ns):
    """Everything before the tick at which a recording began, and how many records and ticks these are. It begins at the time of
    what was handled last, `begin_ns`, with the tick behind it."""
    count = 0
    for kind, at, _ in entries(data):
        if kind == TICK and struct.unpack_from("<q", data, at + 1)[0] > begin_ns:
            return data[:at], count
        count += kind in (RECORD, TICK)
    raise AssertionError(f"no tick behind {begin_ns}")


def without(data, rows):
    """As if its first `rows` rows had not been applied."""
    told = {struct.unpack_from("<Q", data, at + 1)[0] for kind, at, _ in entries(data) if kind == NOT_APPLIED}
    return data + b"".join(struct.pack("<BQ", NOT_APPLIED, n) for n in range(rows) if n not in told)


def main():
    arguments = [word for word in sys.argv[1:] if word != "--ended"]
    what, journal, recording, out = arguments[:4]
    data = open(journal, "rb").read()
    told = json.load(open(recording, encoding="ascii"))
    count = told["records"] + told["ticks"]
    if what == "first":
        got = first(data, count)
    elif what == "before":
        got, _ = before(data, told["begin_ns"])
    else:
        got = first(data, before(data, told["begin_ns"])[1] + count)
        got = got and without(got, int(arguments[4]))
    if got is None:
        sys.exit(1)
    open(out, "wb").write(got)


if __name__ == "__main__":
    main()
