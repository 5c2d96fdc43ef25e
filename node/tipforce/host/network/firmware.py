"""Install a program on a node with two program slots (CiA 302-3), and wait until the node has confirmed it."""

from __future__ import annotations

import io
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from canopen_device.core import codes, program
from tipforce.dictionary import objects as od
from tipforce.errors import InputError, NoResponseError, RefusedError, SdoAbortError
from tipforce.host.network.bus import Bus
from tipforce.host.network.find import command_and_wait
from tipforce.host.network.sdo import SdoChannel
from tipforce_loader import image

_REASONS = {
    image.NOT_AN_IMAGE: "it is not a program image of the format that the node knows",
    image.OTHER_PRODUCT: "the image is for another product",
    image.DAMAGED: "the length or the CRC-32 of the image is wrong; transfer it again",
    image.WRONG_SIGNATURE: "the signature is wrong; sign the image with the key of this node",
    image.FLASH_FAILED: "the flash could not be read or written",
    image.TOO_LARGE: "the image is larger than a slot",
    image.UNHEALTHY: "the new program did not start and communicate; the node has returned to the program before",
}
_BYTES_PER_S = 500  # the slowest transfer that is waited for: 10 kbit/s
_POLL_S = 0.25
TRIAL_S = 90.0  # a node gives up a program after 60 s without a frame


@dataclass(frozen=True, slots=True)
class NodeProgram:
    """The program of a node. ``identification`` is 1F56h:1, the CRC-32 of its image, 0 for the one without an image."""

    version: str
    product: int
    identification: int
    reason: str
    """Why the last update failed; empty if it did not."""


@dataclass(frozen=True, slots=True)
class Firmware:
    """A program image that was read from a file."""

    content: bytes
    header: image.Header

    @classmethod
    def read(cls, path: str | Path) -> Firmware:
        """Read an image. Raises InputError for a file that is none, or that is damaged."""
        try:
            content = Path(path).read_bytes()
            header = image.Header(content)
        except OSError as error:
            raise InputError(f"{path}: {error.strerror}") from error
        except ValueError as error:
            raise InputError(f"{path}: {error}; python -m bench.firmware_image makes one") from None
        if image.check(io.BytesIO(content), b"-")[0] != image.WRONG_SIGNATURE:  # the node alone has the key
            raise InputError(f"{path}: the length or the CRC-32 of the image is wrong: the file is damaged")
        return cls(content, header)


def node_program(sdo: SdoChannel) -> NodeProgram:
    """Read which program a node runs. Raises RefusedError for a node without program slots, NoResponseError."""
    try:
        identification = sdo.read(od.PROGRAM_IDENTIFICATION[1])
        reason = sdo.read(od.PROGRAM_FLASH_STATUS[1]) >> program.REASON_SHIFT
    except SdoAbortError as error:
        if error.code not in (codes.NO_OBJECT, codes.NO_SUB):
            raise
        raise RefusedError(
            f"node {sdo.node_id} (0x{sdo.node_id:02X}) has no program slots (1F56h: abort 0x{error.code:08X}): "
            "update a Linux node on its own machine (pip install --upgrade tipforce), a microcontroller without a key "
            "over its cable"
        ) from None
    text = _REASONS.get(reason, f"reason {reason}") if reason else ""
    return NodeProgram(sdo.read(od.SOFTWARE_VERSION), sdo.read(od.IDENTITY_PRODUCT), identification, text)


def install(
    bus: Bus, node_id: int, firmware: Firmware, *, allow_downgrade: bool = False,
    progress: Callable[[int], None] = lambda _bytes: None,
) -> NodeProgram:  # fmt: skip
    """Install an image and start it; return the program that the node, in PRE-OPERATIONAL, confirmed. ``progress``:
    bytes sent. Raises RefusedError (no slots, product, downgrade, refused, given up), NoResponseError."""
    sdo = bus.sdo(node_id)
    place = f"node {node_id} (0x{node_id:02X})"
    before = node_program(sdo)
    _check(place, before, firmware, allow_downgrade)
    command_and_wait(bus, "preop", [node_id], timeout_s=5.0)
    try:
        entry, deadline_s = od.PROGRAM_DATA[1], 20.0 + len(firmware.content) / _BYTES_PER_S
        sdo.download(entry.index, entry.sub, firmware.content, progress=progress, deadline_s=deadline_s)
        sdo.write(od.PROGRAM_CONTROL[1], program.START)
    except SdoAbortError as error:
        if error.code == codes.DEVICE_STATE:
            raise RefusedError(f"{place} refuses a program now: it is operational, or another is on trial") from None
        reason = node_program(sdo).reason
        raise RefusedError(f"{place} refuses the image: {reason or error}; it keeps {before.version}") from None
    after = _confirmed(sdo, place)
    if after.identification != firmware.header.crc:
        raise RefusedError(f"{place} runs {after.version}: {after.reason or 'the trial was interrupted'}")
    return after


def _check(place: str, before: NodeProgram, firmware: Firmware, allow_downgrade: bool) -> None:
    header = firmware.header
    if not header.fits(before.product):
        raise RefusedError(
            f"{place}: the image is for product 0x{header.product:08X}, the node is 0x{before.product:08X}; "
            "equal upper 16 bits are required"
        )
    try:
        installed = tuple(int(part) for part in before.version.split("."))
    except ValueError:
        return  # a version of another form cannot be compared
    if header.version < installed and not allow_downgrade:
        raise RefusedError(
            f"{place}: {header.version_text()} is older than the installed {before.version}; "
            "add --allow-downgrade to install it"
        )


def _confirmed(sdo: SdoChannel, place: str) -> NodeProgram:
    """Wait until the node neither restarts nor has a program on trial; its requests are the frames of the trial."""
    time.sleep(4 * program.RESTART_DELAY_MS * 1e-3)
    until_s = time.monotonic() + TRIAL_S
    while time.monotonic() < until_s:
        with suppress(NoResponseError):
            if not sdo.read(od.PROGRAM_FLASH_STATUS[1]) & program.IN_PROGRESS:
                return node_program(sdo)
        time.sleep(_POLL_S)
    raise NoResponseError(
        f"{place}: no confirmed program within {TRIAL_S:g} s after the start; check its supply and bus"
    )
