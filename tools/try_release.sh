#!/usr/bin/env bash
# Build the sdist, and of it the wheel; install the wheel into a fresh environment and run it far from the clone.
#   tools/try_release.sh [PYTHON...]        each of these interpreters; python3 if none is named
#   LOWEST=1 tools/try_release.sh PYTHON    with the lowest versions that pyproject.toml allows (needs uv)
# The wheel and the sdist stay in dist/.
set -euo pipefail
clone=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)

for python in "${@:-python3}"; do
  work=$(mktemp -d)
  trap 'rm -rf "$work"' EXIT
  "$python" -m venv "$work/venv"
  bin=$work/venv/bin
  "$bin/python" -m pip install --quiet build
  "$bin/python" -m build --outdir "$clone/dist" "$clone" >"$work/build.txt" || { cat "$work/build.txt" >&2; exit 1; }
  version=$("$bin/python" -c "import sys; sys.path.insert(0, '$clone'); from slam.version import __version__; print(__version__)")
  bounds=()
  if [[ -n ${LOWEST:-} ]]; then
    uv pip compile --quiet --resolution lowest-direct --python "$bin/python" "$clone/pyproject.toml" >"$work/lowest.txt"
    bounds=(--constraint "$work/lowest.txt")
  fi
  "$bin/python" -m pip install --quiet "${bounds[@]}" "$clone/dist/scanweave-$version-py3-none-any.whl"
  (
    cd "$work"
    "$bin/python" --version
    "$bin/scanweave" --version
    "$bin/scanweave" demo
    "$bin/scanweave" simulate --home 2 --duration 20 -o home
    "$bin/scanweave" map home -o map
    "$bin/python" -c "import slam, fusion; print(slam.__file__); print(slam.load_map('map'))"
    "$bin/python" -m pip check
  )
  rm -rf "$work"
done
