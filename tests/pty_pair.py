#!/usr/bin/env python3
"""A serial cable: pty_pair.py A B makes two raw pseudo-terminals and carries bytes between them; A and B are links to them."""
import os
import select
import signal
import sys
import tty


def main():
    ends = []
    for path in sys.argv[1:3]:
        master, slave = os.openpty()
        tty.setraw(slave)  # a fresh one echoes; kept open, so that nobody hangs up
        os.symlink(os.ttyname(slave), path)
        ends.append(master)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    other = dict(zip(ends, reversed(ends)))
    while True:
        for end in select.select(ends, [], [])[0]:
            os.write(other[end], os.read(end, 4096))


main()
