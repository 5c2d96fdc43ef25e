"""Run by test_store.py as a process of its own: calibrate, store, say so, again and again until it is killed.

Argument: the store file. Each line on stdin is a first serial number, and starts a child that is to be killed. On
stdout: the child's process id, then each serial number whose store was confirmed, then "ended" and the signal."""

import os
import sys

from canopen_device.running.store import FileStore
from fingertip import finger


def record(k: int) -> bytes:
    """Calibration k: every matrix element and offset tells which one it is."""
    C = [[1e4 * (row == column) + k + 0.25 * row + 0.5 * column for column in range(3)] for row in range(3)]
    return finger.record(C=C, offsets=(k * 1e-9, 0.0, -k * 1e-9), serial=k)


def main(path: str, first: int) -> None:
    """Commit and store over SDO frames; ends by SIGKILL, or when nobody reads any more."""
    talk, k = finger.finger(calibrated=False, store=FileStore(path)), first
    while True:
        if refused := talk.stage(record(k)) or talk.commit() or talk.put("I", 0x1010, 4, finger.SAVE):
            sys.exit(f"refused: {refused:08X}")
        print(k, flush=True)
        k += 1


def serve(path: str) -> None:
    """A forked child for each first serial number: as fresh as a process that imports all anew, and 20 times faster."""
    for line in sys.stdin:
        child = os.fork()
        if not child:
            print(os.getpid(), flush=True)
            main(path, int(line))
        _, status = os.waitpid(child, 0)
        print("ended", os.WTERMSIG(status) if os.WIFSIGNALED(status) else "by itself", flush=True)


if __name__ == "__main__":
    serve(sys.argv[1])
