"""A client of facetd's web, standard library only: plain requests and WebSockets (RFC 6455), and the native frames in them."""
import base64
import os
import socket
import ssl
import struct


class Closed(Exception):
    """The server closed; .code and .reason as it said, or 0 and nothing."""

    def __init__(self, code=0, reason=""):
        super().__init__(f"{code} {reason}")
        self.code, self.reason = code, reason


def dial(port, tls=None, receive=0, timeout=120):
    s = socket.socket()
    if receive:
        s.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, receive)
    s.settimeout(timeout)
    s.connect(("127.0.0.1", port))
    return tls.wrap_socket(s) if tls else s


def trusting_nobody():
    context = ssl.create_default_context()
    context.check_hostname = False
    context.verify_mode = ssl.CERT_NONE
    return context


def ask(port, path="/", method="GET", headers=(), tls=None, host=None, body=b"", read=True, receive=0):
    """(code, {header: value}, body) of one request on a connection of its own; the socket with read=False."""
    s = dial(port, tls, receive)
    lines = [f"{method} {path} HTTP/1.1", f"Host: {host or f'127.0.0.1:{port}'}", "Connection: close", *headers]
    if body:
        lines.append(f"Content-Length: {len(body)}")
    s.sendall("\r\n".join(lines).encode() + b"\r\n\r\n" + body)
    if not read:
        return s
    with s:
        return read_answer(s, method)


def read_answer(s, method="GET"):
    data = b""
    while b"\r\n\r\n" not in data:
        more = s.recv(65536)
        if not more:
            raise Closed()
        data += more
    head, _, body = data.partition(b"\r\n\r\n")
    status, *lines = head.decode().split("\r\n")
    fields = {k.lower(): v.strip() for k, v in (line.split(":", 1) for line in lines)}
    code = int(status.split()[1])
    length = fields.get("content-length")
    if method == "HEAD" or code == 304:
        length = 0
    while length is None or len(body) < int(length):
        more = s.recv(65536)
        if not more:
            if length is not None:
                raise Closed()
            break
        body += more
    return code, fields, body


class WebSocket:
    def __init__(self, port, path="/native", protocols=("facetd.v1",), headers=(), tls=None, host=None, receive=0):
        self.s = dial(port, tls, receive)
        lines = [f"GET {path} HTTP/1.1", f"Host: {host or f'127.0.0.1:{port}'}", "Upgrade: websocket",
                 "Connection: keep-alive, Upgrade", f"Sec-WebSocket-Key: {base64.b64encode(os.urandom(16)).decode()}",
                 "Sec-WebSocket-Version: 13", *headers]
        if protocols:
            lines.append("Sec-WebSocket-Protocol: " + ", ".join(protocols))
        self.s.sendall("\r\n".join(lines).encode() + b"\r\n\r\n")
        data = b""
        while b"\r\n\r\n" not in data:
            more = self.s.recv(4096)
            if not more:
                raise Closed()
            data += more
        head, _, rest = data.partition(b"\r\n\r\n")
        self.code = int(head.split()[1])
        self.head = head.decode().lower()
        self.data = bytearray(rest)
        self.fragments = 0

    def send(self, opcode, data=b"", final=True):
        mask = os.urandom(4)
        n = len(data)
        head = bytes([(0x80 if final else 0) | opcode])
        if n < 126:
            head += bytes([0x80 | n])
        else:
            head += bytes([0x80 | 126]) + struct.pack(">H", n) if n < 65536 else bytes([0xff]) + struct.pack(">Q", n)
        self.s.sendall(head + mask + bytes(c ^ mask[i & 3] for i, c in enumerate(data)))

    def say(self, text):
        self.send(1, text.encode())

    def want(self, flags=0, bytes_per_s=0):
        self.send(2, native(2, struct.pack("<B3xI6f", flags, bytes_per_s, *[0] * 6)))

    def _take(self, n):
        while len(self.data) < n:
            more = self.s.recv(1 << 16)
            if not more:
                raise Closed()
            self.data += more
        taken = bytes(self.data[:n])
        del self.data[:n]
        return taken

    def message(self):
        """(is it text, its bytes) of the next whole message."""
        kind, whole = None, b""
        while True:
            first, n = self._take(2)
            if n & 0x80:
                raise AssertionError("a server's frame is not masked")
            if n == 126:
                n = struct.unpack(">H", self._take(2))[0]
            elif n == 127:
                n = struct.unpack(">Q", self._take(8))[0]
            data = self._take(n)
            opcode = first & 15
            if opcode == 8:
                raise Closed(struct.unpack(">H", data[:2])[0] if n >= 2 else 0, data[2:].decode())
            if opcode >= 8:
                continue
            assert (opcode == 0) == (kind is not None), "a message begun inside another"
            kind = opcode if opcode else kind
            self.fragments += 1
            whole += data
            if first & 0x80:
                return kind == 1, whole

    def text(self):
        while True:
            is_text, data = self.message()
            if is_text:
                return data.decode()

    def close(self):
        self.s.close()


def native(kind, payload):
    """One frame; no length whose low byte is that of ? or {."""
    while (len(payload) + 4) & 0xff in (0x3f, 0x7b):
        payload += b"\0"
    return struct.pack("<IBBH", len(payload) + 4, kind, 0, 0) + payload


HELLO, WANT, BEGIN, PATCH, REMOVE, COMMIT, ABORT, JSON = 1, 2, 3, 4, 5, 8, 9, 10


class Mirror:
    """What a client holds: PATCH frames by key, changed by whole batches."""

    def __init__(self):
        self.patches, self.coming, self.step, self.commits, self.aborts, self.map, self.texts = {}, None, 0, 0, 0, None, []

    def feed(self, data):
        """Whole frames."""
        at = 0
        while at < len(data):
            (length,) = struct.unpack_from("<I", data, at)
            frame = data[at:at + 4 + length]
            assert len(frame) == 4 + length, "a message that ends inside a frame"
            self.apply(frame)
            at += len(frame)

    def apply(self, frame):
        kind, body = frame[4], frame[8:]
        if kind == HELLO:
            self.map = body[4:20].hex()
        elif kind == BEGIN:
            step, _, _, reset = struct.unpack_from("<QIIB", body)
            self.coming = {} if reset else dict(self.patches)
        elif kind == PATCH:
            self.coming[body[:12]] = frame
        elif kind == REMOVE:
            self.coming.pop(body[:12], None)
        elif kind == COMMIT:
            self.patches, self.coming = self.coming, None
            (self.step,) = struct.unpack_from("<Q", body)
            self.commits += 1
        elif kind == ABORT:
            self.coming = None
            self.aborts += 1
        elif kind == JSON:
            self.texts.append(body.decode())
