#!/usr/bin/env bash
# Set up everything the project needs, and nothing twice.
#
#   tools/setup.sh EXTRAS...      e.g. tools/setup.sh all,test      tools/setup.sh docs
#
# 1. find a Python >= 3.11 (the variable PYTHON overrides the search)
# 2. find the system libraries Qt, OpenGL and Xvfb need; install what is missing with apt when root,
#    otherwise print the one command that does it and stop
# 3. make .venv and install the project into it with the extras asked for
#
# Step 3 leaves a stamp in .venv for each set of extras; it runs again only when pyproject.toml, this
# script or the place of the checkout changes. Steps 1 and 2 ask apt nothing unless something is missing.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
export PATH="$PATH:/usr/sbin:/sbin" # ldconfig is not on the PATH of a normal Debian user

readonly OLDEST_MINOR=11 NEWEST_MINOR=14
readonly VENV="$PWD/.venv"

say() { printf 'setup: %s\n' "$*"; }
die() {
  printf 'setup: error: %s\n' "$*" >&2
  exit 1
}

# ---- 1. Python -------------------------------------------------------------------------------------

recent_enough() { "$1" -c "import sys; sys.exit(sys.version_info < (3, $OLDEST_MINOR))" 2>/dev/null; }

# Prints the interpreter to use: $PYTHON, else python3, else the newest python3.N.
find_python() {
  local candidate minor
  if [[ -n "${PYTHON:-}" ]]; then
    recent_enough "$PYTHON" || die "PYTHON=$PYTHON is not a working Python >= 3.$OLDEST_MINOR; name another or unset PYTHON"
    echo "$PYTHON"
    return
  fi
  local candidates=(python3)
  for ((minor = NEWEST_MINOR; minor >= OLDEST_MINOR; minor--)); do candidates+=("python3.$minor"); done
  for candidate in "${candidates[@]}"; do
    if recent_enough "$candidate"; then
      echo "$candidate"
      return
    fi
  done
  die "Python >= 3.$OLDEST_MINOR is needed, found $(python3 --version 2>/dev/null || echo none); install one, then: make PYTHON=/path/to/python3.$OLDEST_MINOR"
}

# ---- 2. system packages ----------------------------------------------------------------------------

# What must be there, and the Debian packages that bring it (newest name first, where Debian renamed one).
# Looking for the library rather than the package works whatever the package is called.
readonly REQUIREMENTS='
libEGL.so.1                libegl1
libGL.so.1                 libgl1
libdbus-1.so.3             libdbus-1-3
libfontconfig.so.1         libfontconfig1
libgthread-2.0.so.0        libglib2.0-0t64 libglib2.0-0
libxkbcommon.so.0          libxkbcommon0
libxkbcommon-x11.so.0      libxkbcommon-x11-0
libX11-xcb.so.1            libx11-xcb1
libxcb-cursor.so.0         libxcb-cursor0
libxcb-icccm.so.4          libxcb-icccm4
libxcb-image.so.0          libxcb-image0
libxcb-keysyms.so.1        libxcb-keysyms1
libxcb-randr.so.0          libxcb-randr0
libxcb-render-util.so.0    libxcb-render-util0
libxcb-shape.so.0          libxcb-shape0
libxcb-xfixes.so.0         libxcb-xfixes0
libxcb-xkb.so.1            libxcb-xkb1
dri/swrast_dri.so          libgl1-mesa-dri
bin/Xvfb                   xvfb
bin/xauth                  xauth
'

is_there() { # is_there REQUIREMENT LIBRARIES
  case "$1" in
    bin/*) command -v "${1#bin/}" >/dev/null ;;
    dri/*) compgen -G "/usr/lib*/$1" >/dev/null || compgen -G "/usr/lib/*/$1" >/dev/null ;;
    *) grep -qF "$1 " <<<"$2" ;;
  esac
}

# Prints one line per missing requirement: the names its Debian package may have.
missing_packages() {
  local libraries requirement names
  libraries="$(ldconfig -p)"
  while read -r requirement names; do
    [[ -z "$requirement" ]] || is_there "$requirement" "$libraries" || echo "$names"
  done <<<"$REQUIREMENTS"
  # Debian splits venv and its bundled pip off from Python.
  "$1" -c 'import ensurepip, venv' 2>/dev/null ||
    "$1" -c 'import sys; print("python3.%d-venv python3-venv" % sys.version_info[1])'
}

# Reads lines of alternative names, prints for each the first that apt can install (else the last).
known_names() {
  local names name last
  while read -r names; do
    for name in $names; do
      last="$name"
      if [[ "$(LC_ALL=C apt-cache policy "$name" 2>/dev/null)" =~ Candidate:\ [^\(] ]]; then break; fi
    done
    echo "$last"
  done
}

ensure_system_packages() { # ensure_system_packages PYTHON
  [[ "$(uname -s)" == Linux ]] || return 0
  local missing
  missing="$(missing_packages "$1")"
  [[ -n "$missing" ]] || return 0

  local install=(apt-get install -y --no-install-recommends)
  command -v apt-get >/dev/null ||
    die "this is no Debian; install what these Debian packages bring, then try again: $(awk '{print $NF}' <<<"$missing" | xargs)"
  if [[ "$(id -u)" != 0 ]]; then
    die "system packages are missing and only root can install them. Run this, then try again:

    sudo apt-get update && sudo ${install[*]} $(known_names <<<"$missing" | xargs)
"
  fi
  say "installing missing system packages"
  apt-get update
  mapfile -t names < <(known_names <<<"$missing")
  DEBIAN_FRONTEND=noninteractive "${install[@]}" -o DPkg::Lock::Timeout=120 "${names[@]}" </dev/null
  missing="$(missing_packages "$1")"
  [[ -z "$missing" ]] || die "still missing after apt: $(xargs <<<"$missing")"
}

# ---- 3. the virtual environment --------------------------------------------------------------------

# A usable .venv runs, is recent enough, has pip, and was made for this very folder (scripts hold its path).
venv_usable() {
  recent_enough "$VENV/bin/python" && [[ -x "$VENV/bin/pip" ]] && grep -qF "$VENV" "$VENV/bin/activate"
}

main() {
  [[ $# -gt 0 ]] || die "say which extras to install, e.g. tools/setup.sh all,test"
  local python extras stamp wanted
  python="$(find_python)"
  ensure_system_packages "$python"

  if ! venv_usable; then
    say "making .venv with $python ($("$python" --version))"
    "$python" -m venv --clear "$VENV"
  fi

  wanted="$(cat pyproject.toml tools/setup.sh | sha256sum)"
  for extras in "$@"; do
    stamp="$VENV/.setup-stamp-$extras"
    [[ "$(cat "$stamp" 2>/dev/null)" == "$wanted" ]] && continue
    say "installing napari-mufasa[$extras] into .venv"
    "$VENV/bin/python" -m pip install --no-input --disable-pip-version-check --prefer-binary -e ".[$extras]"
    echo "$wanted" >"$stamp"
  done
}

# Sourced by its own checks, run by everyone else.
[[ "${BASH_SOURCE[0]}" != "$0" ]] || main "$@"
