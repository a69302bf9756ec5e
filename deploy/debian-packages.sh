#!/bin/sh
# Install the Debian packages that touchd needs: `run` for the daemon and the demo, `test` for all tests as well, `vm`
# for those in a virtual machine.
# Does nothing, at once, when they are there.
set -eu

case "${1:-run}" in
# pyalsaaudio is compiled, as it has no wheel.
run) wanted="python3-venv gcc libc6-dev libasound2-dev python3-dev" ;;
# umockdev and what it needs: the mocked kernel of tests/system/usb.
test)
    wanted="python3-venv gcc libc6-dev libasound2-dev python3-dev libzmq3-dev umockdev gir1.2-umockdev-1.0 python3-gi libusb-1.0-0"
    # What is shipped for the system is checked by the system's own tools.
    wanted="$wanted systemd udev shellcheck python3"
    # The page in a browser, with letters in it.
    wanted="$wanted chromium fonts-dejavu-core"
    ;;
vm) wanted="python3 qemu-system-x86 mmdebstrap busybox-static e2fsprogs kmod cpio" ;;
*) echo "usage: $0 run|test|vm" >&2; exit 2 ;;
esac

# A python3 of another origin may bring venv and pip without Debian's package.
if python3 -c 'import ensurepip, venv' 2>/dev/null; then
    # shellcheck disable=SC2086 # a list of words is meant
    wanted=$(printf '%s\n' $wanted | grep -v '^python3-venv$' || true)
fi

if python3 -c 'import os, sysconfig; os.stat(sysconfig.get_path("include") + "/Python.h")' 2>/dev/null; then
    # shellcheck disable=SC2086 # a list of words is meant
    wanted=$(printf '%s\n' $wanted | grep -v '^python3-dev$' || true)
fi

# The Node.js example runs on any Node; Debian's is only needed where there is none.
if [ "${1:-run}" = test ]; then
    command -v node >/dev/null || wanted="$wanted nodejs"
    command -v npm >/dev/null || wanted="$wanted npm"
fi

missing=""
for package in $wanted; do
    dpkg-query -W -f '${Status}' "$package" 2>/dev/null | grep -q 'install ok installed' || missing="$missing $package"
done
[ -n "$missing" ] || exit 0

as_root=""
if [ "$(id -u)" -ne 0 ]; then
    if ! command -v sudo >/dev/null; then
        echo "touchd needs these packages; as root: apt-get install$missing" >&2
        exit 1
    fi
    as_root=sudo
fi
echo "installing:$missing" >&2
export DEBIAN_FRONTEND=noninteractive
$as_root apt-get update -qq
# shellcheck disable=SC2086 # a list of words is meant
$as_root apt-get install -qq -y --no-install-recommends $missing >/dev/null
