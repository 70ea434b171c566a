#!/usr/bin/env bash
# usage: lock.sh VENV > requirements.lock    resolves setup.py for Python 3.11 and 3.12 on x86-64 Linux at once
set -euo pipefail
uv=$(mktemp -d)
trap 'rm -rf "$uv"' EXIT
"$1/bin/python" -m venv "$uv" >&2
"$uv/bin/pip" install -q uv >&2
echo '# Exact versions of everything in .venv, for Python 3.11 and 3.12 on x86-64 Linux; remade by `make lock`.'
"$uv/bin/uv" pip compile -q --universal --python-version 3.11 --no-annotate --no-header \
  --extra ros --extra test --extra dev setup.py |
  sed -E "/== 'win32'/d; /machine != 'x86_64'/d; s/ ; (sys_platform|platform_machine).*//" |
  sed -E "s/ ; python_full_version < '3\.1[3-9]'//; s/python_full_version/python_version/"
