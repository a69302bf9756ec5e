#!/bin/bash
# Run in the virtual machine, as root: from a bare plate to a page that hears touches, by the package and its commands.
# The steps go to fingers.steps and browser.steps, the page's events to page.log.
cd /host || exit 1

say() { echo "--- $(cut -d' ' -f1 /proc/uptime) $*"; }
found() { echo "$*" | tee -a /host/found.txt; }
# wait_for SECONDS COMMAND...
wait_for() {
    local end=$(($(cut -d. -f1 /proc/uptime) + $1))
    shift
    until "$@"; do
        [ "$(cut -d. -f1 /proc/uptime)" -lt $end ] || return 1
        sleep 0.5
    done
}
is() { systemctl show touchd --property=StatusText --value | grep -q "^$1"; }
active() { [ "$(systemctl show "$1" --property=ActiveState --value)" = active ]; }
heard() { grep -q "\"$1\"" page.log; }
# person WHAT: whoever sits at the plate
person() {
    PYTHONPATH=/usr/lib/touchd nice -n -10 python3 -B -m tests.system.kiosk.promiseguest "$1" ipc:///run/touchd/bus \
        > "$1.steps" 2> "$1.err"
}

# first_start: the package as it is shipped, and an audio interface named
first_start() {
    dpkg --install touchd_*.deb
    found "$1-installed" $?
    touchd config --default > /etc/touchd/touchd.toml
    sed -i -e 's/^rate_hz = 125$/rate_hz = 25/' -e 's/^device = ""$/device = "hw:CARD=Loopback,DEV=0"/' \
        -e 's/^sample_rate_hz = 192000$/sample_rate_hz = 48000/' -e 's/^band_hz = .*$/band_hz = [8000.0, 22000.0]/' \
        -e 's/^loopback = 0$/loopback = 5/' /etc/touchd/touchd.toml
    # As in docs/integrator.md; and an emulated processor is slow: who listens goes before who draws.
    for unit in touchd touchd-input touchd-web touchd-mapping; do
        mkdir -p /etc/systemd/system/$unit.service.d
        printf '[Service]\nNice=-15\n' > /etc/systemd/system/$unit.service.d/slow.conf
    done
    cp audio.conf /etc/systemd/system/touchd.service.d/
    systemctl daemon-reload
    systemctl enable --now --no-block touchd
    # The plate uses the package's ALSA.
    [ -e plate.log ] ||
        PYTHONPATH=/usr/lib/touchd nice -n -19 python3 -B audioplate.py plate.npz < /run/plate > plate.log 2>&1 4>&- &
    wait_for 300 is uncalibrated
    found "$1-uncalibrated" $?
}

: > found.txt
: > page.log
ip link set lo up
export XDG_RUNTIME_DIR=/run/user/0 HOME=/root
mkdir -p $XDG_RUNTIME_DIR && chmod 700 $XDG_RUNTIME_DIR
modprobe virtio_gpu
modprobe snd-aloop pcm_substreams=1

mkfifo /run/plate
exec 4<> /run/plate

say install
first_start terminal

say calibrate
cd /root || exit 1
cp /host/PLATE.toml .
touchd calibrate -o plate.onnx --plate PLATE.toml > /host/calibrate.out 2>&1
found calibrated $?
say model
touchd model install plate.onnx
found model $?
cd /host || exit 1
say fingers
person fingers
found fingers $?

say first start again
systemctl disable --now --quiet touchd
dpkg --purge touchd
first_start page
say services
systemctl enable --now --quiet touchd-wizard touchd-web
found services $?
wait_for 300 active touchd-wizard
wait_for 300 active touchd-web
address=$(journalctl -u touchd-web -o cat --no-pager | sed -n 's/^touchd: open //p' | tail -n 1)

journalctl -fu 'touchd*' > journal.log 2>&1 4>&- &

say browser
python3 -B pageserver.py >> page.log 2> pageserver.err 4>&- &
printf '[core]\nidle-time=0\nshell=kiosk-shell.so\nrequire-input=false\n[output]\nname=Virtual-1\nmode=1024x768\n' \
    > /run/weston.ini
weston --tty=2 --backend=drm-backend.so --use-pixman --config=/run/weston.ini --socket=wayland-1 \
    --log=/host/weston.log > weston.out 2>&1 4>&- &
wait_for 300 test -S $XDG_RUNTIME_DIR/wayland-1
export WAYLAND_DISPLAY=wayland-1
dbus-run-session chromium --no-sandbox --disable-gpu --kiosk --no-first-run --disable-background-networking \
    --disable-component-update --disable-sync --disable-quic --disable-extensions --disable-hang-monitor \
    --password-store=basic --enable-features=NetworkServiceInProcess2 --touch-events=enabled \
    --disable-features=OptimizationGuideOnDeviceModel,OnDeviceModelService,Vulkan,WebGPU \
    --window-position=0,0 --window-size=1024,768 --user-data-dir=/tmp/browser --ozone-platform=wayland \
    --remote-debugging-port=9222 "$address" > chromium.out 2>&1 4>&- &
listening() { python3 -c 'import urllib.request as u; u.urlopen("http://127.0.0.1:9222/json/version")' 2> /dev/null; }
wait_for 1200 listening
found browser $?
say wizard
person browser
found person $?
say end
