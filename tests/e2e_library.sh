#!/bin/sh
# Law: what a program holds through libfacet or facet.py is the daemon's map: joined late, coded or not, in a box, through a
# restart of the daemon; and libfacet is a library as installed: a header for C and C++, shared, static, facet_* only.
. "$(dirname "$0")/lib.sh"
case $build in
*/build) ;;
*) echo "only the release's library is linked with other programs"; exit 77 ;;
esac
command -v python3 >/dev/null && command -v g++ >/dev/null && command -v pkg-config >/dev/null ||
    { echo "python3, g++ or pkg-config is missing"; exit 77; }

# The library as a user finds it.
make --no-print-directory install DESTDIR="$scratch/root" PREFIX=/usr >"$scratch/install.log" 2>&1 ||
    { tail -n 20 "$scratch/install.log"; fail "make install"; exit 1; }
export PKG_CONFIG_PATH="$scratch/root/usr/lib/pkgconfig" PKG_CONFIG_SYSROOT_DIR="$scratch/root"
export LD_LIBRARY_PATH="$scratch/root/usr/lib" PYTHONDONTWRITEBYTECODE=1
cat >"$scratch/hash.c" <<'C'
#include <facet.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

/* hash ADDRESS [plain|coded [BOX...]]: of the first whole map, and its step. */
int main(int argc, char **argv)
{
	char error[FACET_ERROR_MAX], hash[65];
	struct facet_want want;
	struct facet_event event;
	struct facet *facet = facet_open(argv[1], 5000, error);
	int r = 0;
	memset(&want, 0, sizeof(want));
	if (argc > 2)
		want.flags = strcmp(argv[2], "coded") ? FACET_WANT_PLAIN : FACET_WANT_CODED;
	for (int i = 3; i < argc && i < 9; i++) {
		want.flags |= FACET_WANT_BOX;
		want.box[i - 3] = (float)atof(argv[i]);
	}
	if (facet && (r = facet_want(facet, &want)) == 0)
		do
			r = facet_wait(facet, 20000, &event);
		while (r == 1 && event.kind != FACET_COMMIT);
	if (facet && r == 1 && facet_hash(facet, hash) == 0)
		printf("hash %llu %s\n", (unsigned long long)event.step, hash);
	else
		printf("hash: %s\n", facet ? facet_error(facet) : error);
	facet_close(facet);
	return r != 1;
}
C
# shellcheck disable=SC2046
{
    cc -Wall -Wextra -Werror -o "$scratch/follow" tools/examples/follow.c $(pkg-config --cflags --libs libfacet) -lm &&
        cc -Wall -Wextra -Werror -o "$scratch/hash" "$scratch/hash.c" $(pkg-config --cflags --libs libfacet) &&
        g++ -Wall -Wextra -Werror -x c++ -o "$scratch/hash_cxx" "$scratch/hash.c" $(pkg-config --cflags libfacet) \
            -x none "$scratch/root/usr/lib/libfacet.a" $(pkg-config --static --libs-only-l libfacet | sed 's/-lfacet//')
} || fail "a program does not build against the installed library"
[ "$(wc -l <tools/examples/follow.c)" -le 100 ] || fail "the example is longer than 100 lines"
nm -D --defined-only "$scratch/root/usr/lib/libfacet.so" | grep -v ' facet_' && fail "libfacet exports a name that is not its own"
objdump -p "$scratch/root/usr/lib/libfacet.so" | grep -q 'SONAME *libfacet.so.0$' || fail "the soname is not libfacet.so.0"

# A daemon that comes back when it is killed.
mkdir "$scratch/run"
cat >"$scratch/daemons" <<'S'
while [ ! -e "$1/stop" ]; do
    "$2" 2>>"$1/daemon.log" &
    echo $! >"$1/pid"
    wait
    sleep 0.2
done
S
address=unix:$scratch/run/facetd.sock
"$facet" simulate hall --endless --dir "$scratch/run" --http 127.0.0.1:0 -- sh "$scratch/daemons" "$scratch" "$facetd" >"$scratch/simulator.log" 2>&1 &
until_true 30 "$facet" save "$address" --wait-steps 200 -o "$scratch/early.ply" || { cat "$scratch/daemon.log"; fail "no map"; exit 1; }

"$scratch/follow" "$address" >"$scratch/follow.log" 2>"$scratch/follow.err" &
until_true 20 grep -q '^step .* changed' "$scratch/follow.log" || fail "the example shows nothing"

