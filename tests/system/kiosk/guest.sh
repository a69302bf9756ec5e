#!/bin/bash
# Run in the virtual machine, as root: the package's touch screen under Weston and Xorg, and what a page in Chromium
# hears of it. The file `parts` names what is tried. The page's events go to page.log, with a line
# `{"kind": "scene NAME"}` before each scene.
cd /host || exit 1

say() { echo "--- $(cut -d' ' -f1 /proc/uptime) $*"; }
found() { echo "$*" | tee -a found.txt; }
# wait_for SECONDS COMMAND...
wait_for() {
    local end=$(($(cut -d. -f1 /proc/uptime) + $1))
    shift
    until "$@"; do
        [ "$(cut -d. -f1 /proc/uptime)" -lt $end ] || return 1
        sleep 0.5
    done
}
bridge() { systemctl show touchd-input --property="$1" --value; }
another_bridge() { [ "$(bridge MainPID)" != "$1" ] && [ "$(bridge ActiveState)" = active ]; }
more_done() { [ "$(grep -c '"done"' screen.bus)" -gt "$1" ]; }
heard() { [ "$(tail -n "+$from" page.log | grep -c "\"$1\"")" -ge "$2" ]; }
quiet() { [ "$(wc -l < page.log)" = "$lines" ] || { lines=$(wc -l < page.log); return 1; }; }
command() {
    local before
    before=$(grep -c '"done"' screen.bus)
    echo "$1" >&5
    wait_for 180 more_done "$before" || say "not done: $1"
}
# mark WORDS: what the page hears is counted from here on
mark() {
    from=$(($(wc -l < page.log) + 1))
    echo "{\"kind\": \"$*\"}" >> page.log
}
# settle KIND TIMES: returns when the page has heard that, and then says nothing more
settle() {
    wait_for 120 heard "$1" "$2" || say "not heard: $*"
    sleep 1
    lines=0
    wait_for 60 quiet
}
# screen_opened PROCESS: a desktop takes the screen some time after the bridge has made it
screen_opened() {
    local name
    name=$(grep -l '^touchd screen$' /sys/class/input/event*/device/name | cut -d/ -f5)
    [ -n "$name" ] && find "/proc/$1/fd" -lname "/dev/input/$name" | grep -q .
}
# scene COMMAND KIND TIMES [LABEL]
scene() {
    mark scene "${4:-$1}"
    command "$1"
    settle "$2" "$3"
}
picture() {
    touch "picture-$1"
    wait_for 120 test -e "picture-$1.taken"
}
browse() {
    mark browse
    dbus-run-session chromium --no-sandbox --disable-gpu --kiosk --no-first-run --disable-background-networking \
        --disable-component-update --disable-sync --disable-quic --disable-extensions --disable-hang-monitor \
        --password-store=basic --enable-features=NetworkServiceInProcess2 --touch-events=enabled \
        --disable-features=OptimizationGuideOnDeviceModel,OnDeviceModelService,Vulkan,WebGPU \
        --window-position=0,0 --window-size=1024,768 --user-data-dir=/tmp/browser "$@" http://127.0.0.1:8000/ \
        > chromium.out 2>&1 5>&- &
    wait_for 1200 heard hello 1
}
leave() {
    pkill -9 -f user-data-dir=/tmp/browser
    sleep 1
    rm -rf /tmp/browser
}
gestures() {
    scene tap touchend 1
    scene swipe touchend 1
    scene pinch touchend 2
    scene five touchend 5
}
# finger_of_a_killed_bridge NAME DESKTOP'S-PROCESS
finger_of_a_killed_bridge() {
    local before
    scene hold touchstart 1 "$1"
    before=$(bridge MainPID)
    kill -9 "$before"
    settle 'touchend\|touchcancel' 1
    wait_for 600 another_bridge "$before"
    found "$1" $?
    command wait
    wait_for 120 screen_opened "$2" || say "not opened: the screen"
    command release
}
weston_with() {
    printf '[core]\nidle-time=0\nshell=kiosk-shell.so\nrequire-input=false\n[output]\nname=Virtual-1\nmode=1024x768\n%s\n' "$1" > /run/weston.ini
    weston --tty=2 --backend=drm-backend.so --use-pixman --config=/run/weston.ini --socket=wayland-1 \
        --log=/host/weston.log > weston.out 2>&1 5>&- &
    desktop=$!
    wait_for 300 test -S $XDG_RUNTIME_DIR/wayland-1
    sleep 3
}
# What a page makes of a finger that leaves the screen before it is lifted.
lifted_elsewhere() {
    mkfifo /run/probe-commands
    exec 6<> /run/probe-commands
    PYTHONPATH=/usr/lib/touchd python3 -B offscreen.py < /run/probe-commands 2> probe.err 5>&- 6>&- &
    wait_for 120 test -e probe.ready
    found probe $?
    wait_for 120 sh -c 'xinput list | grep -q "touchd probe"'
    sleep 2
    for place in there corner outside; do
        mark scene "lifted $place"
        echo $place >&6
        settle 'touchend\|touchcancel' 1
    done
    exec 6>&-
}
no_screen() {
    systemctl stop touchd-input
    exec 5>&-
    kill $screenbus
    wait $screenbus
    rm -r /run/touchd
}

# --- the parts
kills() {
    systemctl stop touchd-input
    stdbuf -oL libinput debug-events > kills.events 2>&1 5>&- &
    libinput=$!
    wait_for 120 grep -q DEVICE_ADDED kills.events
    command flood
    PYTHONPATH=/usr/lib/touchd python3 -B kills.py 100 $libinput > kills.json 5>&-
    found kills $?
    command calm
    kill $libinput
    wait $libinput 2> /dev/null
    systemctl start touchd-input
    command wait
}

wayland() {
    export WAYLAND_DISPLAY=wayland-1
    weston_with ""
    browse --ozone-platform=wayland
    found weston-page $?
    sleep 5
    mark begin weston
    gestures
    scene corner touchend 2
    picture weston
    finger_of_a_killed_bridge weston-killed $desktop
    scene tap touchend 1 "tap after"
    leave
    touchd doctor > doctor.txt 2>&1
    kill $desktop
    wait $desktop
}

turned() {
    export WAYLAND_DISPLAY=wayland-1
    weston_with transform=rotate-90
    browse --ozone-platform=wayland
    found turned-page $?
    sleep 5
    mark begin turned
    scene tap touchend 1
    picture turned
    leave
    kill $desktop
    wait $desktop
}

x11() {
    local output
    printf 'Section "ServerFlags"\n Option "DontVTSwitch" "true"\n Option "BlankTime" "0"\nEndSection\nSection "Device"\n Identifier "g"\n Driver "modesetting"\n Option "AccelMethod" "none"\nEndSection\n' > /run/xorg.conf
    export DISPLAY=:0
    Xorg :0 -config /run/xorg.conf -noreset -nolisten tcp -ac vt1 -keeptty > xorg.out 2>&1 5>&- &
    desktop=$!
    wait_for 300 xset q > /dev/null 2>&1
    found xorg $?
    browse --ozone-platform=x11
    found xorg-page $?
    sleep 5
    mark begin xorg
    gestures
    picture xorg
    output=$(xrandr | sed -n 's/ connected.*//p' | head -n 1)
    xrandr --output "$output" --rotate left
    sleep 5
    mark begin xorg-turned
    scene tap touchend 1 "tap turned"
    xinput map-to-output "touchd screen" "$output"
    scene tap touchend 1 "tap mapped"
    xrandr --output "$output" --rotate normal
    xinput map-to-output "touchd screen" "$output"
    sleep 5
    mark begin xorg-killed
    finger_of_a_killed_bridge xorg-killed $desktop
    scene hold touchstart 1 "stopped"
    systemctl stop touchd-input
    found xorg-stopped "$(bridge Result)"
    settle touchend 1
    lifted_elsewhere
    leave
    kill $desktop
    wait $desktop
}

# shellcheck source=/dev/null
. ./audio.sh

ip link set lo up
: > found.txt
: > page.log
export XDG_RUNTIME_DIR=/run/user/0 HOME=/root
mkdir -p $XDG_RUNTIME_DIR && chmod 700 $XDG_RUNTIME_DIR
modprobe virtio_gpu
say package
dpkg --install touchd_*.deb
found installed $?
touchd config --default > /etc/touchd/touchd.toml
sed -i 's/^screen_mm = \[\]$/screen_mm = [0.0, 0.0, 200.0, 200.0]/' /etc/touchd/touchd.toml
# A browser that starts leaves an emulated processor nothing for others: bus and bridge come first.
mkdir -p /run/systemd/system/touchd-input.service.d
printf '[Service]\nNice=-19\n' > /run/systemd/system/touchd-input.service.d/slow.conf
systemctl daemon-reload
mkfifo /run/screen-commands
exec 5<> /run/screen-commands
PYTHONPATH=/usr/lib/touchd nice -n -19 python3 -B screenbus.py < /run/screen-commands > screen.bus 2> screen.err 5>&- &
screenbus=$!
python3 -B pageserver.py >> page.log 2> pageserver.err 5>&- &
wait_for 600 test -S /run/touchd/bus
systemctl start --no-block touchd-input
wait_for 600 another_bridge 0
found screen-starts $?
command wait

while read -r part; do
    say "$part"
    "$part" < /dev/null
done < parts
journalctl -u touchd -u touchd-input --no-pager > journal.log
say end
