#!/bin/bash
# Build the Debian package into dist/, and print its name: touchd with all Python packages that it needs, in the
# versions of requirements.lock, under /usr/lib/touchd.
#
# usage: deploy/build-deb.sh [PYTHON]    a Python with the packages of requirements.lock
# DEBIAN, 12 or 13, and ARCH, amd64 or arm64, say for which system: by default Debian 12, and this computer's. Only the
# default is tried: `make vm-test`.
set -euo pipefail
cd "$(dirname "$0")/.."

python=${1:-.venv/bin/python}
umask 022
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
stage=$work/touchd
export SOURCE_DATE_EPOCH
SOURCE_DATE_EPOCH=$(git log -1 --format=%ct 2>/dev/null || stat -c %Y pyproject.toml)

debian=${DEBIAN:-12}
architecture=${ARCH:-$(dpkg --print-architecture)}
case $debian in
12) minor=11 ;;
13) minor=13 ;;
*) echo "build-deb.sh: DEBIAN is 12 or 13" >&2; exit 2 ;;
esac
case $architecture in
amd64) machine=x86_64 ;;
arm64) machine=aarch64 ;;
*) echo "build-deb.sh: ARCH is amd64 or arm64" >&2; exit 2 ;;
esac
# glibc up to the one that control.in asks for.
platforms=(--platform "manylinux2014_$machine")
for glibc in $(seq 17 28); do platforms+=(--platform "manylinux_2_${glibc}_$machine"); done

# --- the program
pip() { "$python" -m pip --quiet --disable-pip-version-check --no-input "$@"; }
pip wheel --no-deps --no-build-isolation --wheel-dir "$work" .
wheel=("$work"/touchd-*.whl)
extras=calibrate,web
# pyalsaaudio has no wheel: it is compiled here, for this Python on this computer alone.
if [ "$("$python" -c 'import platform, sys; print(sys.version_info.minor, platform.machine())')" = "$minor $machine" ]; then
    # As this Python links, but with no path to its own libraries, such as pyenv's; a cached wheel may have one.
    ldshared=$("$python" -c 'import sysconfig; print(*(flag for flag in sysconfig.get_config_var("LDSHARED").split()
                                                       if "-rpath" not in flag))')
    LDSHARED=$ldshared pip wheel --no-deps --no-cache-dir --constraint requirements.lock --wheel-dir "$work" \
        pyalsaaudio
    platforms+=(--platform "linux_$machine" --find-links "$work")
    extras+=,audio
else
    echo "build-deb.sh: without --audio: pyalsaaudio is compiled for this computer's own Python alone" >&2
fi
pip install --target "$stage/usr/lib/touchd" --no-compile --only-binary :all: \
    --implementation cp --python-version "3.$minor" "${platforms[@]}" \
    --constraint requirements.lock --no-warn-conflicts "${wheel[0]}[$extras]"
# Not needed to run: console scripts, which name this computer's interpreter, tests, and tools to build or convert.
# (numpy.f2py stays: SciPy takes all names of NumPy.)
rm -rf "$stage"/usr/lib/touchd/{bin,share,onnxruntime/{transformers,tools,quantization,datasets},numpy/distutils}
# Of the extra `calibrate`: interpreters of ONNX graphs, and examples.
rm -rf "$stage"/usr/lib/touchd/{onnx/{backend,reference},matplotlib/mpl-data/sample_data}
find "$stage/usr/lib/touchd" -depth -type d \( -name tests -o -name __pycache__ \) -exec rm -rf {} +
find "$stage/usr/lib/touchd" -name direct_url.json -delete
# Only the executables proper shall be executable.
find "$stage/usr/lib/touchd" -type f -exec chmod 644 {} +
install -D -m 755 deploy/debian/launcher "$stage/usr/bin/touchd"

# --- the service
install -d "$stage/lib/systemd/system"
install -m 644 deploy/touchd{,-input,-tuio,-web,-wizard,-mapping}.service deploy/touchd-mapping.path "$stage/lib/systemd/system"
install -D -m 644 deploy/60-touchd.rules "$stage/lib/udev/rules.d/60-touchd.rules"
install -D -m 644 deploy/sysusers.conf "$stage/usr/lib/sysusers.d/touchd.conf"
install -D -m 644 deploy/tmpfiles.conf "$stage/usr/lib/tmpfiles.d/touchd.conf"

# --- documentation
doc=$stage/usr/share/doc/touchd
install -d "$doc/examples" "$stage/usr/share/lintian/overrides"
install -m 644 docs/*.md "$doc"
install -m 644 deploy/realtime.conf deploy/audio.conf deploy/touchd.toml docs/examples/listen.* docs/examples/pipe_daemon.py "$doc/examples"
version=$(sed -n 's/^__version__ = "\(.*\)"/\1/p' touchd/__init__.py)
maintainer=$(sed -n 's/^Maintainer: //p' deploy/debian/control.in)
gzip -9n > "$doc/changelog.gz" <<CHANGES
touchd ($version) unstable; urgency=medium

  * See CHANGELOG.md beside this file.

 -- $maintainer  $(LC_ALL=C date -u -R -d "@$SOURCE_DATE_EPOCH")
CHANGES
install -m 644 CHANGELOG.md "$doc"
printf 'Upstream-Name: touchd\nLicense: MIT\n\n' | cat - LICENSE > "$doc/copyright"
PYTHONPATH=. PYTHONDONTWRITEBYTECODE=1 "$python" deploy/manual.py "$stage" "$version"
gzip -9n "$stage/usr/share/man/man1/touchd.1"
install -m 644 deploy/debian/lintian-overrides "$stage/usr/share/lintian/overrides/touchd"

# --- the package
install -d "$stage/DEBIAN"
install -m 755 deploy/debian/postinst deploy/debian/prerm deploy/debian/postrm "$stage/DEBIAN"
[ "$debian" = 12 ] || version=$version+deb$debian
sed -e "s/@VERSION@/$version/; s/@ARCHITECTURE@/$architecture/; s/@PYTHON@/3.$minor/" \
    -e "s/@NEXT_PYTHON@/3.$((minor + 1))/; s/@SIZE@/$(du -sk --exclude=DEBIAN "$stage" | cut -f1)/" \
    deploy/debian/control.in > "$stage/DEBIAN/control"
(cd "$stage" && find . -type f -not -path './DEBIAN/*' -printf '%P\0' | LC_ALL=C sort -z |
    xargs -0 md5sum > DEBIAN/md5sums)
chmod 644 "$stage"/DEBIAN/{control,md5sums}
mkdir -p dist
package=dist/touchd_${version}_$architecture.deb
# Level 1 takes a tenth of the time of the default, for a file that is a tenth larger.
dpkg-deb --root-owner-group -Zxz -z1 --build "$stage" "$package" >&2
echo "$package"
