"""Judges facetd's web from outside. Every claim is a function; they run in order, on one daemon that maps and on small ones."""
import concurrent.futures
import contextlib
import json
import os
import re
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time

from web_peer import ABORT, Closed, Mirror, WebSocket, ask, dial, native, read_answer, trusting_nobody, JSON

BUILD = sys.argv[1]
TOKEN = "a-token-of-the-test-0123456789"
failures, scratch = [], tempfile.TemporaryDirectory()
LONE = "devices: [{name: pose, driver: pose, fixed: {xyz: [0, 0, 0], rpy: [0, 0, 0]}}]\n"


def path(name):
    return os.path.join(scratch.name, name)


def check(what, sentence):
    if not what:
        failures.append(sentence)
        print(f"FAILED: {sentence}", flush=True)
    return what


def until(condition, seconds=60):
    """Five times as long where the machine is slow, or busy with others."""
    end = time.monotonic() + 5 * seconds
    while time.monotonic() < end:
        value = condition()
        if value:
            return value
        time.sleep(0.05)
    return condition()


class Daemon:
    """facetd on a configuration; `port` of its web once it listens."""

    def __init__(self, name, config, more=()):
        self.config, self.log_path = path(name + ".yaml"), path(name + ".log")
        with open(self.config, "w") as file:
            file.write(config)
        environment = {k: v for k, v in os.environ.items() if not k.startswith("FACETD")}
        with open(self.log_path, "w") as log:
            self.process = subprocess.Popen([f"{BUILD}/facetd", "--config", self.config, *more], stderr=log, stdout=log,
                                            env=environment)
        self.socket = path(name + ".sock")

    def log(self):
        with open(self.log_path, errors="replace") as file:
            return file.read()

    def listens(self):
        found = until(lambda: re.search(r"listens on https?://[^/]*:(\d+)/", self.log()) or self.process.poll() is not None)
        if not found or found is True:
            raise AssertionError(f"{self.config}: does not listen: {self.log()}")
        self.port = int(found.group(1))
        return self

    def end(self, how=signal.SIGTERM, seconds=120):
        """Its exit status; None where it does not end."""
        self.process.send_signal(how)
        try:
            return self.process.wait(seconds)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
            return None

    def status(self, **more):
        return json.loads(ask(self.port, "/status.json", **more)[2])


def listen(name, http="127.0.0.1:0", more=""):
    return f"listen: {{native: ['unix:{path(name + '.sock')}'], http: '{http}'{more}}}\n"


def lone(name, http="127.0.0.1:0", more=""):
    return Daemon(name, LONE + listen(name, http, more))


@contextlib.contextmanager
def running(name, http="127.0.0.1:0", more=""):
    daemon = lone(name, http, more)
    try:
        yield daemon.listens()
    finally:
        daemon.end()


def unix_lines(daemon, line):
    with socket.socket(socket.AF_UNIX) as s:
        s.settimeout(120)
        s.connect(daemon.socket)
        s.sendall(line.encode() + b"\n")
        s.shutdown(socket.SHUT_WR)
        return b"".join(iter(lambda: s.recv(65536), b"")).decode().splitlines()


def follow(ws, mirror, until_step):
    while mirror.step < until_step or mirror.coming is not None:
        is_text, data = ws.message()
        if not is_text:
            mirror.feed(data)


# ---- what is there ----

def the_page_and_its_neighbours_are_served(d):
    code, fields, body = ask(d.port)
    check(code == 200 and fields["content-type"].startswith("text/html"), f"/: {code} {fields}")
    check(fields["x-content-type-options"] == "nosniff" and "default-src" in fields["content-security-policy"],
          f"/ says how it may be used: {fields}")
    if "etag" in fields:
        again = ask(d.port, headers=[f"If-None-Match: {fields['etag']}"])
        check(again[0] == 304 and not again[2], f"/ again: {again[0]}")
    code, fields, body = ask(d.port, "/planes.json")
    check(code == 200 and json.loads(body) == [], f"/planes.json: {code} {body}")
    code, fields, body = ask(d.port, "/status.json")
    check(code == 200 and json.loads(body)["class"] == "STATUS", f"/status.json: {code}")
    for missing in ("/etc/passwd", "/../../etc/passwd", "/%2e%2e/%2e%2e/etc/passwd", "/snapshot.exe", "/" + "x" * 1000):
        code, _, body = ask(d.port, missing)
        check(code == 404 and b"there is no such page" in body, f"{missing[:40]}: {code} {body[:60]}")


