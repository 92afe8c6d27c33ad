#!/bin/sh
# Law: a socket that systemd opened is served as it is and outlives the daemon; one that the configuration does not name is
# not served, and the log says so. Sockets are passed by hand, as sd_listen_fds(3) describes it.
. "$(dirname "$0")/lib.sh"
if ! command -v python3 >/dev/null 2>&1; then
    echo "python3 is not here: install it (make deps)"
    exit 77
fi
timeout -k 5 600 python3 - "$build" "$scratch" <<'END'
import json, os, signal, socket, sys, time

build, scratch = sys.argv[1:]
path = scratch + "/facetd.sock"


def unix_socket(path):
    s = socket.socket(socket.AF_UNIX)
    s.bind(path)
    s.listen()
    return s


def tcp_socket(host):
    s = socket.socket()
    s.bind((host, 0))
    s.listen()
    return s


def start(natives, sockets, log, http=""):
    config = scratch + "/facetd.yaml"
    open(log, "w").close()
    with open(config, "w") as file:
        json.dump({"listen": {"native": natives, "http": http}}, file)
    pid = os.fork()
    if pid == 0:
        out = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        high = [os.dup2(s.fileno(), 100 + i) for i, s in enumerate(sockets)]
        os.dup2(out, 1), os.dup2(out, 2)
        for i, fd in enumerate(high):
            os.dup2(fd, 3 + i, inheritable=True)
        os.environ.update(LISTEN_FDS=str(len(sockets)), LISTEN_PID=str(os.getpid()))
        os.execv(build + "/facetd", ["facetd", "--config", config])
    until = time.time() + 120
    while time.time() < until and open(log).read().count("listens on") < len(natives) + bool(http):
        time.sleep(0.05)
    return pid


def ask(family, address):
    s = socket.socket(family)
    s.settimeout(120)
    s.connect(address)
    s.sendall(b"?STATUS\n")
    answer = s.makefile().readline()
    assert '"class"' in answer, answer
    s.close()


def end(pid):
    os.kill(pid, signal.SIGTERM)
    _, status = os.waitpid(pid, 0)
    assert status == 0, status


door, tcp = unix_socket(path), tcp_socket("127.0.0.1")
os.chmod(path, 0o600)
before = os.stat(path)
port = tcp.getsockname()[1]
natives = ["unix:" + path, f"tcp:127.0.0.1:{port}", f"unix:{scratch}/own.sock"]
# A client that came before the daemon did is answered, as those who come while it is started anew.
early = socket.socket(socket.AF_UNIX)
early.connect(path)
early.sendall(b"?STATUS\n")
for _ in range(2):
    pid = start(natives, [door, tcp], scratch + "/log")
    if early:
        early.settimeout(120)
        assert '"class"' in early.makefile().readline()
        early = None
    ask(socket.AF_UNIX, path)
    ask(socket.AF_INET, ("127.0.0.1", port))
    ask(socket.AF_UNIX, scratch + "/own.sock")
    end(pid)
    after = os.stat(path)
    assert (after.st_ino, after.st_mode, after.st_gid) == (before.st_ino, before.st_mode, before.st_gid), after
    assert not os.path.exists(scratch + "/own.sock"), "its own socket stays behind"
assert "does not name" not in open(scratch + "/log").read()

# Sockets that nobody asked for: another path, another port, and one beyond loopback at the port that is.
everywhere = tcp_socket("0.0.0.0")
other = unix_socket(scratch + "/other.sock")
port = everywhere.getsockname()[1]
pid = start([f"unix:{scratch}/own.sock"], [other, tcp, everywhere], scratch + "/log")
ask(socket.AF_UNIX, scratch + "/own.sock")
stranger = socket.create_connection(("127.0.0.1", port))
stranger.sendall(b"?STATUS\n")
stranger.settimeout(0.5)
try:
    assert not stranger.recv(1), "a socket beyond loopback is served"
except TimeoutError:
    pass
end(pid)
log = open(scratch + "/log").read()
assert "systemd passed 3 sockets that neither listen.native nor listen.http names" in log, log
everywhere.close()
pid = start([f"tcp:127.0.0.1:{port}"], [other], scratch + "/log")
ask(socket.AF_INET, ("127.0.0.1", port))
end(pid)
assert "systemd passed 1 socket that" in open(scratch + "/log").read()

# The socket of the page, passed like the others.
page = tcp_socket("127.0.0.1")
at = "127.0.0.1:%d" % page.getsockname()[1]
waits = socket.create_connection(page.getsockname())
waits.sendall(b"GET /status.json HTTP/1.1\r\nHost: " + at.encode() + b"\r\n\r\n")
for _ in range(2):
    pid = start(["unix:" + path], [door, page], scratch + "/log", http=at)
    if "this build has no HTTP" in open(scratch + "/log").read():
        break
    waits = waits or socket.create_connection(page.getsockname())
    waits.settimeout(120)
    waits.sendall(b"GET /status.json HTTP/1.1\r\nHost: " + at.encode() + b"\r\n\r\n")
    assert waits.recv(12) == b"HTTP/1.1 200", "the page's socket is not served"
    waits = None
    end(pid)
    assert "systemd passed" not in open(scratch + "/log").read(), open(scratch + "/log").read()
END
