#!/bin/bash
# The first process of the User-mode Linux that `tipforce vcan` boots: creates the buses, runs the command, halts.
# It reads settings, command and environment (NUL-separated) from its own folder, which the caller created for this
# run, and writes there: `started`, then `status` (the command's exit code), or `failed` (a sentence) instead.
# Consoles: tty1 carries the command's stdout (or the whole terminal), tty2 its stderr, tty0 the kernel's messages.
export PATH=/usr/sbin:/usr/bin:/sbin:/bin
folder=${0%/*}
exchange=/run/tipforce-vcan
temporary=/run/tipforce-vcan-tmp
modules=/usr/lib/uml/modules/$(uname -r)/kernel

halt() {
    sync
    echo o >/proc/sysrq-trigger # works without systemd's poweroff, which a small container does not have
    sleep 60                    # process 1 must never end: that is a kernel panic
}

fail() {
    printf '%s\n' "$1" >"$exchange/failed"
    halt
}

load() {
    local file
    for file in "$modules/$1".ko*; do
        # A missing module may be built in: `ip link add` shows whether CAN works.
        [ -e "$file" ] || return 0
        insmod "$file" || fail "the kernel module $file could not be loaded"
    done
}

# By hostfs and not by path: the root may be read-only, and this path may be below /run. Linux 6.12 needs the name of
# the option, and 6.1 takes all of it as the folder. Output of mount goes to the kernel's messages.
mount_exchange() {
    mount -t hostfs -o "hostfs=$folder" exchange "$exchange" || mount -t hostfs -o "$folder" exchange "$exchange"
}

mount_basics() {
    mount -t proc proc /proc
    mount -t sysfs sysfs /sys
    mount -t tmpfs tmpfs /run
    mkdir -p "$exchange"
    mount_exchange || halt
    mkdir -p /dev/pts /dev/shm
    mount -t devpts -o gid=5,mode=620,ptmxmode=666 devpts /dev/pts
    mount -t tmpfs -o mode=1777 tmpfs /dev/shm
    ln -sf /proc/self/fd /dev/fd
    ln -sf /proc/self/fd/0 /dev/stdin
    ln -sf /proc/self/fd/1 /dev/stdout
    ln -sf /proc/self/fd/2 /dev/stderr
}

read_request() {
    local settings
    mapfile -d '' -t settings <"$exchange/settings"
    directory=${settings[0]} access=${settings[1]} console=${settings[2]} size=${settings[3]}
    printf '%s' "${settings[4]}" >/proc/sys/kernel/hostname
    interfaces=("${settings[@]:5}")
    mapfile -d '' -t command <"$exchange/command"
    mapfile -d '' -t environment <"$exchange/environment"
    rm "$exchange/environment" # it may hold secrets, and a killed caller cannot clean up
}

make_buses() {
    local name
    load net/can/can
    load net/can/can-raw
    load net/can/can-bcm
    load net/can/can-gw
    load drivers/net/can/dev/can-dev
    load drivers/net/can/vcan
    load drivers/net/can/vxcan
    ip link set lo up
    for name in "${interfaces[@]}"; do
        ip link add dev "$name" type vcan && ip link set up "$name" || fail "the interface $name could not be made"
    done
}

# Files that the command writes go to memory, over the caller's files; with access=write, to the caller's files.
# pivot_root, not chroot: the kernel refuses user namespaces to a process in a chroot.
make_root() {
    local root=/run/root shared
    [ "$access" = write ] && return
    load fs/overlayfs/overlay
    mkdir /run/upper /run/scratch "$root"
    mount -t overlay -o lowerdir=/,upperdir=/run/upper,workdir=/run/scratch overlay "$root" ||
        fail "the writable layer over the read-only root could not be mounted"
    mkdir -p "$root$exchange"
    for shared in /proc /sys /dev "$exchange"; do
        mount --rbind "$shared" "$root$shared"
    done
    cd "$root" && pivot_root . . && umount -l . && cd / || fail "the writable layer could not become the root"
}

# The caller's temporary folder may hold files that programs accept only from the caller's user, but every process
# inside is root. Created after the root: it is in memory, whoever owns the caller's files.
make_temporary_folder() {
    mkdir -p "$temporary" && chmod 1777 "$temporary" || fail "the temporary folder $temporary could not be made"
}

# Called in a subshell, so that bash's message about a killed command goes to the log, not to the command's stderr.
# `setsid` precedes the command so that a name that contains "=" is not taken for a variable.
run_command() {
    exec env -i -C "$directory" "${environment[@]}" TMPDIR="$temporary" /usr/bin/setsid "$@" "${command[@]}"
}

# `tipforce vcan --attach` leaves a folder with a command, its environment, its directory, and the number of the console
# that is its terminal. Other output is on the caller's disk at once by dsync: hostfs writes a file back when it closes.
serve_attached() {
    local ready
    while sleep 0.2; do
        for ready in "$exchange"/attach-*/ready; do
            [ -e "$ready" ] && rm "$ready" && run_attached "${ready%/ready}" &
        done
    done
}

