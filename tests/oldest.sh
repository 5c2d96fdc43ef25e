#!/bin/sh
# The tests that use canopen, with an installed tipforce and the oldest canopen that pyproject.toml allows.
# Usage: tests/oldest.sh [VERSION]    (another version of canopen: the newest, say)
set -eu
cd "$(dirname "$0")/.."
version=${1:-$(sed -n 's/^ *"canopen>=\([0-9.]*\),.*/\1/p' pyproject.toml)}
venv=$(mktemp -d)
trap 'rm -rf "$venv"' EXIT
python3 -m venv "$venv"
"$venv/bin/pip" install --quiet . "canopen==$version" pytest==9.2.0 pytest-xdist==3.8.0 hypothesis==6.170.15
"$venv/bin/pip" list 2>/dev/null | grep -E '^(canopen|python-can|numpy|cantools) '
# "pythonpath" of pyproject.toml names the tests' own folders only: tipforce itself is the installed one.
"$venv/bin/python" -m pytest -q -n auto tests/host/network tests/host/configuration tests/device/test_canopen_client.py
