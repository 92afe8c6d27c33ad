#!/usr/bin/env python3
"""The map of a running facetd, in Python: standard library only, 3.9 or later.

    import facet
    with facet.Client("unix:/run/facetd/facetd.sock") as client:   # None: $FACETD, the user's socket, the system's
        for commit in client.commits():
            print(commit.step, len(commit.changed), "patches changed", len(client.patches), "in all")

A patch is a cube of 16 cells a side with one mesh. `vertices` are points of the lattice of 1/256 cell, integers 0 .. 4096
within the patch; `client.metres(patch)` are they in the map frame (x forward, y left, z up). `triangles` are counter-clockwise
seen from the free side; `runs` say which of them lie in one plane and are of one class. Patches never change: a commit
replaces them. `client.patches` is the map of one step, whole; it changes only while commits() is asked for the next one.

Errors are facet.Error, with a sentence. commits(reconnect=True) goes on through a restart of the daemon.

    python3 facet.py [ADDRESS] [-o OUT.ply] [--box X0,Y0,Z0,X1,Y1,Z1 | --radius M] [--coded] [--commits N] [--hash]
"""
import argparse
import base64
import collections
import hashlib
import json
import os
import socket
import struct
import sys
import time
import urllib.parse

PORT = 7878
LATTICE = 256
SIDE = 16
NO_PLANE = 0xFFFFFFFF
FRAME_MAX = 16 << 20
BATCH_MAX = 1 << 20
KEY_LIMIT = 1 << 18
HELLO, WANT, BEGIN, PATCH, REMOVE, PLANE, PLANE_GONE, COMMIT, ABORT, JSON, PING, CODED = range(1, 13)
WANT_CODED, WANT_BOX, WANT_RADIUS = 2, 4, 8

Run = collections.namedtuple("Run", "plane cls triangles")
Patch = collections.namedtuple("Patch", "key version t_first_ns t_last_ns vertices triangles runs")
Hello = collections.namedtuple("Hello", "major minor map_id generation cell_m step t_ns")
Commit = collections.namedtuple("Commit", "step reset changed removed")


class Error(Exception):
    """What is wrong and what to do, in one sentence."""


# Patches as PATCH frames carry them ----------------------------------------------------------------------------------------


def _check(patch):
    """A patch that may be drawn without another look."""
    nv = len(patch.vertices)
    if nv < 3 or not patch.triangles or sum(run.triangles for run in patch.runs) != len(patch.triangles):
        raise Error("a patch whose counts are impossible")
    if any(abs(k) > KEY_LIMIT for k in patch.key):
        raise Error("a patch beyond the limits of the map")
    if any(c < 0 or c > SIDE * LATTICE for v in patch.vertices for c in v):
        raise Error("a patch with a vertex outside of it")
    if any(i >= nv for t in patch.triangles for i in t):
        raise Error("a patch with an index beyond its vertices")
    return patch


def _triples(flat):
    return list(zip(flat[0::3], flat[1::3], flat[2::3]))


def decode_patch(data):
    if len(data) < 42:
        raise Error("a PATCH that is too short")
    key = struct.unpack_from("<3i", data)
    version, first, last, nv, nt, nr = struct.unpack_from("<QqqHHH", data, 12)
    width = "B" if nv <= 256 else "H"
    at = 42 + 6 * nv + 7 * nr
    if len(data) != at + 3 * nt * struct.calcsize(width):
        raise Error("a PATCH whose length is not that of its counts")
    vertices = _triples(struct.unpack_from(f"<{3 * nv}H", data, 42))
    runs = [Run(*struct.unpack_from("<IBH", data, 42 + 6 * nv + 7 * i)) for i in range(nr)]
    triangles = _triples(struct.unpack_from(f"<{3 * nt}{width}", data, at))
    return _check(Patch(key, version, first, last, vertices, triangles, runs))


# Patches as CODED frames carry them (docs/protocol.md; core/coded.c is the other reader) ---------------------------------

