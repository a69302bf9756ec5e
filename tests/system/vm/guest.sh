#!/bin/bash
# Run in the virtual machine, as root: the package, a DAQ on the kernel's own USB, and the scenario; what was seen goes
# to /host/found.txt as `name value` lines.
cd /host || exit 1

say() { echo "--- $(cut -d' ' -f1 /proc/uptime) $*"; }
found() { echo "$*" | tee -a /host/found.txt; }
show() { systemctl show touchd --property="$1" --value; }
# wait_for SECONDS COMMAND...
wait_for() {
    local end=$(($(cut -d. -f1 /proc/uptime) + $1))
    shift
    until "$@"; do
        [ "$(cut -d. -f1 /proc/uptime)" -lt $end ] || return 1
        sleep 0.5
    done
}
active() { [ "$(show ActiveState)" = active ]; }
another_process() { [ "$(show MainPID)" != "$1" ] && active; }
keeps_awake() { find "/proc/$(show MainPID)/fd" -lname /dev/cpu_dma_latency | grep -q .; }
streaming() { show StatusText | grep -q '^streaming: '; }

lost() { show StatusText | grep -q '^lost: '; }
# scenario NAME DESCRIPTOR: the client of all tests steers the device by the lines that it prints
scenario() {
    say "scenario on $1"
    PYTHONPATH=/usr/lib/touchd python3 -B client.py ipc:///run/touchd/bus --patience 120 --lift-ms 5000 2> "$1.err" |
        tee "$1.steps" | grep --line-buffered '^!' >&"$2"
    found "$1-scenario" "${PIPESTATUS[0]}"
}

