#!/bin/sh
# Law: the service is as locked up as it can be and still reaches its devices: units and udev rules are valid, its exposure is
# below 2.0 (as a dynamic user, too), what `make install` puts there is what they need, and systemd knows every word of the
# file of users.
. "$(dirname "$0")/lib.sh"
if ! command -v systemd-analyze >/dev/null 2>&1; then
    echo "systemd-analyze is not here: install the package systemd (make deps)"
    exit 77
fi

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

# As a user that systemd makes up: still within the threshold, and still in the devices' group.
mkdir -p "$unit.d"
cp systemd/dynamic-user.conf "$unit.d/"
report=$(systemd-analyze security --offline=true --threshold=20 --no-pager "$unit" 2>&1)
status=$?
echo "note: as a dynamic user $(echo "$report" | sed -n 's/.*exposure level for facetd.service: \([0-9.]*\).*/\1/p')"
[ "$status" -ne 0 ] && { echo "$report"; fail "as a dynamic user: exposure 2.0 or more"; }
grep -q '^SupplementaryGroups=dialout' "$unit.d/dynamic-user.conf" || fail "the dynamic user is not in the devices' group"
said=$(systemd-analyze verify --man=no "$unit" 2>&1) || fail "systemd-analyze verify with the drop-in"
echo "$said" | grep 'facetd\.s\|dynamic-user' && fail "systemd-analyze verify finds something in the drop-in"
rm -r "$unit.d"

# The check can fail: without the sandbox the same program is far above the threshold.
grep -v '^Protect\|^Restrict\|^SystemCall\|^Capability\|^Private\|^NoNew\|^Device' "$unit" >"$scratch/open.service"
systemd-analyze security --offline=true --threshold=20 --no-pager "$scratch/open.service" >/dev/null 2>&1 &&
    fail "a unit without a sandbox passes the threshold"

for word in Type=notify WatchdogSec= SupplementaryGroups=dialout 'DeviceAllow=char-188 rw' 'DeviceAllow=char-166 rw' \
    'DeviceAllow=char-189 rw' 'DeviceAllow=char-ttyS ' RuntimeDirectory=facetd User=facetd 'RestrictAddressFamilies=.* AF_NETLINK' 'RestrictAddressFamilies=.* AF_CAN'; do
    grep -q "^$word" "$unit" || fail "the unit lacks $word"
done

# The rules give the scanner to the group that the unit is in, and name that unit. (udevd reads them in check-vm-systemd.)
rules=systemd/70-facetd.rules
grep -q 'ATTR{idVendor}=="19a2", ATTR{idProduct}=="5001".*GROUP="dialout", MODE="0660"' $rules || fail "the rules miss the scanner"
grep -q 'ENV{SYSTEMD_WANTS}+="facetd.service"' $rules || fail "the rules start nothing"
[ "$(sed 's/\\$//' $rules | grep -v '^#' | grep -o 'LABEL="[^"]*"\|GOTO="[^"]*"' | sed 's/.*=//' | sort -u | wc -l)" -eq 1 ] ||
    fail "a GOTO of the rules goes nowhere"
grep -q '^ListenStream=/run/facetd/facetd.sock$' systemd/facetd.socket.in || fail "the socket unit is not where clients look"
grep -q '^RuntimeDirectoryPreserve=yes' "$unit" || fail "stopping the service takes the socket unit's door away"

# What is installed, and where.
config=${FACET_BUILD:-build}
config=${config#build}
config=${config#/}
if make -s --no-print-directory install config="${config:-release}" DESTDIR="$scratch/image" PREFIX=/usr >"$scratch/install" 2>&1; then
    for file in bin/facetd bin/facet lib/systemd/system/facetd.service lib/systemd/system/facetd.socket \
        lib/udev/rules.d/70-facetd.rules lib/sysusers.d/facetd.conf share/doc/facetd/dynamic-user.conf share/doc/facetd/facetd.yaml; do
        [ -s "$scratch/image/usr/$file" ] || fail "make install leaves out $file"
    done
    grep -rIl '@[A-Z]*@' "$scratch/image/usr/lib" && fail "a placeholder is left in what is installed"
else
    cat "$scratch/install"
    fail "make install"
fi

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
