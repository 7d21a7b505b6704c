#!/usr/bin/env bash
# The Python package: its wheel, its tests and the examples in its docstrings, and the tests that scikit-learn and hdbscan have for
# their HDBSCAN. In out/python, made anew where crates/bindings/python/requirements.txt changed. Skipped where there is no Python
# 3.9 or later, or its packages cannot be had.
set -euo pipefail
cd "$(dirname "$0")/.."
package=crates/bindings/python
python=${PYTHON:-python3}
"$python" -c 'import sys, venv; sys.exit(sys.version_info < (3, 9))' 2> /dev/null \
  || { echo "skipped: the Python package: $python is not Python 3.9 or later with venv"; exit 0; }
env=out/python
if ! cmp -s "$package/requirements.txt" "$env/requirements.txt"; then
  rm -rf "$env" && mkdir -p out
  { "$python" -m venv "$env" && "$env/bin/pip" install -q -r "$package/requirements.txt"; } \
    || { echo "skipped: the Python package: pip cannot get what its tests need"; exit 0; }
  cp "$package/requirements.txt" "$env/"
fi
rm -rf "$env/wheel"
"$env/bin/maturin" build --quiet --release --locked -m "$package/Cargo.toml" --target-dir target --out "$env/wheel"
"$env/bin/pip" install -q --no-deps --force-reinstall "$env"/wheel/*.whl
"$env/bin/python" -m pytest -q -p no:cacheprovider -c "$package/pyproject.toml" --doctest-modules --pyargs cags "$package/tests"
"$env/bin/python" "$package/tests/peers/run.py"
echo "ok: the Python package"
