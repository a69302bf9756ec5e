#!/bin/bash
# Install touchd under /opt/touchd, with Debian's python3, and its service; or remove it again. As root.
#
# usage: deploy/install.sh [--wheels FOLDER] [--extras NAMES]    again after a change: it brings everything up to date
#        deploy/install.sh --uninstall [--purge]                 --purge: configuration and kept recordings as well
#
# --wheels installs from a folder of wheels alone, without a network. To fill it, on a computer with one:
#     pip wheel --wheel-dir FOLDER --constraint requirements.lock .
# DESTDIR, if set, is a folder that stands for /: nothing outside it is touched, and no service is started.
set -euo pipefail

cd "$(dirname "$0")/.."
root=${DESTDIR:-}
prefix=/opt/touchd
python=${PYTHON:-/usr/bin/python3}
units=$root/etc/systemd/system
services="touchd.service touchd-input.service touchd-tuio.service touchd-web.service touchd-wizard.service"
helpers="touchd-mapping.service touchd-mapping.path"
rules=$root/etc/udev/rules.d/60-touchd.rules
sysusers=$root/etc/sysusers.d/touchd.conf
tmpfiles=$root/etc/tmpfiles.d/touchd.conf
link=$root/usr/local/bin/touchd
config=$root/etc/touchd/touchd.toml

fail() {
    echo "install.sh: $1" >&2
    exit 1
}

# Whether there is a system to tell of changes.
running() { [ -z "$root" ] && [ -d /run/systemd/system ]; }

uninstall() {
    if running; then
        # shellcheck disable=SC2086 # a list of words is meant
        systemctl disable --now --quiet $services touchd-mapping.path 2>/dev/null || true
    fi
    rm -rf "$root$prefix" "$root$prefix.new" "$root$prefix.old"
    for service in $services $helpers; do rm -f "$units/$service"; done
    rm -f "$rules" "$sysusers" "$tmpfiles" "$link"
    if [ "$1" = purge ]; then
        rm -rf "$root/var/lib/private/touchd" "$root/var/lib/touchd"
        # Keys stay, wherever they are: other computers may know them.
        rm -f "$config" "$config.default"
        [ ! -d "$root/etc/touchd" ] || rmdir --ignore-fail-on-non-empty "$root/etc/touchd"
    fi
    if running; then
        systemctl daemon-reload
        udevadm control --reload || true
    fi
    echo "touchd is removed"
}

install_all() {
    local wheels=$1 extras=$2 from=(--constraint requirements.lock)
    [ -z "$wheels" ] || from=(--no-index --find-links "$wheels")
    "$python" -c 'import sys; sys.exit(sys.version_info < (3, 11))' || fail "$python is older than 3.11"
    "$python" -c 'import ensurepip, venv' 2>/dev/null || fail "$python has no venv: apt install python3-venv"

    # Built beside the old one, then put in its place: an installation that fails leaves the old one.
    local new=$root$prefix.new
    rm -rf "$new"
    "$python" -m venv "$new"
    local pip=("$new/bin/python" -m pip --quiet --disable-pip-version-check install)
    if [ -n "$wheels" ]; then
        "${pip[@]}" "${from[@]}" "touchd$extras"
    else
        "${pip[@]}" "${from[@]}" ".$extras"
    fi
    # The environment names its own place in its scripts.
    grep -rlIZ "$prefix.new" "$new/bin" "$new/pyvenv.cfg" | xargs -0 --no-run-if-empty sed -i "s#$new#$prefix#g"
    # Drop-ins for systemd, to copy: as in the package, under share/doc.
    local examples=$new/share/doc/touchd/examples
    install -d "$examples"
    sed "s#/usr/bin/touchd#$prefix/bin/touchd#" deploy/audio.conf > "$examples/audio.conf"
    cp deploy/realtime.conf "$examples"
    chmod -R go+rX "$new"
    # To remove the old one takes its time: a power cut meanwhile leaves the new one.
    rm -rf "$root$prefix.old"
    [ ! -e "$root$prefix" ] || mv -T "$root$prefix" "$root$prefix.old"
    mv -T "$new" "$root$prefix"
    rm -rf "$root$prefix.old"

    install -d "$units" "$(dirname "$rules")" "$(dirname "$sysusers")" "$(dirname "$tmpfiles")" \
        "$(dirname "$link")" "$(dirname "$config")"
    for service in $services $helpers; do
        sed "s#/usr/bin/touchd#$prefix/bin/touchd#" "deploy/$service" > "$units/$service"
        chmod 644 "$units/$service"
    done
    install -m 644 deploy/60-touchd.rules "$rules"
    install -m 644 deploy/sysusers.conf "$sysusers"
    install -m 644 deploy/tmpfiles.conf "$tmpfiles"
    ln -sfn "$prefix/bin/touchd" "$link"
    # Beside what an administrator may write, the defaults of this version. A copy of them would keep them for good.
    install -m 644 deploy/touchd.toml "$config.default"

    if running; then
        systemd-sysusers touchd.conf
        systemctl daemon-reload
        udevadm control --reload
        udevadm trigger --action=change --subsystem-match=usb --property-match=DEVTYPE=usb_device
        udevadm trigger --action=change --subsystem-match=misc --sysname-match=cpu_dma_latency
        udevadm trigger --action=change --subsystem-match=misc --sysname-match=uinput
        # shellcheck disable=SC2086 # a list of words is meant
        systemctl try-restart $services
        echo "touchd is installed: it starts when the DAQ is plugged in; touchd doctor checks the set-up"
    else
        echo "touchd is installed under ${root:-/}"
    fi
}

[ "$(id -u)" -eq 0 ] || [ -n "$root" ] || fail "run it as root"
action=install purge=keep wheels="" extras=""
while [ $# -gt 0 ]; do
    case $1 in
    --uninstall) action=uninstall ;;
    --purge) purge=purge ;;
    --wheels)
        wheels=$(realpath "${2:?a folder is missing}")
        shift
        ;;
    --extras)
        extras="[${2:?names are missing}]"
        shift
        ;;
    -h | --help)
        sed -n '2,/^set/s/^# \{0,1\}//p' "$0"
        exit 0
        ;;
    *) fail "unknown option $1; see --help" ;;
    esac
    shift
done
# Two at once would build in one folder. The lock ends with this process and leaves no file.
install -d "$root${prefix%/*}"
exec 9< "$root${prefix%/*}"
flock --nonblock 9 || fail "another install.sh is at work: wait for its end"
if [ "$action" = uninstall ]; then
    uninstall "$purge"
else
    install_all "$wheels" "$extras"
fi
