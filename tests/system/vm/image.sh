#!/bin/bash
# Make the virtual machine of `make vm-test`: Debian's generic kernel (the cloud kernel has no USB), a minimal Debian
# with systemd and udev, and an initrd of busybox and the few modules that reach the disk.
#
# usage: image.sh FOLDER [kiosk]    FOLDER then holds vmlinux, initrd.img and root.ext4; an interrupted run leaves none.
#                                   kiosk: with a picture, Weston, X and Chromium, and a sound card, for
#                                   `make kiosk-test`.
set -euo pipefail
export LC_ALL=C

final=$1
packages=systemd,systemd-sysv,udev,kmod,dbus,python3,libusb-1.0-0,iproute2,procps,libinput-tools
guest=(usbcore vhci_hcd dummy_hcd libcomposite usb_f_fs configfs autofs4 uinput evdev)
if [ "${2:-}" = kiosk ]; then
    packages+=,dbus-user-session,libasound2,weston,chromium,fonts-dejavu-core,libgl1-mesa-dri
    packages+=,xserver-xorg-core,xserver-xorg-input-libinput,xinput,x11-xserver-utils
    guest+=(virtio-gpu snd-aloop)
fi
suite=bookworm
work=$(mktemp -d -p "$(dirname "$final")" making.XXXXXX)
trap 'rm -rf "$work"' EXIT
chmod 755 "$work"
cd "$work"

# --- packages. apt-get drops its rights for a download, and may then not write here: as root, in this folder.
kernel_package() {
    apt-cache depends linux-image-amd64 2>/dev/null | sed -n 's/^ *Depends: \(linux-image-.*-amd64\)$/\1/p' | head -n 1
}
[ -n "$(kernel_package)" ] || apt-get update -qq >&2
kernel=$(kernel_package)
[ -n "$kernel" ] || { echo "image.sh: apt knows no linux-image-amd64" >&2; exit 1; }
sources=/etc/apt/sources.list.d/debian.sources
[ -e $sources ] || sources=/etc/apt/sources.list
apt-get -o APT::Sandbox::User=root download -qq "$kernel" >&2
dpkg-deb -x "$kernel"_*.deb kernel
mmdebstrap --quiet --variant=minbase --mode=root \
    --aptopt='Acquire::Languages "none"' \
    --dpkgopt='path-exclude=/usr/share/doc/*' --dpkgopt='path-exclude=/usr/share/man/*' \
    --dpkgopt='path-exclude=/usr/share/locale/*' \
    --aptopt='APT::Install-Recommends "false"' --include=$packages \
    "$suite" root $sources >&2
rm -rf root/var/cache/apt/* root/var/lib/apt/lists/*

# --- kernel, uncompressed: QEMU then starts it by PVH, and without KVM the unpacking would take seconds.
modules=$PWD/kernel
release=$(ls kernel/lib/modules)
depmod -b "$modules" "$release"
python3 - kernel/boot/vmlinuz-"$release" vmlinux <<'PYTHON'
import lzma, sys

packed = open(sys.argv[1], "rb").read()
start = packed.find(b"\xfd7zXZ\x00")
open(sys.argv[2], "wb").write(lzma.LZMADecompressor().decompress(packed[start:]))
PYTHON

# The files of the named modules and all they need, in loading order.
closure() {
    for name in "$@"; do
        modprobe -d "$modules" -S "$release" --show-depends "$name" | awk '/^insmod/ {print $2}'
    done | awk '!seen[$0]++'
}

# --- initrd
boot=(virtio_pci virtio_blk ext4 crc32c_generic 9p 9pnet_virtio)
mkdir -p initrd/bin initrd/lib/m initrd/proc initrd/dev initrd/new
cp /bin/busybox initrd/bin/
number=100
for file in $(closure "${boot[@]}"); do
    cp "$file" "initrd/lib/m/$number-$(basename "$file")"
    number=$((number + 1))
done
cat > initrd/init <<'INIT'
#!/bin/busybox sh
/bin/busybox mount -t proc p /proc
/bin/busybox mount -t devtmpfs d /dev
for m in /lib/m/*; do /bin/busybox insmod $m; done
n=0
while [ ! -b /dev/vda ] && [ $n -lt 200 ]; do /bin/busybox usleep 20000; n=$((n + 1)); done
/bin/busybox mount -t ext4 -o rw,noatime /dev/vda /new || exec /bin/busybox sh
/bin/busybox mount --move /dev /new/dev
/bin/busybox umount /proc
exec /bin/busybox switch_root /new /sbin/init
INIT
chmod +x initrd/init
(cd initrd && find . | cpio --quiet -o -H newc) | gzip -1 > initrd.img

# --- root: modules of the USB device side, of USB/IP and of input devices, and a target that runs what the host hands in.
target=root/lib/modules/$release
mkdir -p "$target" root/host
for file in $(closure "${boot[@]}" "${guest[@]}"); do
    inside=root/lib/modules/${file#*/lib/modules/}
    mkdir -p "$(dirname "$inside")"
    cp "$file" "$inside"
done
cp kernel/lib/modules/"$release"/modules.{builtin,builtin.modinfo,order} "$target"/
depmod -b root "$release"
cat > root/etc/systemd/system/hosttest.service <<'UNIT'
[Unit]
Description=Run /host/run.sh, hand back its output and status, and power off
After=basic.target dbus.service
[Service]
Type=oneshot
ExecStartPre=/bin/mount -t 9p -o trans=virtio,version=9p2000.L,msize=262144 host /host
ExecStart=/bin/sh -c 'bash /host/run.sh > /host/out.log 2>&1; echo $? > /host/status; sync'
ExecStopPost=/bin/systemctl --no-block poweroff
UNIT
cat > root/etc/systemd/system/hosttest.target <<'UNIT'
[Unit]
Description=A minimal boot for tests
Requires=basic.target
Wants=hosttest.service dbus.service
After=basic.target
AllowIsolate=yes
UNIT
for unit in systemd-timesyncd.service systemd-networkd.service systemd-resolved.service getty@tty1.service \
    serial-getty@ttyS0.service systemd-logind.service systemd-binfmt.service systemd-update-utmp.service \
    systemd-journal-flush.service systemd-random-seed.service systemd-user-sessions.service \
    systemd-firstboot.service systemd-pstore.service apt-daily.timer apt-daily-upgrade.timer \
    dpkg-db-backup.timer e2scrub_all.timer fstrim.timer sys-kernel-debug.mount sys-kernel-tracing.mount \
    dev-hugepages.mount dev-mqueue.mount sys-fs-fuse-connections.mount proc-sys-fs-binfmt_misc.automount; do
    ln -sf /dev/null "root/etc/systemd/system/$unit"
done
echo guest > root/etc/hostname
echo 0123456789abcdef0123456789abcdef > root/etc/machine-id
: > root/etc/fstab
size=$(($(du -sm root | cut -f1) * 12 / 10 + 500))
truncate -s ${size}M root.ext4
mkfs.ext4 -q -O ^has_journal -m 0 -d root root.ext4

rm -rf kernel initrd root ./*.deb
chmod 755 .
mv -T "$work" "$final"