def only_reading_is_possible_by_request(d):
    for method in ("POST", "PUT", "DELETE", "PATCH", "OPTIONS"):
        code, fields, _ = ask(d.port, "/status.json", method=method, body=b"x" * 10)
        check(code == 405 and fields.get("allow") == "GET, HEAD", f"{method}: {code} {fields.get('allow')}")
    code, fields, body = ask(d.port, "/status.json", method="HEAD")
    check(code == 200 and int(fields["content-length"]) > 100 and not body, f"HEAD: {code}")
    s = dial(d.port)
    s.sendall(b"CONNECT 127.0.0.1:22 HTTP/1.1\r\nHost: 127.0.0.1:22\r\n\r\n")
    check(b"200" not in s.recv(100), "CONNECT is no way through")
    s.close()
    s = dial(d.port)
    s.sendall(f"GET / HTTP/1.1\r\nHost: 127.0.0.1:{d.port}\r\nConnection: Upgrade, HTTP2-Settings\r\nUpgrade: h2c\r\n"
              "HTTP2-Settings: AAMAAABkAARAAAAAAAIAAAAA\r\n\r\n".encode())
    check(b" 101 " not in s.recv(200), "h2c is not spoken")
    s.close()


def a_connection_is_kept_for_the_next_request(d):
    s = dial(d.port)
    request = f"GET /status.json HTTP/1.1\r\nHost: 127.0.0.1:{d.port}\r\n\r\n".encode()
    for _ in range(3):
        s.sendall(request)
        check(read_answer(s)[0] == 200, "one of three requests on a connection")
    s.close()


def metrics_are_prometheus_text_and_say_what_status_says(d):
    status, text = d.status(), ask(d.port, "/metrics")
    check(text[1]["content-type"].startswith("text/plain; version=0.0.4"), text[1]["content-type"])
    kind, values = {}, {}
    for line in text[2].decode().splitlines():
        if line.startswith("# TYPE "):
            _, _, name, what = line.split()
            check(name not in kind, f"{name} has one family")
            kind[name] = what
        elif not line.startswith("# HELP "):
            found = re.fullmatch(r'(facetd_[a-z_]+)((?:\{(?:[a-z_]+="(?:[^"\\]|\\.)*",?)+\})?) (NaN|[-+0-9.e]+)', line)
            if check(found, f"not a sample: {line}"):
                name, labels, value = found.groups()
                family = name[:-6] if name.endswith("_count") else name
                check(family in kind, f"{name} has no TYPE before it")
                check(name + labels not in values, f"{name}{labels} twice")
                check(family.endswith("_total") == (kind.get(family) == "counter"), f"{family} is a {kind.get(family)}")
                values[name + labels] = float(value)
    check(values["facetd_map_cell_meters"] == status["cell"] and values["facetd_memory_cap_bytes"] == status["memory"]["cap"],
          "figures of /metrics and /status.json agree")
    for device in status["devices"]:
        check(values[f'facetd_device_up{{device="{device["name"]}"}}'] == (device["state"] == "streaming"), device["name"])
    for reason in status["rows"]["dropped"]:
        check(f'facetd_rows_dropped_total{{reason="{reason}"}}' in values, f"rows dropped: {reason}")
    for name in ('facetd_latency_seconds{quantile="0.99"}', 'facetd_triangles{mesh="raw"}', 'facetd_triangles{mesh="reduced"}',
                 "facetd_patches", "facetd_clients", "facetd_batches_total", "facetd_recording_queued_bytes", 'facetd_encodes_total{form="native"}', "facetd_rows_applied_total"):
        check(name in values, f"/metrics has no {name}")
    record = status["record"]
    state = "recording" if record["recording"] else "waiting" if record["enabled"] else "off"
    for name in "off", "waiting", "recording":
        check(values[f'facetd_recording{{state="{name}"}}'] == (name == state), f"the recording is {state}")
    for name, member in ("file_bytes", "bytes"), ("files_total", "files"), ("dropped_total", "dropped"), ("gaps_total", "gaps"):
        check(values[f"facetd_recording_{name}"] >= record[member], f"recording_{name} is behind the status")
    check(not any(name.startswith("facetd_replay") for name in values), "figures of a replay where nothing is replayed")


# ---- the map ----

