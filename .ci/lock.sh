#!/usr/bin/env bash
# usage: lock.sh VENV > requirements.lock    resolves setup.py for Python 3.11 and 3.12 on x86-64 Linux at once
# Each version comes with the hashes of its files, which pip checks in the set-up.
set -euo pipefail
uv=$(mktemp -d)
trap 'rm -rf "$uv"' EXIT
"$1/bin/python" -m venv "$uv" >&2
"$uv/bin/pip" install -q uv >&2
echo '# Exact versions of everything in .venv, for Python 3.11 and 3.12 on x86-64 Linux; remade by `make lock`.'
"$uv/bin/uv" pip compile -q --universal --python-version 3.11 --no-annotate --no-header --generate-hashes \
  --extra ros --extra test --extra dev setup.py |
  sed -E -e ':joined' -e '/\\$/N; s/ *\\\n +/ /; t joined' |
  sed -E "/== 'win32'/d; /os_name == 'nt'/d; /machine != 'x86_64'/d; s/ ; (sys_platform|platform_machine)([^-]|-[^-])*( --hash|$)/\3/" |
  sed -E "s/ ; python_full_version < '3\.1[3-9]'//; s/python_full_version/python_version/; s/ --hash/ \\\\\n    --hash/g"
