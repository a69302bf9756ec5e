#!/bin/sh
# Installs what listen.mjs imports outside the source tree, exactly as package-lock.json says. Quick when it is there.
# Into TOUCHD_NODE_DIR, or else the user's cache. The package brings its binaries along: no script of it is run.
#
# usage: install-node-zeromq.sh [FOLDER]    of another package-lock.json, beside the first: -NAME of the folder
set -eu
lock=$(cd "${1:-$(dirname "$0")}" && pwd)
target=${TOUCHD_NODE_DIR:-${XDG_CACHE_HOME:-$HOME/.cache}/touchd/node}
[ $# -eq 0 ] || target=$target-$(basename "$lock")
if cmp -s "$lock/package-lock.json" "$target/installed.json"; then exit 0; fi
mkdir -p "$target"
cp "$lock/package.json" "$lock/package-lock.json" "$target"
(cd "$target" && npm ci --ignore-scripts --no-audit --no-fund)
cp "$lock/package-lock.json" "$target/installed.json"
