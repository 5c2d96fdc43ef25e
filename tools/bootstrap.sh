#!/bin/bash
# Install what the targets of the Makefile need, if it is missing.
#   tools/bootstrap.sh demo|report|docs   .venv with tipforce, and with what the report or the site needs
#   tools/bootstrap.sh test               the same with development tools, MicroPython, axe-core, and their system packages
# Messages go to stderr, details to .venv/bootstrap.log. Only root installs system packages; others get the command.
set -euo pipefail
cd "$(dirname "$0")/.."
export PATH="$PATH:/usr/sbin:/sbin" PIP_DISABLE_PIP_VERSION_CHECK=1 PIP_NO_INPUT=1 DEBIAN_FRONTEND=noninteractive
unset PYTHONHOME PYTHONPATH
log=.venv/bootstrap.log
micropython=@micropython/micropython-webassembly-pyscript@1.27.0
axe=axe-core@4.14.1 # checks the web page

say() { printf 'bootstrap: %s\n' "$*" >&2; }

die() {
    say "$*"
    exit 1
}

# logged STEP COMMAND...: print the step; write its output to the log, and show the end of the log on failure. While it
# runs, its seconds: on a terminal in one line, elsewhere a line each 10 s.
logged() {
    local worker last=0
    say "$1"
    mkdir -p .venv
    "${@:2}" </dev/null >"$log" 2>&1 &
    worker=$!
    trap 'kill "$worker" 2>/dev/null; exit 130' INT TERM # the shell gives a background process no Ctrl-C
    SECONDS=0
    while kill -0 "$worker" 2>/dev/null; do
        sleep 0.1
        if [ -t 2 ] && [ "$SECONDS" != "$last" ]; then
            printf '\r%d s ' "$SECONDS" >&2
        elif [ ! -t 2 ] && [ "$SECONDS" -ge $((last + 10)) ]; then
            say "$1: $SECONDS s"
        else
            continue
        fi
        last=$SECONDS
    done
    [ ! -t 2 ] || printf '\r' >&2
    trap - INT TERM
    if ! wait "$worker"; then
        tail -n 40 "$log" >&2
        die "failed: ${*:2} (full output in $log)"
    fi
}

apt_install() {
    command -v apt-get >/dev/null || die "missing: $*. Not Debian or Ubuntu: install the corresponding packages"
    if [ "$(id -u)" != 0 ]; then
        die "missing: $*. Run: sudo apt-get update && sudo apt-get install -y $*"
    fi
    logged "apt-get update" apt-get update
    logged "apt-get install $*" apt-get install -y --no-install-recommends "$@"
}

find_python() {
    local name
    for name in python3 python3.14 python3.13 python3.12 python3.11; do
        if "$name" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; then
            printf '%s\n' "$name"
            return
        fi
    done
    return 1
}

# Try instead of checking packages: a Python from another source needs no python3-venv.
try_venv() { "$1" -m venv --clear .venv </dev/null >/dev/null 2>&1 && .venv/bin/python -m pip --version >/dev/null 2>&1; }

make_venv() {
    local python version
    if ! python=$(find_python); then
        command -v python3 >/dev/null || apt_install python3 python3-venv
        python=$(find_python) || die "tipforce needs Python 3.11 or newer, and python3 is $(python3 -V 2>&1)." \
            "Install one; it is found as python3.11 to python3.14"
    fi
    say "creating a virtual environment in .venv, with $("$python" -V)"
    try_venv "$python" && return
    version=$("$python" -c 'import sys; print("python%d.%d" % sys.version_info[:2])')
    [ "$python" = python3 ] && apt_install python3-venv || apt_install "$version-venv"
    try_venv "$python" || die "$python -m venv .venv does not work: run it to see why"
}

# The stamp holds the folder: scripts in a moved checkout point to the old path.
fresh() { [ -f "$1" ] && [ ! pyproject.toml -nt "$1" ] && [ ! node/tipforce/_core.c -nt "$1" ] && [ "$(<"$1")" = "$PWD" ] && [ -x .venv/bin/python ]; }

install_project() {
    local stamp=.venv/stamp-$1 wanted
    fresh .venv/stamp-test && return
    fresh "$stamp" && return
    case $1 in
    demo) wanted=. ;;
    test) wanted='.[dev]' ;;
    *) wanted=".[$1]" ;;
    esac
    if [ "$(cat .venv/stamp-* 2>/dev/null | head -n 1)" != "$PWD" ] ||
        ! .venv/bin/python -m pip --version >/dev/null 2>&1; then
        make_venv
    fi
    logged "pip install -e $wanted" .venv/bin/python -m pip install -e "$wanted"
    printf '%s\n' "$PWD" >"$stamp"
}

kernel_has_vcan() {
    local as_root=()
    modprobe -q vcan 2>/dev/null || true
    [ "$(id -u)" = 0 ] || as_root=(--map-root-user)
    unshare "${as_root[@]}" --net ip link add dev vcan0 type vcan 2>/dev/null
}

# In .venv, so they are removed and recreated with .venv.
have_npm() { [ "$(cat ".venv/$1/stamp" 2>/dev/null)" = "$2" ]; }

# install_npm FOLDER PACKAGE
install_npm() {
    have_npm "$@" && return
    logged "npm install $2" npm install --prefix ".venv/$1" --no-audit --no-fund --no-update-notifier "$2"
    printf '%s\n' "$2" >".venv/$1/stamp"
}

# Of the Python of .venv, or of that which will make it; one that is no package of the system has them.
has_headers() {
    local python=.venv/bin/python
    [ -x $python ] || python=$(find_python) || return 1
    "$python" -c 'import os.path, sys, sysconfig
sys.exit(not os.path.exists(os.path.join(sysconfig.get_path("include"), "Python.h")))'
}

install_system_packages() {
    local missing=()
    command -v ip >/dev/null || missing+=(iproute2)
    command -v candump >/dev/null || missing+=(can-utils)
    command -v insmod >/dev/null || missing+=(kmod)
    if ! command -v linux.uml >/dev/null && ! kernel_has_vcan; then
        missing+=(user-mode-linux)
    fi
    # They compile the core, and what tipforce export c writes.
    command -v gcc >/dev/null || missing+=(gcc libc6-dev)
    # MicroPython runs under Node.js; npm is needed only to fetch it, and axe-core.
    command -v node >/dev/null || missing+=(nodejs)
    { have_npm micropython "$micropython" && have_npm axe "$axe"; } || command -v npm >/dev/null || missing+=(npm)
    # Only the tests of the web page need it.
    command -v chromium >/dev/null || command -v chromium-browser >/dev/null || command -v google-chrome >/dev/null ||
        missing+=(chromium)
    [ ${#missing[@]} = 0 ] || apt_install "${missing[@]}"
    has_headers || (apt_install python3-dev) || say "without Python's headers the core is not compiled: logs are read slower"
}

case "${1-}" in
demo | report | docs) install_project "$1" ;;
test)
    install_system_packages # a compiler first: the installation builds the compiled core
    install_project test
    install_npm micropython "$micropython"
    install_npm axe "$axe"
    ;;
*) die "usage: tools/bootstrap.sh demo|report|docs|test" ;;
esac
