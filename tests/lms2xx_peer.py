"""Stands between the daemon and a simulated LMS2xx, and puts a captured telegram in the place of the first measurements.

    python3 tests/lms2xx_peer.py LINE LINK CAPTURE TIMES     LINE: the simulator's; LINK: where the daemon shall look

The dialogue passes as it is, the line's rate too. After TIMES measurements it says so on stdout and lets nothing through any more.
"""
import fcntl
import os
import select
import sys
import time
import tty

MEASUREMENT, LONGEST = 0xB0, 900
HEAD = b"\x02\x80"
TCGETS2, TCSETS2 = 0x802C542A, 0x402C542B
SILENCE_S = 0.2  # what was begun before it was no telegram


def split(data):
    """Telegrams and single bytes of the device, and what is begun."""
    found = []
    while data:
        if data[0] != 2:
            found.append(data[:1])
            data = data[1:]
            continue
        if len(data) < 5:
            break
        length = int.from_bytes(data[2:4], "little") + 6
        if length > LONGEST:
            found.append(data[:1])
            data = data[1:]
            continue
        if len(data) < length:
            break
        found.append(data[:length])
        data = data[length:]
    return found, data


def follow_rate(terminal, device):
    """Rates are any numbers here, which termios does not know: struct termios2, x86 and ARM."""
    wanted = fcntl.ioctl(terminal, TCGETS2, bytes(44))
    now = fcntl.ioctl(device, TCGETS2, bytes(44))
    if wanted[36:] != now[36:]:
        fcntl.ioctl(device, TCSETS2, now[:8] + wanted[8:12] + now[12:36] + wanted[36:])


def main(line, link, capture, times):
    captured, left, rest = open(capture, "rb").read(), int(times), b""
    device = os.open(line, os.O_RDWR | os.O_NOCTTY)
    host, terminal = os.openpty()
    tty.setraw(device)
    tty.setraw(terminal)
    os.symlink(os.ttyname(terminal), link)
    while left > 0:
        ready = select.select([device, host], [], [], SILENCE_S)[0]
        if not ready and rest and rest[:2] != HEAD:
            os.write(host, rest)
            rest = b""
        if host in ready:
            follow_rate(terminal, device)
            os.write(device, os.read(host, 4096))
        if device not in ready:
            continue
        found, rest = split(rest + os.read(device, 4096))
        for telegram in found:
            if len(telegram) < 5 or telegram[4] != MEASUREMENT:
                os.write(host, telegram)
            elif left > 0:
                os.write(host, captured)
                left -= 1
    print("played", flush=True)
    while True:
        time.sleep(1)


if __name__ == "__main__":
    main(*sys.argv[1:])
