#!/usr/bin/env bash
# test_poses.sh: poses from photographs and from a video, of a room whose poses are known, and captures that must be refused. Skipped
# where pycolmap cannot be installed.
set -euo pipefail
cd "$(dirname "$0")/.."
if ! make -s out/poses-env/bin/python > /dev/null 2>&1; then
  echo "SKIPPED: poses: pycolmap (pipelines/poses.txt) cannot be installed here: it needs Python 3.10 and PyPI"
  exit 0
fi
exec out/poses-env/bin/python scripts/test_poses.py