_COUNT, _CLASS, _KIND, _STEP, _REST, _RANK = 17, 9, 2, 5, 13, 5
_EDGES, _NEAR, _WINDOW, _CERTAIN, _SLOWEST, _LEAST = 24, 16, 256, 12, 40, 64
_SHARE = 64
_TABLE = base64.b85decode(
    '|A2sifCCQ{C{BZ@nS$lqfPjF2fPjF;c!`jttF@-0+<<_9fPjDuRA_gEjCFMMuz-MofPjF2fL5fYo5a19xv+qMfPjF2fO~Y>{lI{L'
    'fPjF2fPjF2fPjF2s^!3dfPjF2fPjF2fPjF2e}I7d|A2sifPjF2fPjF2fPjF2fPfJ=Y@Nl-pyq&pfPjF2fPjF2iIt|o#*pTKfPjF2'
    'fPjF2fW46L0sZ<#fVhUp0r&G7fXGO>0s8hbfS_Db0n5@SfLMp;0r~qefLxuL0rR&cfNV{B0q^8LfN^VV0o~Le3ca7ZfPmAftpD#Z'
    'U3u|<fRdP$^5Kq{qU(TwrmL9jnHrPN|A2s=w%L{QD2S~4fPkN@(!lXYiG9a_fW@Af|DQHyeBywBqMw@nmq~P*-++Llt)>4nda9@O'
    'fPl%duls&NfUNs~fT^jz^3iD0tJQ#j!nmma;!~_$>wtjgu7vubK=jP_fPna|pTHl+=HBptfZ)B-)zVAG$o_zU&$q>Zt8lM@yMTbh'
    'u95$<UY&o|fPl`phWv>>%$(YQfa$E7{UNZ@vGIU_+@{Iycv8C0{eXbYyyk$nmGrB&fPm=4rT^V|!#j<DfbWLh|ARgM_<(?b|HXiS'
    '4(a^a=750ozUF|-m;Zo(fPm$IfPnvifPjF2fPjF2fPjF2fPjF2fPjF2fPjF2fPjF2fPjF2fPjF2fPjF2fPjF2fPjF2fPjF2fPf7e'
    '9UUDkMgM?+fPjF2i=3Q<gqJdafPjF2j|>_hASp#||A2sifPjF6jGCp9nOlH>fPjFK2^t_MF-?L0fPjF2fPjmak&=~@cYuI^fPjo1'
    '3>PIrYMuXpfPjF2fO(6BkCdIhfPjF2fO{bj9V|m;sQ-X~fPjF2iG`1ilbf@EfPjF2dm<MbDnMkS|A2sifPjFLiHwhwnzMj_fPjF0'
    'fQZCL*noXAfStWp%ZG_QfL@tUwsLq<fcx<4>#d#qc8`{ni;et%n4o`;hK_%UjdpN}{D6RffcWJ6;hnYhnUs#4m6P>=R@{(>f{llU'
    'jE{bg^?-nYfcxtE<*=sox0afciIDVwS<sG!kBo+ohK-kt^nieXfcx$I(X*xKn3<`Uo2BT0UcQlxn1q&sjEsbf=zxHLfcDw=;-s_q'
    'gnp2Wimmv7PV9n#fQXQSoQ<ZV_<(?bfc^FT^`*gp_=$s)m#=_;`iFUVsBVQ@powsxfPjF2fcaX0fb((tfcSO_fYGChtGDy>4oh=;'
    'pRI@Q_JDwZfPjF2fPjpyq@c^1rS^b;fPjF2fPlD4CNornzU20RfPjF2fPjF2fT)R=nY_o(fPjF2fPjF2fSk+5vZ{c9!oIlwg`l91'
    'fPl5SwEu0Ws;_{6vbeJUNqnWQfPkZ_#Q&(ZpQC_)!L+Xbc!-p5fPkR9y#E13Phomz9O&zSfPjF2fPjF2lB1ucpOBjCfPjF2fPjF2'
    '&H)}6A08G2@BM&)fPjF2fPjFqi=vXYx1{}mfPjF2fPjE('
)


def _layout():
    """Where the contexts of each kind begin in the table."""
    at, places = 0, {}
    for name, size in (
        ("rotated", 1), ("rotation", 4), ("triangles", 2 * _COUNT), ("vertices", 2 * _COUNT + 1), ("runs", 2 * _COUNT),
        ("plane", 2 * _KIND), ("class", 2 * _CLASS), ("share", 2 * _COUNT), ("mask", 64), ("step", 30 * (2 * _STEP + 1)),
        ("rest", 6 * (2 * _REST + 1)), ("low", 24), ("edge", 192), ("corner", 16), ("fresh", 4),
        ("first", 2 * (2 * _COUNT + 1)), ("rank", 12 * _RANK), ("far", 2 * (2 * _COUNT + 1)),
    ):
        places[name] = at
        at += size
    assert at == len(_TABLE)
    return places