# Everybody holds the same, when it stands still.
same() { # WHERE
    say '?PAUSE' | grep '"OK"' >/dev/null || fail "$1: the daemon does not pause"
    until_true 60 holds "s['queue']['idle']"
    "$scratch/hash" "$address" plain >"$scratch/plain" || fail "$1: $(cat "$scratch/plain")"
    "$scratch/hash" "$address" coded >"$scratch/coded"
    "$scratch/hash_cxx" "$address" >"$scratch/cxx"
    python3 tools/facet.py "$address" --commits 1 --hash -o "$scratch/python.ply" >"$scratch/python" || fail "$1: facet.py"
    python3 tools/facet.py "$address" --commits 1 --hash --coded | grep '^hash' >"$scratch/python_coded"
    grep '^hash' "$scratch/python" >"$scratch/python_plain"
    others="coded cxx python_plain python_coded"
    # The same through a WebSocket, where the build has any.
    web=$(sed -n 's|.*listens on http://|ws://|p' "$scratch/daemon.log" | tail -n 1)
    if [ -n "$web" ]; then
        "$scratch/hash" "${web}native" plain >"$scratch/web"
        "$scratch/hash" "$web" coded >"$scratch/web_coded"
        python3 tools/facet.py "${web}?x=y" --commits 1 --hash | grep '^hash' >"$scratch/python_web"
        "$facet" watch --once --json "$web" | grep -q '"class":"STATUS"' || fail "$1: facet watch $web"
        others="$others web web_coded python_web"
        echo "note: and through a WebSocket at ${web%%[0-9]*}..."
    fi
    for other in $others; do
        cmp -s "$scratch/plain" "$scratch/$other" || fail "$1: $other holds $(cat "$scratch/$other"), not $(cat "$scratch/plain")"
    done
    "$facet" save "$address" -o "$scratch/save.ply" >"$scratch/save" || fail "$1: facet save"
    python3 - "$scratch/save.ply" "$scratch/python.ply" <<'P' || fail "$1: facet.py saved another mesh than facet save"
import re, struct, sys
def mesh(path):
    data = open(path, "rb").read()
    head, body = data.split(b"end_header\n", 1)
    sizes = {"double": 8, "float": 4, "uchar": 1, "int": 4, "uint": 4, "uint8": 1, "int32": 4}
    nv, nf = (int(n) for n in re.findall(rb"element \w+ (\d+)", head))
    vertex, face = head.split(b"element face")
    properties = re.findall(r"property (\w+) \w+", vertex.decode())
    stride = sum(sizes[p] for p in properties)
    points = [struct.unpack_from("<3d", body, stride * i) for i in range(nv)]
    extra = sum(sizes[p] for p in re.findall(r"property (\w+) \w+\n", face.decode()) if p != "list")
    at = stride * nv
    faces = [struct.unpack_from("<3I", body, at + i * (13 + extra) + 1) for i in range(nf)]
    return sorted(tuple(sorted(tuple(round(c, 6) for c in points[i]) for i in f)) for f in faces)
one, other = map(mesh, sys.argv[1:])
print(f"note: {len(one)} triangles, the same from facet save and facet.py")
sys.exit(one != other or not one)
P
    # A box of a few metres.
    "$scratch/hash" "$address" coded 0 -2 -1 3 2 1 >"$scratch/box"
    python3 tools/facet.py "$address" --commits 1 --hash --box 0,-2,-1,3,2,1 | grep '^hash' >"$scratch/python_box"
    cmp -s "$scratch/box" "$scratch/python_box" || fail "$1: the box holds $(cat "$scratch/box") and $(cat "$scratch/python_box")"
    cmp -s "$scratch/box" "$scratch/plain" && fail "$1: the box holds everything"
    say '?RESUME' | grep '"OK"' >/dev/null || fail "$1: the daemon does not go on"
}

same "joined late"
kill "$(cat "$scratch/pid")"
until_true 20 grep -q 'connection is lost' "$scratch/follow.err" || fail "the example does not notice that the daemon is gone"
until_true 30 "$facet" save "$address" --wait-steps 200 -o "$scratch/early.ply" || fail "the daemon does not come back"
until_true 20 sh -c "sed -n '/new map/,\$p' '$scratch/follow.log' | grep -c 'new map' | grep -q '^[2-9]'" || fail "the example does not follow the new map"
same "after a restart"
tail -n 1 "$scratch/follow.log" | sed 's/^/note: the example: /'
[ $failed -eq 0 ] || { tail -n 5 "$scratch/daemon.log" "$scratch/follow.err"; exit 1; }
