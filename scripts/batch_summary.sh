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

# The paper's table 5 has a column of memory: what the activations of the graph network take, by feat-train's own count.
for table in "$1"/*/table.md; do
  name=$(basename "$(dirname "$table")")
  find -L "$(dirname "$1")" -maxdepth 3 -path "*/$name/features.safetensors.run.json" -exec cat {} + | awk -v name="$name" '
    /"gaussians":/ { gaussians = $2 + 0 }
    /"network_bytes":/ { bytes = $2 + 0; known = 1 }
    known && gaussians > 0 { sum += bytes / gaussians; runs++; known = gaussians = 0 }
    END { if (runs) printf "| %s | %.0f |\n", name, sum / runs }'
done | sed '1i\\n| run | graph network, MB for a million Gaussians |\n| --- | ---: |'
