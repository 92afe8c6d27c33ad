"""Plays the scanner's side of a capture to whoever connects, at the pace it was captured.

    python3 tests/cola_peer.py CAPTURE PORTFILE     the port it listens on (loopback) goes to PORTFILE

A request is answered as the captured scanner answered a request of that name; the stream is switched on and off. Where the
capture has no answer, a login and what is written are accepted, and the rest is refused with sFA 3; what comes in the other
dialect is not answered at all. When the capture is over it says so on stdout, keeps the connection and refuses new ones, so
that nothing comes twice.
"""
import os
import re
import select
import socket
import struct
import sys
import time

PERIOD_S = 1 / 15  # where the capture has no times
COMMANDS = {b"sRN": b"sRA", b"sRI": b"sRA", b"sWN": b"sWA", b"sMN": b"sAN", b"sEN": b"sEA"}


def frame(text, payload):
    if text:
        return b"\x02" + payload + b"\x03"
    checksum = 0
    for byte in payload:
        checksum ^= byte
    return b"\x02\x02\x02\x02" + struct.pack(">I", len(payload)) + payload + bytes([checksum])


def split(data):
    """Frames in the bytes, as (in CoLa-A, payload), and what is left of them."""
    frames = []
    while data:
        if data[:4] == b"\x02\x02\x02\x02" and len(data) >= 8:
            length = struct.unpack(">I", data[4:8])[0] + 9
            if len(data) < length:
                break
            frames.append((False, data[8 : length - 1]))
            data = data[length:]
        elif data[0] == 2 and data[1:2] != b"\x02" and b"\x03" in data:
            end = data.index(b"\x03")
            frames.append((True, data[1:end]))
            data = data[end + 1 :]
        else:
            break
    return frames, data


def name(payload):
    return re.split(rb"[ \x00]", payload[4:], maxsplit=1)[0]


def read_lines(path):
    """(time, from the device, bytes) of each line."""
    for line in open(path, encoding="ascii"):
        words = line.split()
        if len(words) == 3 and words[1] in ("C>S", "S>C"):
            yield float(words[0]), words[1] == "S>C", bytes.fromhex(words[2])


def read_packets(path):
    data = open(path, "rb").read()
    at = 0
    while at + 12 <= len(data):
        kind, length = struct.unpack_from("<II", data, at)
        if kind == 6:
            high, low, kept = struct.unpack_from("<III", data, at + 12)
            packet = data[at + 28 : at + 28 + kept]
            if packet[12:14] == b"\x08\x00" and packet[23] == 6:
                ip = packet[14:]
                tcp = ip[(ip[0] & 15) * 4 : struct.unpack(">H", ip[2:4])[0]]
                payload = tcp[(tcp[12] >> 4) * 4 :]
                if payload:
                    yield (high << 32 | low) / 1e9, struct.unpack(">H", tcp[:2])[0] == 2112, payload
        at += length


def read_stream(path):
    """Telegrams of a bare stream at an even pace, each in two reads; what is begun at its end comes last."""
    frames, rest = split(open(path, "rb").read())
    for i, (text, payload) in enumerate(frames):
        whole = frame(text, payload)
        yield i * PERIOD_S, True, whole[:1448]
        if whole[1448:]:
            yield i * PERIOD_S + 0.0003, True, whole[1448:]
    if rest:
        yield len(frames) * PERIOD_S, True, rest


class Capture:
    def __init__(self, path):
        readers = {".txt": read_lines, ".pcapng": read_packets, ".bin": read_stream}
        self.answers, self.stream = {}, []
        begun = False
        for t_s, from_device, data in readers[os.path.splitext(path)[1]](path):
            if not from_device:
                continue
            whole = split(data)[0]
            payload = whole[0][1] if whole else b""
            if not self.answers and not self.stream:
                self.text = data[1:2] != b"\x02"
            if whole and payload[:3] in COMMANDS.values() and not payload.startswith(b"sRA LMDscandata "):
                self.answers.setdefault((payload[:3], name(payload)), payload)
            elif payload[:3] == b"sFA":
                continue  # answers to requests that this client does not make
            else:
                begun = begun or b" LMDscandata " in data
                if begun:
                    self.stream.append((t_s, data))

    def answer(self, payload):
        word, what = COMMANDS.get(payload[:3]), name(payload)
        if payload[:3] == b"sEN" and what == b"LMDscandata":
            return b"sEA" + payload[3:]
        if (word, what) in self.answers:
            return self.answers[word, what]
        if word == b"sWA":
            return b"sWA " + what
        if word == b"sAN" and what in (b"SetAccessMode", b"Run", b"LMCstartmeas"):
            good = 0 if what == b"LMCstartmeas" else 1
            return b"sAN " + what + b" " + (b"%d" % good if self.text else bytes([good]))
        return b"sFA 3" if self.text else b"sFA\x00\x03"


def serve(capture, connection):
    """False: the client went before the capture was over."""
    begin_s, at, rest = None, 0, b""
    while at < len(capture.stream):
        due_s = None if begin_s is None else max(0, begin_s + capture.stream[at][0] - capture.stream[0][0] - time.monotonic())
        if select.select([connection], [], [], due_s)[0]:
            received = connection.recv(65536)
            if not received:
                return False
            frames, rest = split(rest + received)
            for text, payload in frames:
                if text != capture.text:
                    continue
                connection.sendall(frame(capture.text, capture.answer(payload)))
                if payload[:16] == b"sEN LMDscandata ":
                    on = payload[-1:] in (b"1", b"\x01")
                    begin_s = (begin_s or time.monotonic()) if on else None
        else:
            connection.sendall(capture.stream[at][1])
            at += 1
    return True


def main(path, port_file):
    capture = Capture(path)
    listener = socket.create_server(("127.0.0.1", 0))
    with open(port_file + ".new", "w", encoding="ascii") as file:
        file.write(str(listener.getsockname()[1]))
    os.rename(port_file + ".new", port_file)
    while True:
        connection = listener.accept()[0]
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        try:
            done = serve(capture, connection)
        except OSError:
            done = False
        if done:
            listener.close()
            print("played", flush=True)
            time.sleep(600)
        print("the client went before the capture was over", flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
