#!/usr/bin/env python3
"""Takes a list kept by `facetd --journal` apart into what people have: a capture of the scanner's TCP (pcap), a candump log, poses as
JSON lines. Segments are cut, swapped and repeated as networks do it, so that reading them back is no matter of course.

    journal_parts.py JOURNAL OUT LASER SERVO POSE     the places of the devices in the configuration; writes OUT.pcap, .pcapng, .log,
    .jsonl, and OUT.ended, the list as these tell it, with the ticks that a replay of them makes up
"""
import json
import struct
import sys


def entries(data):
    at = 8
    while at < len(data):
        kind = data[at]
        if kind == 1:
            at += 5 + struct.unpack_from("<I", data, at + 1)[0]
        elif kind == 2:
            log_ns, t_ns, device, direction, n = struct.unpack_from("<qqBBI", data, at + 1)
            yield log_ns, t_ns, device, direction, data[at + 23:at + 23 + n]
            at += 23 + n
        else:
            at += 9


def packet(source, target, sequence, flags, payload):
    tcp = struct.pack(">HHIIBBHHH", source[1], target[1], sequence & 0xffffffff, 0, 0x50, flags, 65535, 0, 0) + payload
    head = struct.pack(">BBHHHBBH4s4s", 0x45, 0, 20 + len(tcp), 0, 0, 64, 6, 0, bytes(source[0]), bytes(target[0]))
    return b"\0" * 12 + b"\x08\x00" + head + tcp


def block(kind, body):
    """Of a pcapng file."""
    body += b"\0" * (-len(body) % 4)
    return struct.pack("<II", kind, len(body) + 12) + body + struct.pack("<I", len(body) + 12)


def pcapng(packets):
    """One section, one interface with times in ns, a packet a block."""
    ret = block(0x0A0D0D0A, struct.pack("<IHHq", 0x1A2B3C4D, 1, 0, -1))
    ret += block(1, struct.pack("<HHIHHBxxxHH", 1, 0, 65535, 9, 1, 9, 0, 0))
    for t_ns, data in packets:
        ret += block(6, struct.pack("<IIIII", 0, t_ns >> 32, t_ns & 0xffffffff, len(data), len(data)) + data)
    return ret


def ticks(times):
    """Ten a second, before what is of the same time; where nothing comes for long, at its beginning only."""
    now, tick = times[0], times[0] + 10**8
    for t_ns in times:
        while tick <= t_ns:
            yield tick
            tick += 10**8
            if t_ns - tick > 3 * 10**9 and tick - now > 3 * 10**9:
                tick = t_ns
        now = t_ns


def main():
    path, out = sys.argv[1:3]
    laser, servo, pose = map(int, sys.argv[3:6])
    host, port = "127.0.0.1", 2112
    if len(sys.argv) > 6:
        host, port = sys.argv[6].rsplit(":", 1)
    server = (tuple(map(int, host.split("."))), int(port))
    client, sequence, packets, said = None, None, [], 0
    with open(path, "rb") as f:
        data = f.read()
    log, poses, merged = [], [], []
    for log_ns, t_ns, device, direction, payload in entries(data):
        if device == laser:
            merged.append((t_ns, 0, device, direction, payload))
        if device == laser and direction == 2:
            if client:  # else a second program's words to the scanner, which are not followed before the first is silent
                packets.append((t_ns, packet(client, server, sequence[1], 17, b"")))
            client = ((10, 0, 0, 1), 40000 + said)
            said += 1
            sequence = [0xfffffff0, 77]  # wraps
            packets.append((t_ns, packet(client, server, sequence[1], 2, b"")))
            packets.append((t_ns, packet(server, client, sequence[0], 18, b"")))
            sequence = [sequence[0] + 1, sequence[1] + 1]
        elif device == laser:
            ends = (server, client) if direction == 0 else (client, server)
            half = len(payload) // 2
            pieces = [(half, payload[half:]), (0, payload[:half]), (0, payload)]  # swapped, then once more whole
            if direction == 1 or half < 2 or len(packets) % 3:
                pieces = [(0, payload)]
            for at, piece in pieces:
                packets.append((t_ns, packet(*ends, sequence[direction] + at, 24, piece)))
            sequence[direction] += len(payload)
        elif device == servo and direction == 0:
            for at in range(0, len(payload), 24):
                number, n, _, _, _ = struct.unpack_from("<IBBBB", payload, at)
                stamp = struct.unpack_from("<q", payload, at + 16)[0]
                merged.append((stamp, 1, device, 0, payload[at:at + 24]))
                name = f"{number & 0x1fffffff:08X}" if number & 0x80000000 else f"{number:03X}"
                log.append((stamp, f"({stamp // 10**9}.{stamp % 10**9:09d}) can0 {name}#{payload[at + 8:at + 8 + n].hex().upper()}"))
        elif device == pose and direction == 0:
            text = json.loads(payload)
            text.setdefault("t", t_ns / 1e9)
            merged.append((int(text["t"] * 1e9), 2, device, 0, json.dumps(text).encode()))
            poses.append(json.dumps(text))
    with open(out + ".pcap", "wb") as f:
        f.write(struct.pack("<IHHiIII", 0xa1b23c4d, 2, 4, 0, 0, 65535, 1))
        for t_ns, data in packets:
            f.write(struct.pack("<IIII", t_ns // 10**9, t_ns % 10**9, len(data), len(data)) + data)
    with open(out + ".pcapng", "wb") as f:
        f.write(pcapng(packets))
    # The same records in the order of these files, and five quiet seconds: what waits is handed out.
    merged.sort(key=lambda r: (r[0], r[1]))
    with open(path, "rb") as f, open(out + ".ended", "wb") as g:
        head = f.read(13)
        g.write(head + f.read(struct.unpack_from("<I", head, 9)[0]))
        due = list(ticks([r[0] for r in merged]))[::-1]
        for t_ns, _, device, direction, payload in merged:
            while due and due[-1] <= t_ns:
                g.write(struct.pack("<Bq", 3, due.pop()))
            g.write(struct.pack("<BqqBBI", 2, t_ns, t_ns, device, direction, len(payload)) + payload)
        g.write(struct.pack("<Bq", 3, merged[-1][0] + 5 * 10**9))
    with open(out + ".log", "w", encoding="ascii") as f:
        f.writelines(line + "\n" for _, line in sorted(log, key=lambda entry: entry[0]))  # equal times stay in their order
    with open(out + ".jsonl", "w", encoding="ascii") as f:
        f.writelines(line + "\n" for line in poses)


main()
