#!/bin/bash
# Boot the image, run FOLDER/run.sh in it, and hand back its output (out.log) and status in FOLDER.
#
# usage: boot.sh IMAGE FOLDER [QEMU OPTION...]    IMAGE as made by image.sh; the machine's disk is thrown away afterwards
set -euo pipefail

image=$1 folder=$2
shift 2
rm -f "$folder"/{status,out.log,console.log}
# Emulated, for the same everywhere: a machine that is virtual itself may offer KVM and fail at the first odd instruction.
# One processor: with two on busy cores, USB/IP fell to a twentieth of its speed. One without AVX: on emulated AVX2,
# NumPy's argsort and Chromium's network service crash. Its clock counts instructions, 2 ns each: a busy host makes the
# machine take longer, and changes nothing that it sees.
exec qemu-system-x86_64 -M q35 -accel tcg -icount shift=1 -cpu Nehalem -smp 1 -m 1536 \
    -no-reboot -nodefaults -no-user-config -display none \
    -kernel "$image/vmlinux" -initrd "$image/initrd.img" \
    -append "console=ttyS0 root=/dev/vda rw mitigations=off nokaslr panic=-1 quiet systemd.show_status=0 systemd.unit=hosttest.target" \
    -drive "file=$image/root.ext4,format=raw,if=virtio,snapshot=on,cache=unsafe" \
    -virtfs "local,path=$folder,mount_tag=host,security_model=none" \
    -serial "file:$folder/console.log" "$@"
