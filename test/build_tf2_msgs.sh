#!/usr/bin/env bash
# usage: build_tf2_msgs.sh VENV
# Builds test/tf2_msgs into VENV, against the ROS 2 wheels there: TF is tested for real, and tf2_msgs has no wheel.
# VENV holds requirements.lock; a C++ compiler and the Python headers are needed besides.
set -euo pipefail
venv=$(cd "$1" && pwd)
here=$(cd "$(dirname "$0")" && pwd)
python=$venv/bin/python

if "$python" -c 'from tf2_msgs.msg import TFMessage; TFMessage()' 2> /dev/null; then
  echo 'tf2_msgs is there already'
  exit 0
fi

# The CMake targets that the wheels export name the Python of the machine they were built on: name this one.
include=$("$python" -c 'import sysconfig; print(sysconfig.get_path("include"))')
numpy=$("$python" -c 'import numpy; print(numpy.get_include())')
built_on='/opt/python/cp3[0-9]+-cp3[0-9]+'
{ grep -rlE "$built_on" "$venv/share" --include='*.cmake' || true; } | while read -r file; do
  sed -i -E -e "s#$built_on/include/python3\.[0-9]+#$include#g" \
    -e "s#$built_on/lib/python3\.[0-9]+/site-packages/numpy/_core/include#$numpy#g" "$file"
done

build=$(mktemp -d)
trap 'rm -rf "$build"' EXIT
run() { "$@" > "$build/log" 2>&1 || { tail -n 30 "$build/log" >&2; exit 1; }; }
export PATH="$venv/bin:$PATH" AMENT_PREFIX_PATH="$venv" CMAKE_PREFIX_PATH="$venv"
run cmake -S "$here/tf2_msgs" -B "$build" -G Ninja -DCMAKE_INSTALL_PREFIX="$venv" -DCMAKE_BUILD_TYPE=Release \
  -DBUILD_TESTING=OFF -DPython3_EXECUTABLE="$python" -DPython3_FIND_VIRTUALENV=ONLY
run cmake --build "$build" -j2
run cmake --install "$build"
"$python" -c 'from tf2_msgs.msg import TFMessage; TFMessage()'
echo 'tf2_msgs built'