run_attached() {
    local settings pipes=/run/${1##*/}
    mapfile -d '' -t settings <"$1/settings"
    mapfile -d '' -t command <"$1/command"
    mapfile -d '' -t environment <"$1/environment"
    rm "$1/environment"
    directory=${settings[0]} size=${settings[1]}
    if [ -n "${settings[2]}" ]; then
        use_terminal "/dev/tty${settings[2]}"
        echo $? >"$1/status"
        return
    fi
    mkdir "$pipes" && mkfifo "$pipes/stdout" "$pipes/stderr"
    dd if="$pipes/stdout" of="$1/stdout" bs=65536 oflag=dsync status=none &
    dd if="$pipes/stderr" of="$1/stderr" bs=65536 oflag=dsync status=none &
    (run_command) </dev/null >"$pipes/stdout" 2>"$pipes/stderr"
    set -- "$1" $?
    wait
    echo "$2" >"$1/status"
}

use_terminal() {
    (
        stty sane
        [ -n "$size" ] && stty rows "${size% *}" cols "${size#* }"
        run_command --ctty
    ) <>"$1" >&0 2>&0
}

run_on_terminal() {
    : >"$exchange/started"
    serve_attached &
    use_terminal /dev/tty1
    echo $? >"$exchange/status"
}

# Through pipes, so that the command does not see a terminal; raw, so that \n stays \n.
run_on_pipes() {
    local copiers process pipes=/run/tipforce-vcan-pipes
    exec 5<>/dev/tty1 6<>/dev/tty2
    stty -F /dev/tty1 raw -echo
    stty -F /dev/tty2 raw -echo
    mkdir "$pipes"
    mkfifo "$pipes/stdout" "$pipes/stderr"
    cat "$pipes/stdout" >&5 &
    copiers=$!
    cat "$pipes/stderr" >&6 &
    copiers="$copiers $!"
    : >"$exchange/started"
    serve_attached >/dev/null 2>&1 5>&- 6>&- &
    (run_command) </dev/null >"$pipes/stdout" 2>"$pipes/stderr" 5>&- 6>&-
    echo $? >"$exchange/status"
    # Processes left by the command would keep the pipes open; this machine ends with the command.
    for process in /proc/[0-9]*; do
        case " 1 $copiers " in
        *" ${process#/proc/} "*) ;;
        *) kill -KILL "${process#/proc/}" 2>/dev/null ;;
        esac
    done
    wait $copiers
    # stty waits until the console has transmitted all output.
    stty -F /dev/tty1 raw -echo
    stty -F /dev/tty2 raw -echo
}

mount_basics
read_request
make_buses
make_root
make_temporary_folder
"run_on_$console"
halt
