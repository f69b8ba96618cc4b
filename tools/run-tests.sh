#!/usr/bin/env bash
# Run pytest as a machine without a screen, without a user and without settings would:
#
#   tools/run-tests.sh [pytest arguments]
#
# pytest-xvfb gives every test process an X server of its own; napari, matplotlib and Qt find empty
# folders instead of the user's settings and caches.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

home="$(mktemp -d)"
trap 'rm -rf "$home"' EXIT
mkdir -m 700 "$home/config" "$home/cache" "$home/data" "$home/runtime"
export XDG_CONFIG_HOME="$home/config" XDG_CACHE_HOME="$home/cache" XDG_DATA_HOME="$home/data" XDG_RUNTIME_DIR="$home/runtime"

# The offscreen platform has no OpenGL, so layers could not be drawn; a Wayland session would bypass Xvfb.
unset QT_QPA_PLATFORM WAYLAND_DISPLAY
# The test processes already use the cores.
export OMP_NUM_THREADS="${OMP_NUM_THREADS:-1}"

.venv/bin/python -m pytest "$@" </dev/null