# libinput's view of all input devices, in NAME.events, until `unwatch`
watch() {
    stdbuf -oL libinput debug-events > "$1.events" 2>&1 &
    libinput=$!
    wait_for 60 grep -q DEVICE_ADDED "$1.events"
}
unwatch() { sleep 1; kill $libinput; wait $libinput 2> /dev/null; }
# scene COMMAND...: to the bus that stands for the daemon's; returns when it is done
scene() {
    local command before
    for command in "$@"; do
        before=$(grep -c "\"done\"" screen.bus)
        echo "$command" >&5
        wait_for 180 more_done "$before" || say "not done: $command"
    done
}
more_done() { [ "$(grep -c "\"done\"" screen.bus)" -gt "$1" ]; }
bridge() { systemctl show touchd-input --property="$1" --value; }
another_bridge() { [ "$(bridge MainPID)" != "$1" ] && [ "$(bridge ActiveState)" = active ]; }
sees() { [ "$(grep -c "$2" "$1.events")" -ge "$3" ]; }

ip link set lo up
: > found.txt
modprobe dummy_hcd

say package
dpkg --install touchd_*.deb
found installed $?
touchd config --default > /etc/touchd/touchd.toml
# An emulated processor is slow: fewer frames, all else as shipped.
sed -i 's/^rate_hz = 125$/rate_hz = 40/' /etc/touchd/touchd.toml
# The gadget plays the plate of the shipped model.
sed -i 's|^path = ""$|path = "/usr/lib/touchd/touchd/models/regression.onnx"|' /etc/touchd/touchd.toml
found before-plug "$(show ActiveState)"

say screen
found screen-shipped "$(systemctl is-enabled touchd-input touchd-tuio touchd-web touchd-wizard 2>&1 | sort -u)"
sed -i 's/^screen_mm = \[\]$/screen_mm = [0.0, 0.0, 200.0, 200.0]/' /etc/touchd/touchd.toml
mkfifo /run/screen-commands
exec 5<> /run/screen-commands
PYTHONPATH=/usr/lib/touchd python3 -B screenbus.py < /run/screen-commands > screen.bus 2> screen.err 5>&- &
screenbus=$!
wait_for 240 test -S /run/touchd/bus
systemctl start --no-block touchd-input
wait_for 240 another_bridge 0
found screen-starts $?
scene wait
found screen-node "$(stat -c '%G %a' /dev/uinput)"
found screen-user "$(ps -o user= -p "$(bridge MainPID)")"
found screen-memory "$(sed -n 's/^VmRSS:[^0-9]*\([0-9]*\) kB/\1/p' "/proc/$(bridge MainPID)/status")"
timeout 100 touchd input --bus ipc:///run/touchd/bus
found screen-second $?
# From here on by an udev that has started again: it knows the screen, and the ones that come after it.
systemctl restart systemd-udevd
found udev-restarted $?
libinput list-devices > screen.devices
watch screen
scene tap swipe pinch five corner tap
unwatch
say screen ends
watch ends
scene hold silence
wait_for 240 sees ends TOUCH_UP 1
found screen-silence $?
scene hold
before=$(bridge MainPID)
kill -9 "$before"
wait_for 180 another_bridge "$before"
found screen-killed $?
scene wait release hold
before=$(bridge MainPID)
kill -STOP "$before"
wait_for 180 another_bridge "$before"
found screen-frozen "$? $(journalctl -u touchd-input -o cat --no-pager | grep -c 'Watchdog timeout')"
scene wait release hold
systemctl stop touchd-input
found screen-stopped "$(bridge Result)"
unwatch
exec 5>&-
kill $screenbus
rm -r /run/touchd

say plug
mkfifo /run/commands
# Open for as long as the script runs, so that the device stays when a scenario ends.
exec 3<> /run/commands
touchd gadget --commands --replay /usr/lib/touchd/touchd/demo/session.npz < /run/commands > gadget.log 2>&1 3>&- &
gadget=$!
wait_for 240 active
found started-by-plug $?
found group "$(stat -c '%G %a' /dev/bus/usb/*/* | grep touchd | head -n 1)"
found user "$(ps -o user= -p "$(show MainPID)")"

found bus "$(stat -c '%G %a' /run/touchd/bus)"
scenario gadget 3

say killed
before=$(show MainPID)
kill -9 "$before"
wait_for 240 another_process "$before"
found killed-restarts $?
wait_for 240 streaming
found killed-streams $?

say frozen
before=$(show MainPID)
kill -STOP "$before"
wait_for 240 another_process "$before"
found frozen-restarts $?
found frozen-said "$(journalctl -u touchd -o cat --no-pager | grep -c 'Watchdog timeout')"

say touched again
wait_for 240 streaming
touchd listen --topic touch --timeout 240 --json --count 1 > /dev/null
found touched-again $?

say screen on the plate
systemctl start --no-block touchd-input
wait_for 240 another_bridge 0
watch plate
touchd listen --topic touch --timeout 240 --json --count 400 > plate.bus
found plate-heard $?
unwatch
systemctl enable --quiet touchd-input

say unplug for good
echo unplug >&3
wait_for 240 lost
found lost $?
found lost-active "$(show ActiveState)"
systemctl stop touchd
found stopped "$(show Result) $(show ExecMainStatus)"
found screen-stops-too "$(bridge ActiveState)"

say replug starts it again
# For once so few frames count as many. A processor that is kept awake is emulated too: no longer than needed.
sed -i 's/^awake_from_hz = 500.0$/awake_from_hz = 30.0/' /etc/touchd/touchd.toml
echo plug >&3
wait_for 240 active
found replug-starts $?
wait_for 240 another_bridge 0
found screen-starts-too $?
systemctl disable --now --quiet touchd-input
wait_for 240 keeps_awake
found keeps-awake "$? $(stat -c '%G %a' /dev/cpu_dma_latency)"
sed -i 's/^awake_from_hz = 30.0$/awake_from_hz = 500.0/' /etc/touchd/touchd.toml

say the same on USB/IP
echo unplug >&3
modprobe vhci_hcd
systemctl stop touchd
mkfifo /run/usbip-commands
exec 4<> /run/usbip-commands
PYTHONPATH=/usr/lib/touchd python3 -B usbipdaq.py untouched.bin touched.bin < /run/usbip-commands > usbip.log 2>&1 4>&- 3>&- &
wait_for 240 active
found usbip-starts $?
scenario usbip 4
say pulled
before=$(show MainPID)
echo pull >&4
wait_for 240 lost
found pulled-lost $?
echo plug >&4
wait_for 240 streaming
found pulled-streams "$? $([ "$(show MainPID)" = "$before" ] && echo same-process)"

say removed
dpkg --remove touchd
found removed "$? $(systemctl show touchd -p LoadState --value) $(ls -d /usr/lib/touchd 2> /dev/null)"
dpkg --purge touchd
found purged "$? $(ls -d /etc/touchd /var/lib/touchd /var/lib/private/touchd 2> /dev/null)"
kill $gadget 2> /dev/null
journalctl -u touchd -u touchd-input --no-pager > journal.log
say end
