# Simulated scanners on the guest's own USB controllers, for rows; $scratch is a folder of the row.
# Their walls are 2 m away, out of the range that the rows configure: what is tried is the way to the daemon, and the guest is
# slow.
# controllers ARGUMENTS: of dummy_hcd, whose host and device sides are this machine.
controllers() {
    modprobe -r dummy_hcd 2>/dev/null
    modprobe dummy_hcd "$@" || { echo "this kernel has no dummy_hcd"; exit 77; }
}
# plug NAME SERIAL [CONTROLLER]: a scanner; orders go to it by `order NAME WORDS`, what it says stands in $scratch/NAME.
plug() {
    mkfifo $scratch/$1.orders
    "$BUILD/tests/gadget" "$@" <>$scratch/$1.orders >>$scratch/$1 2>&1 &
    gadgets="$gadgets $!"
    until_true 20 enumerated "$2" || { cat $scratch/$1; fail "the kernel does not see the scanner"; }
}
enumerated() {
    grep -qx "$1" /sys/bus/usb/devices/*/serial 2>/dev/null
}
speed_of() {
    cat "$(dirname "$(grep -lx "$1" /sys/bus/usb/devices/*/serial)")/speed"
}
order() {
    name=$1
    shift
    echo "$*" >$scratch/$name.orders
}
# counted NAME KEY: of what the scanner counted, asked now.
counted() {
    : >$scratch/$1
    order "$1" counts
    until_true 10 grep -q '^profiles' $scratch/$1
    grep -o "$2 [0-9]*" $scratch/$1 | head -n 1 | cut -d' ' -f2
}
# streams NAME: many more profiles than now.
streams() {
    until_true 20 at_least "$1" profiles 0
    from=$(status_of "$1" profiles)
    until_true 60 at_least "$1" profiles $((${from:-0} + 15)) || fail "$1 does not stream: $(status_of "$1" state)"
}
gone() {
    [ "$(status_of laser state)" != streaming ]
}
returned() { # TIMES
    grep -q "^plugged in $1 times; first request after" $scratch/laser
}
# Pulls laser out and plugs it in again, three times: $requests, the ms from plugging to the first request, and $best of them: a
# busy machine may be slow once, not always.
pull_and_plug() {
    best=99999 requests=
    for time in 2 3 4; do
        order laser unplug on
        until_true 20 gone || fail "the daemon does not notice that it has gone"
        [ $time != 3 ] || sleep 5 # away for longer, too
        order laser unplug off
        until_true 30 returned $time || { cat $scratch/laser; fail "no request after it was plugged in again"; }
        ms=$(sed -n "s/^plugged in $time times; first request after \([0-9]*\) ms/\1/p" $scratch/laser)
        [ "$ms" -ge $best ] || best=$ms
        requests="$requests $ms"
        streams laser
    done
}