def a_websocket_brings_the_whole_map(d):
    ws, mirror = WebSocket(d.port), Mirror()
    check(ws.code == 101 and "sec-websocket-protocol: facetd.v1" in ws.head, ws.head)
    ws.want()
    follow(ws, mirror, d.status()["step"])
    with socket.socket(socket.AF_UNIX) as s:
        s.settimeout(120)
        s.connect(d.socket)
        s.sendall(native(2, bytes(32)))
        other, data = Mirror(), b""
        while other.step < mirror.step or other.coming is not None:
            data += s.recv(1 << 16)
            whole = 0
            while len(data) - whole >= 4 and len(data) - whole >= 4 + int.from_bytes(data[whole:whole + 4], "little"):
                whole += 4 + int.from_bytes(data[whole:whole + 4], "little")
            other.feed(data[:whole])
            data = data[whole:]
    check(mirror.patches == other.patches and len(mirror.patches) == d.status()["map_size"]["patches"] > 50,
          f"{len(mirror.patches)} patches over the WebSocket, {len(other.patches)} over the unix socket")
    ws.close()
    ws, mirror = WebSocket(d.port, "/", protocols=()), Mirror()
    ws.want()
    follow(ws, mirror, 1)
    check(mirror.patches == other.patches, "a client that names no subprotocol is sent the same")
    ws.close()


def a_snapshot_is_what_facet_save_writes(d):
    for ending in ("ply", "glb", "obj", "stl"):
        code, fields, body = ask(d.port, f"/snapshot.{ending}")
        subprocess.run([f"{BUILD}/facet", "save", f"unix:{d.socket}", "-o", path(f"saved.{ending}")], check=True,
                       stdout=subprocess.DEVNULL)
        with open(path(f"saved.{ending}"), "rb") as file:
            saved = file.read()
        check(code == 200 and body == saved and f"map.{ending}" in fields["content-disposition"],
              f"/snapshot.{ending}: {code}, {len(body)} bytes, facet save wrote {len(saved)}")
        with open(path(f"snapshot.{ending}"), "wb") as file:
            file.write(body)
        again = ask(d.port, f"/snapshot.{ending}", headers=[f"If-None-Match: {fields['etag']}"])
        check(again[0] == 304, f"/snapshot.{ending} again: {again[0]}")
        code, head, _ = ask(d.port, f"/snapshot.{ending}", method="HEAD")
        check(code == 200 and head["etag"] == fields["etag"], f"HEAD /snapshot.{ending}: {code}")


def two_snapshots_are_sent_at_once_and_a_third_has_to_wait(d):
    slow = [ask(d.port, f"/snapshot.{e}", read=False, receive=4096) for e in ("obj", "obj", "obj", "ply")]
    answer = until(lambda: (lambda a: a if a[0] == 503 else None)(ask(d.port, "/snapshot.stl")))
    check(answer and answer[0] == 503 and int(answer[1]["retry-after"]) > 0, f"a third at once: {answer and answer[0]}")
    bodies = [read_answer(s)[2] for s in slow[:3]]
    check(len(set(bodies)) == 1 and len(bodies[0]) > 50000, "those who ask for the same are sent the same")
    for s in slow:
        s.close()
    check(until(lambda: ask(d.port, "/snapshot.stl")[0] == 200), "then there is room again")


def a_client_that_stops_reading_costs_nothing_and_converges(d, stalled, mirror):
    mine = [c for c in d.status()["clients"] if c["kind"] == "web" and c["behind"] > 0]
    check(mine and mine[0]["behind_peak"] >= 20 and mine[0]["queued"] <= 256 << 10, f"the stalled client: {mine}")
    check(until(lambda: d.status()["queue"]["idle"]), "the map stands") # what waited for its look-ahead is in it
    follow(stalled, mirror, d.status()["step"])
    fresh, whole = WebSocket(d.port), Mirror()
    fresh.want()
    follow(fresh, whole, d.status()["step"])
    check(mirror.patches == whole.patches, f"{len(mirror.patches)} patches after the stall, {len(whole.patches)} anew")
    print(f"note: a stalled WebSocket was {mine[0]['behind_peak'] if mine else '?'} steps behind, held "
          f"{mine[0]['queued'] if mine else '?'} bytes, and converged")
    fresh.close()


