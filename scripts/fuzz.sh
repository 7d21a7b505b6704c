#!/usr/bin/env bash
# Fuzz every format that the stages read (crates/lab/hostile-files), one after the other, for so many seconds each; further
# arguments are formats, where not all are meant. Needs a nightly toolchain and cargo-fuzz. A finding ends the run: its input
# lies in fuzz/artifacts/<format>/ and, once fixed, in crates/lab/hostile-files/testdata/<format>/.
set -euo pipefail
cd "$(dirname "$0")/.."
seconds=${1:-600}
shift || true
formats=("$@")
[ ${#formats[@]} -gt 0 ] || formats=(ply colmap_bin colmap_txt transforms npy npz artifact labels scannet spz sog dot_splat gltf id_png)
cargo +nightly fuzz --version > /dev/null || { echo "fuzz.sh: cargo install cargo-fuzz, rustup toolchain install nightly" >&2; exit 2; }
cargo run --release -q -p hostile-files --example corpus -- fuzz/corpus
for format in "${formats[@]}"; do
  echo "== $format"
  # No sanitizer: there is no unsafe code behind these readers to sanitize; the harness counts memory itself.
  cargo +nightly fuzz run --sanitizer none "$format" -- -max_total_time="$seconds" -timeout=20 -max_len=65536 -print_final_stats=1
done
