#!/bin/bash
# Build the wheel, install it in an empty environment, and use it from an empty directory.
set -euo pipefail
cd "$(dirname "$0")/.."
python=${PYTHON:-python3}
folder=$(mktemp -d)
server=
trap 'if [ -n "$server" ]; then kill "$server"; fi; rm -rf "$folder"' EXIT
"$python" -m pip wheel --quiet --disable-pip-version-check --no-deps --wheel-dir "$folder" .
"$python" -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check "$folder"/tipforce-*.whl
mkdir "$folder/empty"
cd "$folder/empty"
PATH="$folder/venv/bin:$PATH"
tipforce demo | tail -n 1
tipforce run grasp -q | tail -n 1
tipforce run grasp --explain | tail -n 1
tipforce run static -q -o static.log >/dev/null
tipforce decode static.log --dbc tipforce --signals P -q | tail -n 1
tipforce view grasp --port 0 -q >url &
server=$!
until [ -s url ]; do kill -0 "$server" && sleep 0.2; done
python - "$(cat url)" <<'END'
import sys
from urllib.parse import urlsplit

from websockets.sync.client import connect

place = urlsplit(sys.argv[1]).netloc
with connect(f"ws://{place}/live", origin=f"http://{place}") as page:
    page.send('{"do": "setup"}')
    print("view:", page.recv()[:60])
END
echo "the wheel works"
