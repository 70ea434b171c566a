#!/usr/bin/env bash
# usage: [PYTHON=interpreter] bootstrap.sh VENV [compiler]
# Makes the virtual environment from requirements.lock and sees to the system packages that it needs; or, with
# `compiler`, to what a test build in that environment needs.
set -euo pipefail
cd "$(dirname "$0")/.."
VENV=$1
LOCK=requirements.lock
LIBRARIES='libgl1 libegl1 libx11-6 libusb-1.0-0 libidn2-0 libudev1 libgomp1'

step() { printf '[%s/4] %s\n' "$1" "$2"; }
die() { printf 'setup: %s\n' "$@" >&2; exit 1; }

# Installs Debian packages as root or by password-less sudo; else says what to install.
system_packages() {
  local sudo=()
  if [ "$(id -u)" != 0 ]; then sudo=(sudo -n); fi
  if command -v apt-get > /dev/null && "${sudo[@]}" true 2> /dev/null; then
    echo "      installing system packages: $*"
    if "${sudo[@]}" apt-get update -qq &&
      "${sudo[@]}" env DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends "$@" > /dev/null
    then return; fi
  fi
  die "these system packages are missing: $*" "install them, then run make again:" "  sudo apt-get install $*"
}

usable() {
  [ "$("$1" -c 'import sys; print(sys.version_info[:2] in ((3, 11), (3, 12)))' 2> /dev/null)" = True ]
}

# Candidates in order of preference: 3.12 is the Python of ROS 2 Jazzy. A name on the PATH may be a shim that fails.
candidates() {
  echo python3.12
  if command -v pyenv > /dev/null; then printf '%s\n' "$(pyenv root)"/versions/3.12.*/bin/python; fi
  printf '%s\n' python3.11 python3
}

find_python() {
  local name
  if [ -n "${PYTHON:-}" ]; then echo "$PYTHON"; return; fi
  while read -r name; do
    if usable "$name"; then echo "$name"; return; fi
  done < <(candidates)
}

make_venv() {
  local python=$1 version
  "$python" -m venv --clear "$VENV" > /dev/null 2>&1 && return
  version=$("$python" -c 'import sys; print("python%d.%d-venv" % sys.version_info[:2])')
  system_packages "$version"
  "$python" -m venv --clear "$VENV"
}

# uv, pinned by the lock like all else, takes a fraction of pip's time; where it does not get through (a mirror that
# only pip was told of), pip does the same. The whole output stays in a log.
install_lock() {
  local log=$VENV/install.log
  if "$VENV/bin/python" -m pip install -q --require-hashes -r <(sed -n '/^uv==/,/[^\\]$/p' "$LOCK") > "$log" 2>&1 &&
    "$VENV/bin/uv" pip install --python "$VENV/bin/python" --require-hashes -r "$LOCK" 2>&1 |
      tee -a "$log" | grep -vE '^ *[+~-] '
  then return; fi
  echo '      uv did not get through; the same by pip, which takes some minutes'
  "$VENV/bin/python" -m pip install --require-hashes -r "$LOCK" >> "$log" 2>&1 ||
    { tail -n 15 "$log" >&2; die "pip failed; is the network there? The whole log: $log"; }
}

# What builds tf2_msgs, which the tests need and the product does not.
compiler() {
  local headers missing=()
  headers=$("$VENV/bin/python" -c 'import sysconfig; print(sysconfig.get_path("include") + "/Python.h")')
  if ! command -v g++ > /dev/null; then missing+=(g++ libc6-dev); fi
  if [ ! -f "$headers" ]; then
    missing+=("$("$VENV/bin/python" -c 'import sys; print("python%d.%d-dev" % sys.version_info[:2])')")
  fi
  if [ ${#missing[@]} -gt 0 ]; then system_packages "${missing[@]}"; fi
}

if [ "${2:-}" = compiler ]; then compiler; exit; fi

[ "$(uname -m)" = x86_64 ] || die "the ROS 2 wheels exist for x86-64 only; on $(uname -m) use a ROS 2 Jazzy install (README)"

if [ -n "${PYTHON:-}" ]; then
  usable "$PYTHON" || die "PYTHON=$PYTHON does not run, or is neither Python 3.11 nor 3.12"
fi

if [ -x "$VENV/bin/python" ] && usable "$VENV/bin/python"; then
  step 1 "Python: $("$VENV/bin/python" --version) of the existing $VENV"
  if [ -n "${PYTHON:-}" ] && [ "$("$PYTHON" --version)" != "$("$VENV/bin/python" --version)" ]; then
    die "$VENV holds $("$VENV/bin/python" --version); run 'make clean' first, or choose another VENV=..."
  fi
else
  python=$(find_python)
  if [ -z "$python" ]; then
    system_packages python3 python3-venv
    python=python3
    usable "$python" || die "neither Python 3.11 nor 3.12 is here; install one and run: make PYTHON=/path/to/python3.12 ..."
  fi
  step 1 "Python: $("$python" --version), new environment in $VENV"
  make_venv "$python"
fi

step 2 "Packages of $LOCK (about 700 MB to fetch the first time)"
install_lock

step 3 'Libraries that Open3D loads'
if ! "$VENV/bin/python" -c 'import open3d' > /dev/null 2>&1; then
  # shellcheck disable=SC2086
  system_packages $LIBRARIES
  "$VENV/bin/python" -c 'import open3d'
fi

step 4 'csgm_ros itself, as it is in this tree; compiling its kernels'
"$VENV/bin/python" -m pip install -q --no-deps --no-build-isolation -e .
"$VENV/bin/csgm" --help > /dev/null
"$VENV/bin/python" -c 'from csgm_ros.registration import warm_up; warm_up()' ||
  echo '      the kernels did not compile; the tests will tell more' >&2
touch "$VENV/.ready"
echo "      ready: $VENV/bin/csgm, $VENV/bin/csgm_node"
