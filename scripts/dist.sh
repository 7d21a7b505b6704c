#!/bin/bash
# dist.sh: a tarball of the programs with manual pages, completions, licences and the pipelines: out/dist/cags-VERSION-TARGET.tar.gz.
# The programs choose their instructions when they run, so that one build serves every x86-64 (or Arm) machine; they need a
# glibc at least as new as the one they were built on.
set -euo pipefail
cd "$(dirname "$0")/.."
version=$(sed -nE '/^\[workspace.package\]/,/^\[/s/^version = "(.*)"/\1/p' Cargo.toml)
target=$(rustc -vV | sed -n 's/^host: //p')
name=cags-$version-$target
out=out/dist
rm -rf "$out/$name"
mkdir -p "$out/$name"/{bin,man,completions}
# A build that goes on would have the revision of the last change to crates/lib/stage (its build.rs); what is handed out names its own.
CAGS_REVISION=${CAGS_REVISION:-$(git rev-parse --short=12 HEAD)}
export CAGS_REVISION
cargo build --profile dist --locked --workspace --bins
scripts/licences.py --check
for program in cags gs-geom graph-precompute feat-train cluster-match eval explore export mask-embed synth-scene bench; do
  cp "target/dist/$program" "$out/$name/bin/"
  "target/dist/$program" --generate man "$out/$name/man"
  for shell in bash zsh fish; do "target/dist/$program" --generate $shell "$out/$name/completions"; done
done
cp -r README.md CHANGELOG.md CITATION.cff LICENSE-MIT LICENSE-APACHE THIRD-PARTY.md docs pipelines "$out/$name/"
# The same tree gives the same bytes.
tar --sort=name --mtime="@$(git log -1 --format=%ct)" --owner=0 --group=0 --numeric-owner -C "$out" -czf "$out/$name.tar.gz" "$name"
ls -l "$out/$name.tar.gz"