_AT = _layout()
_RATE = [65536 // (n + 2) for n in range(_SLOWEST + 1)]


class _Decisions:
    """A range decoder: each decision has a probability that its context has learnt so far."""

    def __init__(self, data):
        self.data = data
        self.at = 4
        self.code = int.from_bytes(data[:4].ljust(4, b"\0"), "big")
        self.range = 0xFFFFFFFF
        self.p = [p << 8 for p in _TABLE]
        self.n = [_CERTAIN] * len(_TABLE)

    def _narrow(self, zero):
        bit = self.code >= zero
        if bit:
            self.code -= zero
            self.range -= zero
        else:
            self.range = zero
        while self.range < 1 << 24:
            self.range = self.range << 8 & 0xFFFFFFFF
            self.code = (self.code << 8 | (self.data[self.at] if self.at < len(self.data) else 0)) & 0xFFFFFFFF
            self.at += 1
        return int(bit)

    def bit(self, i):
        p, n = self.p[i], self.n[i]
        bit = self._narrow((self.range >> 16) * p)
        p = p - (p * _RATE[n] >> 16) if bit else p + ((65536 - p) * _RATE[n] >> 16)
        self.p[i] = min(max(p, _LEAST), 65536 - _LEAST)
        if n < _SLOWEST:
            self.n[i] = n + 1
        return bit

    def raw(self, bits):
        got = 0
        for _ in range(bits):
            got = got << 1 | self._narrow(self.range >> 1)
        return got

    def tree(self, at, bits):
        node = 1
        for _ in range(bits):
            node = node << 1 | self.bit(at + node)
        return node - (1 << bits)

    def number(self, at, most):
        bits, got = 0, 1
        while bits < most - 1 and self.bit(at + bits):
            bits += 1
        if bits > 0:
            got = 2 | self.bit(at + most + bits)
        if bits > 1:
            got = got << (bits - 1) | self.raw(bits - 1)
        return got - 1

    def signed(self, at, most):
        size = self.number(at, most)
        return -size if size and self.bit(at + 2 * most) else size


def _code_runs(coder, nt, nruns):
    runs, left, following = [], nt, 0
    for i in range(nruns):
        kind = coder.number(_AT["plane"], _KIND)
        plane = NO_PLANE if kind == 0 else following if kind == 1 else coder.raw(32)
        cls = coder.number(_AT["class"], _CLASS) & 0xFF
        n = left if i + 1 == nruns else 1 + coder.number(_AT["share"], _COUNT) & 0xFFFF
        if n == 0 or n > left:
            raise Error("a CODED patch whose runs do not add up to its triangles")
        left -= n
        if plane != NO_PLANE:
            following = plane + 1 & 0xFFFFFFFF
        runs.append(Run(plane, cls, n))
    return runs


def _code_coordinate(coder, axis, moved, free, alone, last, like):
    start, stood = last // LATTICE, None if like is None else like // LATTICE
    kind = 0 if not free else 1 if like is None else 2 if stood < start else 3 if stood == start else 4
    cell = start + coder.signed(_AT["step"] + ((axis * 2 + moved) * 5 + kind) * (2 * _STEP + 1), _STEP)
    if not free:
        return cell * LATTICE
    if like is not None and stood == cell:
        return like + coder.signed(_AT["rest"] + (alone * 3 + axis) * (2 * _REST + 1), _REST)
    apart = 0 if like is None else cell - stood
    high = coder.tree(_AT["low"] + 8 * (1 if apart == 1 else 2 if apart == -1 else 0), 3)
    return cell * LATTICE + (high << 5 | coder.raw(5))


def _code_vertices(coder, nv):
    vertices, last, mask, seen = [], (0, 0, 0), 0, {}
    for _ in range(nv):
        mask = coder.tree(_AT["mask"] + 8 * mask, 3)
        like, at, moved = seen.get(mask), [0, 0, 0], 0
        for axis in (2, 1, 0):
            at[axis] = _code_coordinate(coder, axis, moved, mask >> axis & 1, int(mask & (mask - 1) == 0), last[axis],
                                        like and like[axis])
            if not 0 <= at[axis] <= SIDE * LATTICE:
                raise Error("a CODED patch with a vertex outside of it")
            moved |= at[axis] // LATTICE != last[axis] // LATTICE
        last = seen[mask] = tuple(at)
        vertices.append(last)
    return vertices


class _Trace:
    """What the triangles before tell of the next one."""

    def __init__(self, coder, vertices):
        self.coder = coder
        self.vertices = vertices
        self.edges = []  # open ones: from, to, the corner beside; newest first
        self.used = bytearray(len(vertices))

    def near(self, corner, used, place, but, about):
        nv, v = len(self.vertices), self.vertices
        begin, end = 0, nv
        if nv > _WINDOW:
            begin = max(0, about - _WINDOW // 2)
            end = min(begin + _WINDOW, nv)
        x, y, z = place
        near = sorted(((2 * v[i][0] - x) ** 2 + (2 * v[i][1] - y) ** 2 + (2 * v[i][2] - z) ** 2, i)
                      for i in range(begin, end) if self.used[i] == used and i not in but)
        rank = self.coder.number(_AT["rank"] + (corner * 2 + used) * 2 * _RANK, _RANK)
        if rank < min(len(near), _NEAR):
            return near[rank][1]
        i = about + self.coder.signed(_AT["far"] + used * (2 * _COUNT + 1), _COUNT)
        if not 0 <= i < nv:
            raise Error("a CODED patch with an index beyond its vertices")
        return i

    def middle(self, a, b):
        return [p + q for p, q in zip(self.vertices[a], self.vertices[b])]

    def beside(self, edge):
        a, b, beyond = self.edges[edge]
        after = next((e[1] for e in self.edges if e[0] == b and e[1] != a), None)
        before = next((e[0] for e in self.edges if e[1] == a and e[0] != b), None)
        kind = self.coder.tree(_AT["corner"] + 4 * ((after is not None) + 2 * (before is not None)), 2)
        if kind >= 2:
            corner = after if kind == 2 else before
            if corner is None:
                raise Error("a CODED patch with an index beyond its vertices")
            return [b, a, corner]
        return [b, a, self.near(0, kind, self.middle(a, b), (a, b, beyond), max(a, b))]

    def alone(self, begins, last):
        a = last[0] + self.coder.signed(_AT["first"] + begins * (2 * _COUNT + 1), _COUNT)
        if not 0 <= a < len(self.vertices):
            raise Error("a CODED patch with an index beyond its vertices")
        b = self.near(1, self.coder.bit(_AT["fresh"] + 2 * begins), self.middle(a, a), (a,), a)
        return [a, b, self.near(2, self.coder.bit(_AT["fresh"] + 2 * begins + 1), self.middle(a, b), (a, b), b)]

    def add(self, triangle):
        a, b, c = triangle
        for i in triangle:
            self.used[i] = 1
        for start, end, beside in ((a, b, c), (b, c, a), (c, a, b)):
            for i, edge in enumerate(self.edges):
                if edge[0] == end and edge[1] == start:
                    del self.edges[i]
                    break
            else:
                self.edges.insert(0, (start, end, beside))
                del self.edges[_EDGES:]


def _code_triangles(coder, vertices, nt, runs, rotated):
    trace, triangles, last, context = _Trace(coder, vertices), [], [0, 0, 0], 0
    begins, at = set(), 0
    for run in runs:
        begins.add(at)
        at += run.triangles
    for i in range(nt):
        first = int(i in begins)
        edge = coder.tree(_AT["edge"] + 32 * (5 if first else context), 5)
        context = edge if edge < 3 else 3 if edge < 8 else 4
        if edge > len(trace.edges):
            raise Error("a CODED patch with a triangle at an edge that is not there")
        got = trace.beside(edge - 1) if edge else trace.alone(first, last)
        if len(set(got)) < 3:
            raise Error("a CODED patch with a triangle that uses a vertex twice")
        turn = got.index(min(got))
        last = got[turn:] + got[:turn]
        turn = coder.tree(_AT["rotation"], 2) % 3 if rotated else 0
        triangles.append(tuple(last[3 - turn:] + last[:3 - turn]))
        trace.add(last)
    return triangles


def _varint(data, at):
    value = shift = 0
    while at < len(data) and shift < 70:
        value |= (data[at] & 0x7F) << shift
        at += 1
        if data[at - 1] < 0x80:
            return value, at
        shift += 7
    raise Error("a CODED patch that is not whole")


def _unzigzag(value):
    return value >> 1 ^ -(value & 1)


def decode_coded(data):
    """All patches of a CODED message."""
    patches, at = [], 0
    while at < len(data):
        n, at = _varint(data, at)
        if n > len(data) - at:
            raise Error("a CODED patch that is not whole")
        patches.append(_decode_one(data[at:at + n]))
        at += n
    return patches


def _decode_one(data):
    key, at = [], 0
    for _ in range(3):
        value, at = _varint(data, at)
        key.append(_unzigzag(value))
    version, at = _varint(data, at)
    if len(data) - at < 16:
        raise Error("a CODED patch that is too short")
    last, first = struct.unpack_from("<qq", data, at)
    body = data[at + 16:]
    coder = _Decisions(body)
    nt = 1 + coder.number(_AT["triangles"], _COUNT)
    nv = nt + coder.signed(_AT["vertices"], _COUNT)
    nruns = 1 + coder.number(_AT["runs"], _COUNT)
    if nt > 65535 or not 3 <= nv <= 65535 or nruns > nt or nv + nt > len(body) * _SHARE:
        raise Error("a CODED patch with impossible counts")
    rotated = coder.bit(_AT["rotated"])
    runs = _code_runs(coder, nt, nruns)
    vertices = _code_vertices(coder, nv)
    triangles = _code_triangles(coder, vertices, nt, runs, rotated)
    return _check(Patch(tuple(key), version, first, last, vertices, triangles, runs))


# The connection ------------------------------------------------------------------------------------------------------------


def default_address():
    if os.environ.get("FACETD"):
        return os.environ["FACETD"]
    own = os.path.join(os.environ.get("XDG_RUNTIME_DIR", ""), "facetd.sock")
    return "unix:" + (own if os.environ.get("XDG_RUNTIME_DIR") and os.path.exists(own) else "/run/facetd/facetd.sock")


class _WebSocket:
    """The bytes within a WebSocket (RFC 6455), with what Client asks of a socket."""

    def __init__(self, address, timeout_s):
        url = urllib.parse.urlsplit(address)
        target = (url.path or "/") + ("?" + url.query if url.query else "")
        key = base64.b64encode(os.urandom(16)).decode()
        self._in, self._reason = bytearray(), None
        self._sock = socket.create_connection((url.hostname or "", url.port or 7880), timeout_s)
        try:
            self._sock.sendall(f"GET {target} HTTP/1.1\r\nHost: {url.netloc}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
                               f"Sec-WebSocket-Key: {key}\r\nSec-WebSocket-Version: 13\r\n"
                               "Sec-WebSocket-Protocol: facetd.v1\r\n\r\n".encode())
            while b"\r\n\r\n" not in self._in:
                more = self._sock.recv(4096)
                if not more or len(self._in) > 8192:
                    raise Error(f"{url.netloc} does not answer as facetd's listen.http does")
                self._in += more
            self._judge(url.netloc, key)
        except BaseException:
            self._sock.close()
            raise

    def _judge(self, where, key):
        head, _, rest = bytes(self._in).partition(b"\r\n\r\n")
        status, *lines = head.decode("latin-1").split("\r\n")
        fields = {name.strip().lower(): value.strip() for name, _, value in (line.partition(":") for line in lines)}
        if status.split(" ")[1:2] in (["401"], ["403"]):
            raise Error(f"{where} wants another token; write ws://HOST:PORT/?token=TOKEN")
        accept = base64.b64encode(hashlib.sha1((key + "258EAFA5-E914-47DA-95CA-C5AB0DC85B11").encode()).digest()).decode()
        if status.split(" ")[1:2] != ["101"] or fields.get("sec-websocket-accept") != accept \
                or fields.get("sec-websocket-protocol") != "facetd.v1":
            raise Error(f"{where} opens no WebSocket for facetd.v1 ({status}); is listen.http of facetd there?")
        self._in = bytearray(rest)

    def fileno(self):
        return self._sock.fileno()

    def settimeout(self, seconds):
        self._sock.settimeout(seconds)

    def close(self):
        self._sock.close()

    def sendall(self, data, opcode=2):
        mask = os.urandom(4)
        n = len(data)
        size = struct.pack(">B", 0x80 | n) if n < 126 else struct.pack(">BH", 0xFE, n) if n < 65536 else struct.pack(">BQ", 0xFF, n)
        self._sock.sendall(bytes([0x80 | opcode]) + size + mask + bytes(b ^ mask[i & 3] for i, b in enumerate(data)))

    def _take(self):
        """(opcode, payload) of the first frame, or None while it is not whole."""
        data = self._in
        if len(data) < 2:
            return None
        n, at = data[1], 2
        if n >= 126:
            wide = 2 if n == 126 else 8
            if len(data) < 2 + wide:
                return None
            n, at = int.from_bytes(data[2:2 + wide], "big"), 2 + wide
        if data[0] & 0x70 or data[1] & 0x80 or n > FRAME_MAX:
            raise OSError("a WebSocket frame that no server sends")
        if len(data) < at + n:
            return None
        frame = data[0] & 15, bytes(data[at:at + n])
        del data[:at + n]
        return frame

    def recv(self, n):
        while True:
            frame = self._take()
            if frame is None:
                more = self._sock.recv(n)
                if not more:
                    return more
                self._in += more
            elif frame[0] == 8:
                self.sendall(frame[1][:2], 8)
                raise OSError(frame[1][2:].decode(errors="replace") or "the daemon closed it")
            elif frame[0] == 9:
                self.sendall(frame[1], 10)
            elif frame[0] in (0, 2) and frame[1]:
                return frame[1]


def _connect(address, timeout_s):
    kind, _, rest = address.partition(":")
    if kind == "ws":
        return _WebSocket(address, timeout_s)
    if kind == "wss":
        raise Error(f"{address}: TLS is for browsers; use ssh -L 7880:127.0.0.1:7880 HOST and ws://127.0.0.1:7880/")
    if kind == "unix":
        sock = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        sock.settimeout(timeout_s)
        try:
            sock.connect(rest)
        except OSError:
            sock.close()
            raise
        return sock
    if kind == "tcp":
        host, colon, port = rest.rpartition(":")
        if not colon or rest.endswith("]"):
            host, port = rest, str(PORT)
        if not port.isdigit():
            raise Error(f"{address} is not an address: the port is no number")
        return socket.create_connection((host.strip("[]"), int(port)), timeout_s)
    raise Error(f"{address} is not an address: write unix:PATH, tcp:HOST:PORT or ws://HOST:PORT/")


class Client:
    """One connection and the map that came through it. `box`: min x y z, max x y z (m); `radius_m`: about the robot."""

    def __init__(self, address=None, box=None, radius_m=None, bytes_per_s=0, coded=False, timeout_s=5.0):
        self.address = address or default_address()
        self.timeout_s = timeout_s
        self.hello = None
        self.step = None
        self.patches = {}  # by key
        self.on_json = None  # called with every JSON message that comes between
        self.bytes = 0  # read so far
        self._wish = (box, radius_m, bytes_per_s, coded)
        self._batch = None
        self._reason = None
        self._sock = None
        self._data = bytearray()
        self._open()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()

    def close(self):
        if self._sock:
            self._sock.close()
        self._sock = None

    def _open(self):
        self.close()
        self._data.clear()
        self._batch = self._reason = None
        try:
            self._sock = _connect(self.address, self.timeout_s)
        except OSError as error:
            raise Error(f"no daemon answers at {self.address} ({error.strerror or error}); start facetd, or say where it is "
                        "(ADDRESS or $FACETD)") from None
        box, radius_m, bytes_per_s, coded = self._wish
        if box and radius_m:
            raise Error("a box and a radius at once cannot be wanted; choose one")
        region = list(box) if box else [radius_m or 0, 0, 0, 0, 0, 0]
        flags = (WANT_CODED if coded else 0) | (WANT_BOX if box else 0) | (WANT_RADIUS if radius_m else 0)
        self._send(WANT, struct.pack("<B3xI6f", flags, bytes_per_s, *region))

    def _send(self, kind, payload):
        if (len(payload) + 4) & 0xFF in (0x3F, 0x7B):
            payload += b" "
        try:
            self._sock.sendall(struct.pack("<IBBH", 4 + len(payload), kind, 0, 0) + payload)
        except OSError as error:
            raise Error(f"{self.address}: the connection is lost ({error})") from None

    def say(self, command):
        """A command, e.g. "?STATUS"; the answer comes to on_json."""
        self._send(JSON, command.encode())

    def fileno(self):
        return self._sock.fileno()

    def _frame(self, until):
        """The next frame, or None when the time is over."""
        while True:
            if len(self._data) >= 8:
                length, kind, flags, zero = struct.unpack_from("<IBBH", self._data)
                if length < 4 or length > FRAME_MAX - 4 or zero or flags:
                    raise Error(f"{self.address}: the length of a frame is impossible")
                if len(self._data) >= 4 + length:
                    payload = bytes(self._data[8:4 + length])
                    del self._data[:4 + length]
                    return kind, payload
            left = None if until is None else until - time.monotonic()
            if left is not None and left <= 0:
                return None
            self._sock.settimeout(left)
            try:
                got = self._sock.recv(1 << 18)
            except socket.timeout:
                return None
            except OSError as error:
                raise Error(f"{self.address}: the connection is lost ({error})") from None
            if not got:
                raise Error(f"{self.address}: the connection is lost ({self._reason or 'the daemon closed it'})")
            self.bytes += len(got)
            self._data += got

    def next(self, timeout_s=None):
        """The next commit, or None when the time is over (None: never)."""
        until = None if timeout_s is None else time.monotonic() + timeout_s
        while True:
            frame = self._frame(until)
            commit = frame and self._apply(*frame)
            if not frame or commit:
                return commit

    def commits(self, timeout_s=None, reconnect=False):
        """Every commit, until none comes for `timeout_s`."""
        while True:
            try:
                if not self._sock:
                    self._open()
                commit = self.next(timeout_s)
            except Error:
                if not reconnect:
                    raise
                self.close()
                time.sleep(1)
                continue
            if commit is None:
                return
            yield commit

    # A batch collects beside the map and goes in whole, after its announced counts were found true.

    def _apply(self, kind, payload):
        if kind == HELLO:
            hello = Hello(*struct.unpack("<HH16sIdQq", payload))
            if hello.major != 1:
                raise Error(f"{self.address}: the daemon speaks version {hello.major} of the protocol, this program 1")
            self.hello = hello
        elif kind == BEGIN:
            self._begin(*struct.unpack("<QIIB", payload))
        elif kind == PATCH:
            self._put([decode_patch(payload)])
        elif kind == CODED:
            self._put(decode_coded(payload))
        elif kind == REMOVE:
            self._need_batch().removed.append(struct.unpack("<3i", payload))
        elif kind == COMMIT:
            return self._commit(*struct.unpack("<Q", payload))
        elif kind == ABORT:
            self._batch = None
        elif kind == JSON:
            self._hear(payload)
        return None

    def _need_batch(self):
        if not self._batch:
            raise Error(f"{self.address}: a message outside of a batch")
        return self._batch[0]

    def _begin(self, step, patches, removals, reset):
        if not self.hello or self._batch or reset > 1 or max(patches, removals) > BATCH_MAX:
            raise Error(f"{self.address}: a BEGIN where none may be, or of an impossible batch")
        self._batch = (Commit(step, bool(reset), [], []), patches, removals)

    def _put(self, patches):
        batch = self._need_batch()
        batch.changed.extend(patches)
        if len(batch.changed) > self._batch[1] or any(p.version > batch.step for p in patches):
            raise Error(f"{self.address}: more patches than announced, or newer ones than their batch")

    def _commit(self, step):
        commit = self._need_batch()
        if step != commit.step or (len(commit.changed), len(commit.removed)) != self._batch[1:]:
            raise Error(f"{self.address}: a COMMIT before everything announced has come")
        self._batch = None
        if commit.reset:
            self.patches.clear()
        for key in commit.removed:
            self.patches.pop(key, None)
        for patch in commit.changed:
            self.patches[patch.key] = patch
        self.step = step
        return commit

    def _hear(self, payload):
        try:
            message = json.loads(payload)
        except ValueError:
            return
        if isinstance(message, dict):
            self._reason = message.get("error", self._reason)
            if self.on_json:
                self.on_json(message)

    # What to do with the map

    def metres(self, patch):
        """The vertices of a patch in the map frame. Through integers, so that equal points of two patches are equal."""
        cell, start = self.hello.cell_m, [k * SIDE * LATTICE for k in patch.key]
        return [tuple((s + c) / LATTICE * cell for s, c in zip(start, v)) for v in patch.vertices]

    def sorted_patches(self):
        return [self.patches[key] for key in sorted(self.patches, key=lambda k: (k[2], k[1], k[0]))]

    def hash(self):
        """SHA-256 of the map, as `facet reconstruct --stats` prints it."""
        sha = hashlib.sha256()
        for patch in self.sorted_patches():
            sha.update(struct.pack("<3iII", *patch.key, len(patch.vertices), len(patch.triangles)))
            sha.update(b"".join(struct.pack("<3H", *v) for v in patch.vertices))
            sha.update(b"".join(struct.pack("<3I", *t) for t in patch.triangles))
            planes, before = 0, None
            for run in patch.runs:
                if run.plane != NO_PLANE:
                    planes += run.plane != before
                before = run.plane
                sha.update(struct.pack("<II", NO_PLANE if run.plane == NO_PLANE else planes - 1, run.triangles))
        return sha.hexdigest()

    def write_ply(self, path):
        """One mesh, welded where lattice points are equal; written beside and renamed."""
        index, faces = {}, []
        for patch in self.sorted_patches():
            start = [k * SIDE * LATTICE for k in patch.key]
            ids = [index.setdefault(tuple(s + c for s, c in zip(start, v)), len(index)) for v in patch.vertices]
            faces += [(ids[a], ids[b], ids[c]) for a, b, c in patch.triangles]
        cell = self.hello.cell_m
        with open(path + ".part", "wb") as out:
            out.write(f"ply\nformat binary_little_endian 1.0\nelement vertex {len(index)}\nproperty double x\n"
                      f"property double y\nproperty double z\nelement face {len(faces)}\n"
                      "property list uchar uint vertex_indices\nend_header\n".encode())
            out.write(b"".join(struct.pack("<3d", *(c / LATTICE * cell for c in point)) for point in index))
            out.write(b"".join(struct.pack("<B3I", 3, *face) for face in faces))
        os.replace(path + ".part", path)
        return len(index), len(faces)


def _numbers(n):
    def parse(text):
        values = [float(t) for t in text.split(",")]
        if len(values) != n:
            raise argparse.ArgumentTypeError(f"{n} numbers are needed")
        return values
    return parse


def main():
    parser = argparse.ArgumentParser(description="Follows the map of a running facetd; with -o, saves it and ends.")
    parser.add_argument("address", nargs="?", help="unix:PATH, tcp:HOST:PORT or ws://HOST:PORT/; default: $FACETD, the user's socket, the system's")
    parser.add_argument("-o", metavar="OUT.ply", help="write the first whole map (see --commits) to this file")
    parser.add_argument("--box", type=_numbers(6), metavar="X0,Y0,Z0,X1,Y1,Z1", help="only patches that reach into it (m)")
    parser.add_argument("--radius", type=float, metavar="M", help="only patches about the robot")
    parser.add_argument("--coded", action="store_true", help="few bytes a triangle, more work here: for slow networks")
    parser.add_argument("--commits", type=int, metavar="N", help="end after so many")
    parser.add_argument("--timeout", type=float, metavar="S", help="end when nothing came for so long")
    parser.add_argument("--hash", action="store_true", help="at the end, print the hash of the map")
    parser.add_argument("--reconnect", action="store_true", help="go on through a restart of the daemon")
    asked = parser.parse_args()
    left = asked.commits or (1 if asked.o else None)
    try:
        with Client(asked.address, box=asked.box, radius_m=asked.radius, coded=asked.coded) as client:
            for commit in client.commits(asked.timeout, asked.reconnect):
                print(f"step {commit.step}: {len(commit.changed)} patches changed, {len(commit.removed)} removed"
                      f"{', a new map' if commit.reset else ''}; {len(client.patches)} in all", flush=True)
                left = left and left - 1
                if left == 0:
                    break
            if asked.hash:
                print("hash", client.step, client.hash())
            if asked.o and client.hello:
                print("%s: %u vertices, %u faces" % (asked.o, *client.write_ply(asked.o)))
    except Error as error:
        print(f"facet.py: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
