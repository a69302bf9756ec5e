#!/bin/bash
# Boot this computer's own systemd as the first process of namespaces of its own, over a copy of `/` that is thrown
# away, run OUT/inside.py in it by Debian's python3, and power off.
#
# usage: boot.sh OUT CHECKOUT SITE    OUT, the checkout and its installed packages appear as /out, /checkout and /site
set -euo pipefail

out=$(realpath "$1") checkout=$(realpath "$2") site=$(realpath "$3")
export out checkout site
cgroups=/sys/fs/cgroup
[ ! -d $cgroups/unified ] || cgroups=$cgroups/unified
group=$cgroups/touchd-test-$$
mkdir "$group"
# shellcheck disable=SC2317 # called by trap
cleanup() {
    [ ! -e "$group/cgroup.kill" ] || echo 1 > "$group/cgroup.kill"
    find "$group" -depth -type d -exec rmdir {} + 2>/dev/null || true
}
trap cleanup EXIT
trap 'exit 1' TERM

# shellcheck disable=SC2016 # expanded by the inner shell
in_namespaces='
set -e
work=/run
mount -t tmpfs none $work
mkdir $work/upper $work/work $work/root
mount -t overlay none -o lowerdir=/,upperdir=$work/upper,workdir=$work/work $work/root
cd $work/root
mkdir -p out checkout site
mount --bind "$out" out
mount --bind -o ro "$checkout" checkout
mount --bind -o ro "$site" site
mount -t proc none proc
mount -o bind proc/sys proc/sys
mount -o remount,ro,bind proc/sys
mount -t sysfs -o ro none sys
mount -t cgroup2 none sys/fs/cgroup
mount -t tmpfs -o mode=755 none dev
mount -t tmpfs -o mode=755 none run
mount -t tmpfs -o mode=1777 none tmp
for node in null zero full random urandom tty; do
    touch dev/$node
    mount --bind /dev/$node dev/$node
done
mkdir -p dev/pts dev/shm
mount -t devpts -o newinstance,ptmxmode=666 none dev/pts
ln -s pts/ptmx dev/ptmx
mount -t tmpfs none dev/shm
touch dev/console
mount --bind /dev/null dev/console
: > etc/fstab
echo 0123456789abcdef0123456789abcdef > etc/machine-id
mkdir -p run/systemd/system
cat > run/systemd/system/inside.target <<UNIT
[Unit]
Wants=inside.service systemd-journald.service
AllowIsolate=yes
UNIT
cat > run/systemd/system/inside.service <<UNIT
[Unit]
DefaultDependencies=no
After=systemd-journald.socket
[Service]
Type=oneshot
TimeoutStartSec=300
ExecStart=/bin/sh -c "/usr/bin/python3 -B /out/inside.py > /out/out.log 2>&1; echo \$? > /out/status"
ExecStopPost=/bin/systemctl --no-block poweroff
UNIT
for unit in systemd-udevd.service systemd-udevd-kernel.socket systemd-udevd-control.socket systemd-udev-trigger.service \
    systemd-sysctl.service systemd-modules-load.service kmod-static-nodes.service systemd-random-seed.service \
    systemd-remount-fs.service systemd-binfmt.service systemd-update-utmp.service systemd-journal-flush.service \
    sys-kernel-debug.mount sys-kernel-tracing.mount sys-kernel-config.mount sys-fs-fuse-connections.mount \
    dev-hugepages.mount dev-mqueue.mount proc-sys-fs-binfmt_misc.automount getty.target swap.target local-fs.target; do
    ln -sf /dev/null run/systemd/system/$unit
done
mkdir -p mnt/old
pivot_root . mnt/old
umount -l /mnt/old
exec env -i container=touchd-test PATH=/usr/sbin:/usr/bin:/sbin:/bin /lib/systemd/systemd --system \
    --unit=inside.target --log-target=journal --show-status=0 < /dev/null > /out/systemd.log 2>&1
'
(
    echo "$BASHPID" > "$group/cgroup.procs"
    exec unshare --fork --pid --mount --uts --ipc --net --cgroup --kill-child --propagation private \
        bash -c "$in_namespaces"
) &
# Killed by its own reboot(2), which powers the namespaces off. In the background, so that a signal is heard.
wait $! || true
