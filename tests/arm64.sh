#!/usr/bin/env bash
# Try hilctl on ARM64, in a Debian that QEMU emulates: install what is locked, replay the golden
# recordings bit for bit, and complete a short paced run. Not in CI: it takes root and 20 minutes, twice that beside other work.
#   sudo apt-get install debootstrap qemu-user-static binfmt-support
#   sudo tests/arm64.sh [FOLDER]      # FOLDER is to hold the emulated system; without it, a temporary one
set -euo pipefail
cd "$(dirname "$0")/.."

for program in debootstrap qemu-aarch64-static update-binfmts git; do
    command -v "$program" >/dev/null || { echo "needs $program: see the top of this file" >&2; exit 2; }
done
[ "$(id -u)" -eq 0 ] || { echo "needs root, for chroot" >&2; exit 2; }

if [ $# -gt 0 ]; then
    root=$1
    [ ! -e "$root" ] || { echo "exists already: $root" >&2; exit 2; }
    keep=yes
else
    root=$(mktemp --directory)
    keep=
fi
finish() {
    for each in dev/shm dev proc; do
        ! mountpoint --quiet "$root/$each" || umount "$root/$each"
    done
    [ -n "$keep" ] || rm --recursive --force --one-file-system "$root"
}
trap finish EXIT

step() {
    echo "== $((SECONDS / 60)) min $((SECONDS % 60)) s: $*"
}
inside() {
    chroot "$root" /usr/bin/env --unset=PIP_FIND_LINKS HOME=/root PATH=/src/.venv/bin:/usr/sbin:/usr/bin:/sbin:/bin sh -euc "cd /src; $*"
}

mountpoint --quiet /proc/sys/fs/binfmt_misc || mount -t binfmt_misc binfmt_misc /proc/sys/fs/binfmt_misc
[ -e /proc/sys/fs/binfmt_misc/qemu-aarch64 ] || update-binfmts --enable qemu-aarch64

codename=$(. /etc/os-release; echo "$VERSION_CODENAME")
mirror=$(apt-get indextargets --format '$(CODENAME) $(REPO_URI)' 'Created-By: Packages' |
    awk -v suite="$codename" '$1 == suite { print $2; exit }')
step "debootstrap $codename from $mirror"
packages=ca-certificates,gcc,libc6-dev,python3-dev,python3-venv
debootstrap --arch=arm64 --variant=minbase --include="$packages" --foreign "$codename" "$root" "$mirror" >"$root.log" 2>&1 &&
    chroot "$root" /debootstrap/debootstrap --second-stage >>"$root.log" 2>&1 ||
    { tail -n 20 "$root.log" >&2; exit 1; }
rm "$root.log"
mount -t proc proc "$root/proc"
mount --bind /dev "$root/dev"
mount -t tmpfs tmpfs "$root/dev/shm"
cp /etc/resolv.conf "$root/etc/"
cp /etc/ssl/certs/ca-certificates.crt "$root/etc/ssl/certs/"  # with those that this machine adds
mkdir "$root/src"
git ls-files -z | tar --create --null --files-from=- | tar --extract --directory="$root/src"

step "install requirements/core.txt"
inside 'uname --machine
python3 -m venv .venv
pip --disable-pip-version-check install --quiet --require-hashes --requirement requirements/core.txt
pip --disable-pip-version-check install --quiet --no-deps --no-build-isolation --editable .'

step "replay the golden recordings"
inside 'for each in recordings/golden/*.mcap; do hilctl replay "$each"; done'

step "a paced run of two seconds"
# The emulated processor is slow, and its clock is this machine's: late ticks end nothing here.
inside 'hilctl run configs/demo.yaml --output demo.mcap --set waveform.duration_s=2.0 \
    --set timing.max_missed_share=1 --set timing.max_late_s=30.0 --set timing.late_after=1e6
hilctl replay demo.mcap'
step "done"