def a_limited_rate_is_kept(d):
    ws, mirror = WebSocket(d.port), Mirror()
    begin = time.monotonic()
    ws.want(bytes_per_s=100000)
    total = 0
    while total < 150000:
        data = ws.message()[1]
        total += len(data)
        mirror.feed(data)
        if mirror.commits: # a small map
            break
    check(total > 40000, f"a map of {total} bytes proves nothing")
    seconds = time.monotonic() - begin
    check(seconds > 0.8 * (total - 30000) / 100000, f"{total} bytes in {seconds:.2f} s at 100000 a second")
    ws.close()


# ---- commands ----

def commands_are_answered_the_way_they_came(d):
    ws = WebSocket(d.port)
    ws.say("?STATUS")
    check(json.loads(ws.text())["class"] == "STATUS", "?STATUS as text")
    ws.say('{"command": "STATUS"}')
    check(json.loads(ws.text())["class"] == "STATUS", "a command as an object")
    ws.say("?NONSENSE")
    check("not a command" in json.loads(ws.text())["error"], "?NONSENSE")
    ws.say('?WATCH={"enable":true}')
    check(json.loads(ws.text())["class"] == "WATCH", "?WATCH")
    check([json.loads(ws.text())["class"] for _ in range(2)] == ["STATUS", "STATUS"], "a status a second")
    ws.say('?WATCH={"enable":false}')
    until(lambda: json.loads(ws.text())["class"] == "WATCH")
    ws.want()
    ws.send(2, native(JSON, b"?STATUS"))
    mirror = Mirror()
    while not mirror.texts:
        mirror.feed(ws.message()[1])
    check(json.loads(mirror.texts[0])["class"] == "STATUS", "a command as a frame is answered by a frame")
    ws.send(1, b'?STA', final=False)
    ws.send(9, b"still there?")
    ws.send(0, b'TUS')
    check(json.loads(ws.text())["class"] == "STATUS", "a command in two fragments")
    ws.close()


def only_the_token_may_change_something(d):
    for word in ("?PAUSE", "?RESUME", "?RESET", '?SAVE={"file":"x.ply"}'):
        ws = WebSocket(d.port)
        ws.say(word)
        check("need the token" in json.loads(ws.text())["error"], f"{word} without the token")
        ws.close()
    for path_, headers in ((f"/native?token={TOKEN}", ()), ("/native", (f"Authorization: Bearer {TOKEN}",))):
        ws = WebSocket(d.port, path_, headers=headers)
        ws.say("?PAUSE")
        check(json.loads(ws.text()) == {"class": "OK", "command": "PAUSE"}, "?PAUSE with the token")
        check(until(lambda: d.status()["paused"]), "it is paused")  # a status may be a tenth of a second old
        ws.say('?RECORD={"stream":true}')
        check("unix socket" in json.loads(ws.text())["error"], "a recording cannot be taken here, and none is begun or ended")
        ws.close()


def a_saved_snapshot_goes_into_the_archive_and_nowhere_else(d):
    ws = WebSocket(d.port, f"/native?token={TOKEN}")
    ws.say("?WATCH")
    def answer(line, *kinds):
        ws.say(line)
        while True:
            said = json.loads(ws.text())
            if said["class"] in kinds:
                return said
    for name in ("../out.ply", "/tmp/out.ply", ".out.ply", "out.txt", "a/b.ply", "-o.ply", "", "x" * 200 + ".ply", "a\\u0000b.ply"):
        said = answer(f'?SAVE={{"file":"{name}"}}', "ERROR", "OK")
        check(said["class"] == "ERROR", f"?SAVE {name[:30]}: {said}")
    check(os.listdir(path("archive")) == [], f"refused names left something: {os.listdir(path('archive'))}")
    answer('?SAVE={"file":"kept.ply"}', "OK", "ERROR")
    said = answer("?WATCH", "SAVED")
    with open(path("archive/kept.ply"), "rb") as file, open(path("snapshot.ply"), "rb") as other:
        check(said.get("file", "").endswith("kept.ply") and file.read() == other.read(), f"?SAVE: {said}")
    answer('?SAVE={"file":"kept.ply"}', "OK", "ERROR")
    said = answer("?WATCH", "SAVED")
    check(said["file"] is None and "there already" in said["error"], f"?SAVE over a file: {said}")
    ws.close()


