#!/usr/bin/env bash
# Wheel and sdist into dist/; their metadata checked; the wheel installed into an empty environment and run there.
#
#   tools/package.sh
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
readonly PY="$PWD/.venv/bin/python" OUT="${OUT:-dist}"

rm -rf "$OUT"
"$PY" -m build --outdir "$OUT" .
"$PY" -m twine check --strict "$OUT"/*

clean="$(mktemp -d)"
trap 'rm -rf "$clean"' EXIT
"$PY" -m venv "$clean/venv"
wheel="$(realpath "$OUT"/*.whl)"
"$clean/venv/bin/python" -m pip install --quiet --disable-pip-version-check "$wheel"
cd "$clean" # not in the checkout, so that nothing is found there
unset PYTHONPATH
venv/bin/napari-mufasa --version
venv/bin/napari-mufasa simulate --preset FF --frames 5 --shape 32 32 --out movie.ome.tif
venv/bin/napari-mufasa presets FF >model.json
venv/bin/napari-mufasa denoise movie.ome.tif --model model.json --out photons.ome.tif
venv/bin/python -c 'import napari_mufasa as nm; assert len(nm.catalogue()) >= 35, nm.catalogue()'
echo "package: $(basename "$wheel") is sound"
