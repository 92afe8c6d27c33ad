#!/usr/bin/env python3
"""Bytes a triangle on the wire, of a running daemon's whole map as it is sent to a client that joins: for each way in which
a client can want it, everything from HELLO to COMMIT. Pauses the daemon meanwhile, so that all get the same map.

    bench/wire.py [ADDRESS]     default: $FACETD
"""
import json
import os
import socket
import struct
import sys

WAYS = (("plain", 0), ("plain, zstd", 16), ("coded", 2), ("coded, zstd", 18))
BEGIN, COMMIT, JSON = 3, 8, 10


def connect(address):
    sock = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    sock.connect(address.split(":", 1)[1])
    sock.settimeout(20)
    return sock


def ask(address, command):
    with connect(address) as sock, sock.makefile("rw") as lines:
        lines.write(command + "\n")
        lines.flush()
        for line in lines:
            answer = json.loads(line)
            if answer["class"] != "VERSION":
                return answer
    sys.exit(f"wire: {address} does not answer")


def frames(sock):
    data = b""
    while True:
        while len(data) < 8 or len(data) < 4 + struct.unpack_from("<I", data)[0]:
            got = sock.recv(1 << 18)
            if not got:
                sys.exit("wire: the daemon closed the connection")
            data += got
        n = 4 + struct.unpack_from("<I", data)[0]
        yield data[4], n
        data = data[n:]


def joined(address, flags):
    """Bytes of the first batch, its BEGIN and COMMIT included."""
    with connect(address) as sock:
        sock.sendall(struct.pack("<IBBHB3xI6f", 36, 2, 0, 0, flags, 0, *[0.0] * 6))
        total = 0
        for kind, n in frames(sock):
            total += 0 if kind == JSON else n
            if kind == COMMIT:
                return total


def main():
    address = sys.argv[1] if len(sys.argv) > 1 else os.environ["FACETD"]
    ask(address, "?PAUSE")
    status = ask(address, "?STATUS")
    size = status["map_size"]
    print(f"bytes on the wire, whole map joined late: {size['patches']} patches, {size['triangles_raw']} raw triangles, "
          f"{size['triangles']} reduced")
    for name, flags in WAYS:
        n = joined(address, flags)
        print(f"    {name:<12} {n:8d} bytes, {n / size['triangles']:5.2f} a reduced triangle, "
              f"{n / size['triangles_raw']:5.3f} a raw one")
    ask(address, "?RESUME")


if __name__ == "__main__":
    main()