def nonsense_is_closed_with_a_code_and_a_reason(d):
    for opcode, data, code in ((2, b"\0\0\0\0", 1002), (2, b"\xff" * 100, 1002), (2, native(4, b"x"), 1002),
                               (1, b"x" * (65 << 10), 1009), (2, b"x" * (65 << 10), 1009)):
        ws = WebSocket(d.port)
        ws.send(opcode, data)
        try:
            while True:
                ws.message()
        except Closed as closed:
            check(closed.code == code and closed.reason, f"{data[:8]} x{len(data)}: closed {closed}")
        ws.close()
    for protocols in (("graphql-ws",), ("x" * 200,)):
        with contextlib.suppress(Closed):
            check(WebSocket(d.port, protocols=protocols).code != 101, f"nobody speaks {protocols[0][:20]}")


# ---- who gets in ----

def names_that_lead_here_but_are_not_ours_are_refused(d):
    for host in ("evil.example", "evil.example:80", "127.0.0.1.evil.example", "localhost.evil.example", "[::2]:1", "", "a b"):
        code, _, body = ask(d.port, "/status.json", host=host or " ")
        check(code == 403 and b"name" in body, f"Host {host}: {code}")
    for host in ("localhost", f"localhost:{d.port}", "127.0.0.1", "LOCALHOST:1", "[::1]:7880", "app.example"):
        check(ask(d.port, "/status.json", host=host)[0] == 200, f"Host {host}")
    with contextlib.suppress(Closed):
        check(WebSocket(d.port, host="evil.example", headers=["Origin: http://evil.example"]).code == 403,
              "a WebSocket by another name, of the same origin")


def pages_of_others_may_not_open_websockets(d):
    for origin in ("http://evil.example", "null", "https://app.example.evil", f"https://127.0.0.1:{d.port}",
                   "http://127.0.0.1:1", "file://"):
        ws = WebSocket(d.port, headers=[f"Origin: {origin}"])
        check(ws.code == 403, f"Origin {origin}: {ws.code}")
        ws.close()
        check(ask(d.port, "/", method="POST", headers=[f"Origin: {origin}"], body=b"x")[0] == 403, f"POST from {origin}")
    for origin in (f"http://127.0.0.1:{d.port}", "https://app.example"):
        ws = WebSocket(d.port, headers=[f"Origin: {origin}"])
        check(ws.code == 101, f"Origin {origin}: {ws.code}")
        ws.close()
    fields = ask(d.port, "/status.json", headers=["Origin: https://app.example"])[1]
    check(fields.get("access-control-allow-origin") == "https://app.example", "a listed page may read")
    check("access-control-allow-origin" not in ask(d.port, "/status.json", headers=["Origin: http://evil.example"])[1],
          "another page may not")


def a_wrong_token_is_told_logged_once_and_kept_out(d):
    wrong = [f"Authorization: Bearer {TOKEN[:-1]}x"]
    codes = [ask(d.port, "/status.json", headers=wrong)[0] for _ in range(5)]
    check(codes == [401] * 5, f"wrong tokens: {codes}")
    check(ask(d.port, f"/status.json?token={TOKEN}y")[0] == 429, "the sixth is not even looked at")
    answer = ask(d.port, f"/status.json?token={TOKEN}")
    check(answer[0] == 429 and 0 < int(answer[1]["retry-after"]) <= 60, f"nor is the right one: {answer[0]}")
    check(WebSocket(d.port, f"/?token={TOKEN}").code == 429, "nor on a WebSocket")
    check(ask(d.port, "/status.json")[0] == 200, "who shows none still reads on loopback")
    log = d.log()
    check(log.count("wrong token") == 2 and TOKEN not in log, f"logged: {log.count('wrong token')}")


