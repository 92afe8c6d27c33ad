#!/bin/sh
# Law: the service is as locked up as it can be and still reaches its devices: the unit is valid, its exposure is below 2.0,
# and nothing in the file of users is unknown to systemd.
cd "$(dirname "$0")/.." || exit 2
if ! command -v systemd-analyze >/dev/null 2>&1; then
    echo "systemd-analyze is not here: install the package systemd (make deps)"
    exit 77
fi
scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT
failed=0

fail() {
    echo "FAILED: $*"
    failed=1
}

# A unit is only valid if what it starts is there: an installation with a stand-in for the program.
prefix=$scratch/prefix
mkdir -p "$prefix/bin" "$scratch/units"
printf '#!/bin/sh\n' >"$prefix/bin/facetd"
chmod 755 "$prefix/bin/facetd"
unit=$scratch/units/facetd.service
sed "s|@PREFIX@|$prefix|g" systemd/facetd.service.in >"$unit"
sed "s|@PREFIX@|$prefix|g" systemd/facetd.socket.in >"$scratch/units/facetd.socket"
grep -q '@[A-Z]*@' "$scratch"/units/* && fail "a placeholder is left in a unit"

# Without a running systemd (a container) verify also complains about what it cannot ask; what it says of this unit counts.
said=$(systemd-analyze verify --man=no "$unit" "$scratch/units/facetd.socket" 2>&1)
status=$?
echo "$said"
echo "$said" | grep -q 'facetd\.s' && fail "systemd-analyze verify finds something in the unit"
[ "$status" -ne 0 ] && fail "systemd-analyze verify: status $status"

report=$(systemd-analyze security --offline=true --threshold=20 --no-pager "$unit" 2>&1)
status=$?
level=$(echo "$report" | sed -n 's/.*exposure level for facetd.service: \([0-9.]*\).*/\1/p')
echo "note: exposure level ${level:-unknown}"
[ "$status" -ne 0 ] && { echo "$report"; fail "systemd-analyze security: exposure ${level:-unknown}, 2.0 or more"; }
[ -z "$level" ] && fail "systemd-analyze security named no level"

# The check can fail: without the sandbox the same program is far above the threshold.
grep -v '^Protect\|^Restrict\|^SystemCall\|^Capability\|^Private\|^NoNew\|^Device' "$unit" >"$scratch/open.service"
systemd-analyze security --offline=true --threshold=20 --no-pager "$scratch/open.service" >/dev/null 2>&1 &&
    fail "a unit without a sandbox passes the threshold"

for word in Type=notify WatchdogSec= SupplementaryGroups=dialout 'DeviceAllow=char-188 rw' 'DeviceAllow=char-166 rw' \
    'DeviceAllow=char-189 rw' 'DeviceAllow=char-ttyS ' RuntimeDirectory=facetd User=facetd 'RestrictAddressFamilies=.* AF_NETLINK'; do
    grep -q "^$word" "$unit" || fail "the unit lacks $word"
done

if command -v systemd-sysusers >/dev/null 2>&1; then
    mkdir -p "$scratch/root/etc"
    touch "$scratch/root/etc/passwd" "$scratch/root/etc/group"
    systemd-sysusers --root="$scratch/root" - <systemd/facetd.sysusers || fail "systemd-sysusers refuses the file"
    grep -q '^facetd:' "$scratch/root/etc/passwd" || fail "no user facetd was made"
    grep -q '^facetd:' "$scratch/root/etc/group" || fail "no group facetd was made"
else
    echo "note: systemd-sysusers is not here; the file of users is not tried"
fi
exit $failed
