#!/bin/sh
# Installs what listen.mjs imports outside the source tree, exactly as package-lock.json says. Quick when it is there.
# Into TOUCHD_NODE_DIR, or else the user's cache. The package brings its binaries along: no script of it is run.
set -eu
examples=$(cd "$(dirname "$0")" && pwd)
target=${TOUCHD_NODE_DIR:-${XDG_CACHE_HOME:-$HOME/.cache}/touchd/node}
if cmp -s "$examples/package-lock.json" "$target/installed.json"; then exit 0; fi
mkdir -p "$target"
cp "$examples/package.json" "$examples/package-lock.json" "$target"
(cd "$target" && npm ci --ignore-scripts --no-audit --no-fund)
cp "$examples/package-lock.json" "$target/installed.json"
