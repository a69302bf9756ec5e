# Part of guest.sh: the daemon with an audio interface, the kernel's loopback card with a plate behind it.
# shellcheck shell=bash
active() { [ "$(systemctl show touchd --property=ActiveState --value)" = active ]; }

audio() {
    no_screen
    wait_for 900 test -e places.json
    cp audio.onnx audio.atlas.npz /etc/touchd/
    chmod 644 /etc/touchd/audio.*
    cat > /etc/touchd/touchd.toml << 'TOML'
[device]
rate_hz = 25
[audio]
device = "hw:CARD=Loopback,DEV=0"
sample_rate_hz = 48000
band_hz = [5000.0, 20000.0]
[model]
path = "/etc/touchd/audio.onnx"
[bus]
bind = ["ipc:///run/touchd/bus"]
TOML
    mkdir -p /etc/systemd/system/touchd.service.d
    cp audio.conf /etc/systemd/system/touchd.service.d/
    systemctl daemon-reload
    systemctl restart --no-block touchd
    wait_for 600 active
    PYTHONPATH=/usr/lib/touchd python3 -B audioscenario.py ipc:///run/touchd/bus "$(cat places.json)" > audio.steps 2> audio.err
    found audio-scenario $?
    systemctl stop touchd
    rm -r /etc/systemd/system/touchd.service.d /etc/touchd/audio.*
    systemctl daemon-reload
}
