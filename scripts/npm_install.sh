#!/usr/bin/env bash
# npm_install.sh PACKAGE FOLDER: a package of npm, installed into the folder once. Fails where npm is missing or has no network.
set -euo pipefail
[ "$(cat "$2/installed" 2> /dev/null)" != "$1" ] || exit 0
rm -rf "$2"
timeout 300 npm install --silent --no-audit --no-fund --ignore-scripts --fetch-retries 1 --prefix "$2" "$1" > /dev/null 2>&1 ||
  { rm -rf "$2"; exit 1; }
echo "$1" > "$2/installed"
