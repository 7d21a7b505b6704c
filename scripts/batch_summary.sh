#!/usr/bin/env bash
# batch_summary.sh TABLES: measured rows of TABLES/<variant>-<seed>/table.md below each other, as Markdown on standard output.
set -euo pipefail
previous=
for table in "$1"/*/table.md; do
  name=$(basename "$(dirname "$table")")
  header=$(head -1 "$table")
  if [ "$header" != "$previous" ]; then
    [ -z "$previous" ] || echo
    printf '%s\n' "$header"
    sed -n 2p "$table"
    previous=$header
  fi
  sed -n "s/^| \*\*\([^*]*\)\*\* |/| $name: \1 |/p" "$table"
done