def beyond_loopback_nothing_is_seen_without_token_and_tls():
    for name, more, words in (("open", "", "needs listen.token_file and listen.tls"),
                              ("half", f", token_file: '{path('token')}'", "needs listen.token_file and listen.tls")):
        r = subprocess.run([f"{BUILD}/facetd", "--check-config", "--config", "/dev/stdin"], capture_output=True, text=True,
                           input=LONE + listen(name, "0.0.0.0:0", more))
        check(r.returncode != 0 and words in r.stderr and r.stderr.count("\n") == 1, f"{name}: {r.stderr}")
    tls = trusting_nobody()
    with running("wide", "0.0.0.0:0", secret() + certificate("good")) as d:
        answer = ask(d.port, "/status.json", tls=tls)
        check(answer[0] == 401 and answer[1]["www-authenticate"] == "Bearer" and b"a token is needed" in answer[2],
              f"without a token: {answer[0]}")
        check(ask(d.port, "/", tls=tls)[0] == 200, "the page itself is for everybody: it takes the token from its address")
        check(ask(d.port, f"/status.json?token={TOKEN}", tls=tls, host="robot.example")[0] == 200, "with the token")
        check(WebSocket(d.port, tls=tls).code == 401, "a WebSocket without a token")
        ws = WebSocket(d.port, f"/?token={TOKEN}", tls=tls)
        ws.say("?STATUS")
        check(json.loads(ws.text())["class"] == "STATUS", "a WebSocket with the token")
        ws.close()
        for _ in range(4):
            ask(d.port, "/status.json", tls=tls)
        check(ask(d.port, f"/status.json?token={TOKEN}", tls=tls)[0] == 429, "missing ones count like wrong ones")
        s = dial(d.port)
        s.sendall(b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
        with contextlib.suppress(ConnectionError):
            check(b"HTTP/1.1 200" not in s.recv(100), "plain HTTP is not answered behind TLS")
        s.close()
        check(d.log().count("showed") == 2 and TOKEN not in d.log(), f"logged: {d.log()}")


def secret():
    return f", token_file: '{path('token')}'"


def certificate(name):
    return f", tls: {{certificate: '{path(name + '.pem')}', key: '{path(name + '.key')}'}}"


def make_certificates():
    for name, days in (("good", "3"), ("other", "3")):
        subprocess.run(["openssl", "req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes",
                        "-keyout", path(name + ".key"), "-out", path(name + ".pem"), "-days", days, "-subj", "/CN=localhost"],
                       check=True, capture_output=True)
    subprocess.run(["openssl", "req", "-new", "-key", path("good.key"), "-out", path("old.csr"), "-subj", "/CN=localhost"],
                   check=True, capture_output=True)
    os.symlink(path("good.key"), path("old.key"))
    os.makedirs(path("ca/new"))
    for file, text in (("index", ""), ("serial", "01\n"), ("cnf", "[ca]\ndefault_ca=d\n[d]\ndatabase=" + path("ca/index") +
                       "\nserial=" + path("ca/serial") + "\nnew_certs_dir=" + path("ca/new") + "\ndefault_md=sha256\npolicy=p\n"
                       "[p]\ncommonName=supplied\n")):
        with open(path("ca/" + file), "w") as out:
            out.write(text)
    subprocess.run(["openssl", "ca", "-batch", "-selfsign", "-config", path("ca/cnf"), "-keyfile", path("good.key"), "-in",
                    path("old.csr"), "-out", path("old.pem"), "-startdate", "200101000000Z", "-enddate", "200201000000Z",
                    "-notext"], check=True, capture_output=True)


def what_cannot_be_is_said_in_one_sentence():
    with open(path("open_token"), "w") as file:
        file.write(TOKEN + "\n")
    os.chmod(path("open_token"), 0o644)
    with open(path("short_token"), "w") as file:
        file.write("short\n")
    os.chmod(path("short_token"), 0o600)
    mixed = f", tls: {{certificate: '{path('good.pem')}', key: '{path('other.key')}'}}"
    for name, more, words in (("t1", f", token_file: '{path('open_token')}'", "can be read by everybody; chmod o-rwx"),
                              ("t2", f", token_file: '{path('short_token')}'", "no token of 16"),
                              ("t3", f", token_file: '{path('nowhere')}'", "cannot be read"),
                              ("c1", certificate("nowhere"), "cannot be read"),
                              ("c2", certificate("old"), "has expired"),
                              ("c3", mixed, "do not belong together"),
                              ("c4", f", tls: {{certificate: '{path('good.key')}', key: '{path('good.key')}'}}",
                               "no certificate in PEM")):
        d = lone(name, more=more)
        until(lambda: d.process.poll() is not None)
        check(d.process.poll() not in (None, 0) and words in d.log(), f"{name}: {d.process.poll()} {d.log()}")
        if d.process.poll() is None:
            d.end()


def tls_is_spoken_where_it_is_configured():
    with running("tls", more=secret() + certificate("good")) as d:
        code = ask(d.port, "/status.json", tls=trusting_nobody())[0]
        check(code == 200 and f"listens on https://127.0.0.1:{d.port}/" in d.log(), f"HTTPS: {code}")
        ws = WebSocket(d.port, tls=trusting_nobody(), headers=[f"Origin: https://127.0.0.1:{d.port}"])
        ws.want()
        mirror = Mirror()
        mirror.feed(ws.message()[1])
        check(ws.code == 101 and mirror.map, "WSS, of the same origin")
        ws.close()
        r = subprocess.run(["openssl", "s_client", "-connect", f"127.0.0.1:{d.port}", "-tls1_1", "-cipher", "DEFAULT@SECLEVEL=0"],
                           stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False)
        check(r.returncode != 0, "TLS 1.1 is not spoken")


# ---- limits ----

def clients_beyond_the_limit_are_told_and_closed():
    with running("few", more=", clients: 2") as d:
        kept = [WebSocket(d.port) for _ in range(2)]
        for ws in kept:
            ws.say("?STATUS")
            ws.text()
        ws = WebSocket(d.port)
        try:
            ws.message()
        except Closed as closed:
            check(closed.code == 1013 and "listen.clients" in closed.reason, f"the third: {closed}")
        check(ask(d.port, "/status.json")[0] == 200, "requests are still answered")
        kept[0].close()
        def again():
            new = WebSocket(d.port)
            new.say("?STATUS")
            try:
                return new.text()
            except (Closed, ConnectionError):
                return None
        check(until(again), "one that left makes room")


def a_hundred_connections_that_say_nothing_shut_nobody_out():
    with running("idle", more=", clients: 4") as d:
        def closed(s):
            s.settimeout(0.01)
            try:
                return s.recv(1000) == b""
            except TimeoutError:
                return False
            except OSError:
                return True

        before = d.status()["memory"]["rss"]
        idle = []
        for i in range(100):
            s = dial(d.port)
            if i % 2:
                s.sendall(b"GET /status.json HTTP/1.1\r\nX-Slow: ")
            idle.append(s)
        check(ask(d.port, "/status.json")[0] == 200, "a request among 100 silent connections")
        check(not closed(idle[-1]), "... before these are closed")
        for _ in range(3): # more at once than there is room for: who is over waits, nobody is refused
            idle += [dial(d.port) for _ in range(100)]
            check(ask(d.port, "/status.json")[0] == 200, "a request behind 100 more")
        ws = WebSocket(d.port)
        check(ws.code == 101, "a WebSocket among them")
        after = d.status()["memory"]["rss"]
        most = 16 << 20 if "/sanitize" in BUILD or "/thread" in BUILD else 4 << 20  # sanitizers keep what was freed
        check(after - before < most, f"they cost {after - before} bytes")
        print(f"note: 100 silent connections cost {max(0, after - before) >> 10} KB")

        def drip():
            for s in idle:
                with contextlib.suppress(OSError):
                    s.sendall(b"x")
            return all(closed(s) for s in idle)
        check(until(drip, 40), "who never ends his request is closed")
        check(ask(d.port, "/status.json")[0] == 200, "and all is well afterwards")
        for s in idle:
            s.close()


def endless_headers_and_bodies_are_cut():
    with running("endless") as d:
        s = dial(d.port)
        with contextlib.suppress(OSError):
            s.sendall(f"GET / HTTP/1.1\r\nHost: 127.0.0.1:{d.port}\r\nX: ".encode())
            for _ in range(64):
                s.sendall(b"y" * 65536)
            s.settimeout(120)
            while s.recv(4096):
                pass
        s.close()
        check(ask(d.port, "/status.json")[0] == 200 and d.process.poll() is None, "after 4 MB of header")
        check(d.status()["memory"]["rss"] < 100 << 20, "which cost nothing")


# ---- life ----

def a_second_daemon_maps_without_a_page():
    """The default address, which somebody else on this machine may hold as well."""
    first = Daemon("first", LONE + f"listen: {{native: ['unix:{path('first.sock')}']}}\n")
    until(lambda: "listens on unix" in first.log())
    second = Daemon("second", LONE + f"listen: {{native: ['unix:{path('second.sock')}']}}\n")
    check(until(lambda: "somebody listens there already" in second.log()) and "goes on without it" in second.log(),
          f"the second says so: {second.log()}")
    check(until(lambda: os.path.exists(second.socket)) and unix_lines(second, "?STATUS"), "and does its work")
    check(first.end() == 0 and second.end() == 0, "both end well")
    with running("named") as d:
        other = lone("taken", f"127.0.0.1:{d.port}")
        until(lambda: other.process.poll() is not None)
        check(other.process.poll() not in (None, 0) and "set another listen.http" in other.log(), f"one that is named: {other.log()}")


def an_empty_address_is_no_page():
    d = Daemon("none", LONE + listen("none", ""))
    check(until(lambda: "listens on unix" in d.log()) and "http" not in d.log(), d.log())
    check(d.end() == 0, "it ends well")


def the_daemon_ends_while_a_snapshot_is_sent(d, stalled):
    slow = [ask(d.port, "/snapshot.obj", read=False, receive=4096), ask(d.port, "/snapshot.glb", read=False)]
    dial(d.port)
    begin = time.monotonic()
    status = d.end(signal.SIGINT)
    check(status == 0, f"^C: status {status}, {time.monotonic() - begin:.1f} s: {d.log()[-400:]}")
    for s in slow:
        s.close()


def main():
    os.makedirs(path("archive"))
    with open(path("token"), "w") as file:
        file.write(TOKEN + "\n")
    os.chmod(path("token"), 0o600)
    make_certificates()
    robot = subprocess.Popen([f"{BUILD}/facet", "simulate", "building", "--endless", "--dir", path("robot"), "--", "sleep", "1000"],
                             stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        until(lambda: os.path.exists(path("robot/facetd.yaml")))
        time.sleep(0.5)
        with open(path("robot/facetd.yaml")) as file:
            config = re.sub(r"(?m)^listen:.*\n", "", file.read())
        more = f", clients: 6, send_buffer: 16384, origins: ['https://app.example']{secret()}"
        d = Daemon("robot", config + f"map: {{archive: '{path('archive')}'}}\n" + listen("robot", more=more)).listens()
        stalled, mirror = WebSocket(d.port, receive=4096), Mirror()
        until(lambda: d.status()["step"] > 50)
        stalled.want()
        mirror.feed(stalled.message()[1])
        first = d.status()["step"]
        claims_alone()
        check(until(lambda: d.status()["step"] > first + 500), "the robot maps")
        for claim in (the_page_and_its_neighbours_are_served, only_reading_is_possible_by_request,
                      a_connection_is_kept_for_the_next_request, metrics_are_prometheus_text_and_say_what_status_says,
                      commands_are_answered_the_way_they_came, only_the_token_may_change_something):
            judge(claim, d)
        judge(a_client_that_stops_reading_costs_nothing_and_converges, d, stalled, mirror)
        for claim in (a_websocket_brings_the_whole_map, a_snapshot_is_what_facet_save_writes,
                      two_snapshots_are_sent_at_once_and_a_third_has_to_wait, a_limited_rate_is_kept,
                      a_saved_snapshot_goes_into_the_archive_and_nowhere_else, nonsense_is_closed_with_a_code_and_a_reason,
                      names_that_lead_here_but_are_not_ours_are_refused, pages_of_others_may_not_open_websockets,
                      a_wrong_token_is_told_logged_once_and_kept_out):
            judge(claim, d)
        judge(the_daemon_ends_while_a_snapshot_is_sent, d, stalled)
    finally:
        robot.terminate()
        robot.wait()
    keep = os.environ.get("WEB_KEEP")  # for judges of the files
    if keep:
        for ending in ("ply", "glb", "obj", "stl"):
            os.replace(path(f"snapshot.{ending}"), os.path.join(keep, f"snapshot.{ending}"))
    return 1 if failures else 0


def claims_alone():
    for claim in (beyond_loopback_nothing_is_seen_without_token_and_tls, what_cannot_be_is_said_in_one_sentence,
                  tls_is_spoken_where_it_is_configured, clients_beyond_the_limit_are_told_and_closed,
                  a_hundred_connections_that_say_nothing_shut_nobody_out, endless_headers_and_bodies_are_cut,
                  a_second_daemon_maps_without_a_page, an_empty_address_is_no_page):
        judge(claim)


def judge(claim, *arguments):
    begin = time.monotonic()
    try:
        claim(*arguments)
    except Exception as error:  # pylint: disable=broad-except
        check(False, f"{claim.__name__}: {type(error).__name__} {error} {error.__traceback__.tb_next and ''}")
        import traceback
        traceback.print_exc()
    print(f"{claim.__name__} ({time.monotonic() - begin:.1f} s)", flush=True)


if __name__ == "__main__":
    with scratch:
        sys.exit(main())
