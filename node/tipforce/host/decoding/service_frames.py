"""The frames of services in blocks: those that ``DuplicateNodes`` processes, and its findings among them."""

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from canopen_device.core import codes
from tipforce.host.decoding.duplicates import ANY_LENGTH, BEGINS, GUARDING, KIND_OF, Duplicate, DuplicateNodes
from tipforce.host.frames.frame_array import FIELDS, FrameArray, RawFrame

if TYPE_CHECKING:
    from tipforce.host.decoding.decoder import Samples

_KIND = np.array(KIND_OF, dtype=np.uint8)
_COUNTS = np.ones((5, 256), dtype=np.bool_)
"""By the kind and the first byte."""
for _kind, _commands in BEGINS.items():
    _COUNTS[_kind] = np.isin(np.arange(256), sorted(_commands))


def services(frames: FrameArray) -> FrameArray:
    """Return those of FRAME (n,) that ``DuplicateNodes.frame`` processes."""
    frames = frames.compress(_KIND.take(frames["can_id"] & np.uint32(codes.STANDARD_MASK)) > 0)
    can_id = frames["can_id"]
    kind = _KIND.take(can_id & np.uint32(codes.STANDARD_MASK))
    whole = (can_id <= codes.STANDARD_MASK) & ((kind == ANY_LENGTH) | (frames["length"] == 8))
    guarding = can_id & ~np.uint32(codes.NODE_ID_MASK) == GUARDING
    return frames.compress(guarding | (whole & _COUNTS[kind, frames["data"][:, 0]]))


def raw_frames(frames: FrameArray) -> Iterator[RawFrame]:
    """Yield FRAME (n,) one by one."""
    for t_ns, can_id, length, word in FIELDS.iter_unpack(frames.tobytes()):
        yield t_ns, can_id, word.to_bytes(8, "little")[:length]


def find_duplicates(watch: DuplicateNodes, frames: FrameArray) -> list[Duplicate]:
    """Process frames, FRAME (n,), in the order of reception; return the new findings."""
    new = [watch.frame(can_id, data, t_ns) for t_ns, can_id, data in raw_frames(services(frames))]
    return [duplicate for duplicate in new if duplicate is not None]


def add_samples(watch: DuplicateNodes, samples: "Samples", frames: FrameArray, modulus: int) -> None:
    """Process the samples of one message of a node, decoded from FRAME (n,); ``modulus``: of their counters."""
    counter, stale = samples.columns.get("counter"), samples.columns.get("stale")
    if counter is None or stale is None:
        return
    fresh, data, t_ns = ~np.asarray(stale, np.bool_), frames["data"].tobytes(), frames["t_ns"]
    for row, count in zip(samples.row[fresh].tolist(), counter[fresh].tolist(), strict=True):
        content = data[8 * row : 8 * row + 8]
        watch.sample(samples.node_id, samples.message.name, count, content, modulus, int(t_ns[row]))
