"""One way to decode a log, in a process of its own: `python -m bench.decode_methods METHOD LOG` prints a JSON line.

The time is the processor's, of the work alone: without start-up and imports. ``sum`` adds the first value of each
PDO that is not unknown, where a method gets that far: the same for all of them."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from tipforce.host.frames.frame_array import FrameArray

DBC = Path(__file__).parents[1] / "dbc" / "tipforce.dbc"
Result = dict[str, float]
_UNKNOWN = -32768
_BUS_EVENT_FLAGS = 0x06  # ASAM MDF 4.1, channel group: bus event, plain bus event
_FIRST = {"Gauges": "SG1", "Contact": "P"}


def memory(log: Path) -> Result:
    """Text to columns, block by block."""
    from tipforce.host.decoding.decoder import Decoder
    from tipforce.host.logs.reader import open_log

    decoder, frames, decoded = Decoder(), 0, 0
    with open_log(log, strict=True) as blocks:
        for block in blocks:
            frames += len(block)
            decoded += sum(len(samples.row) for samples in decoder.decode(block).values())
    return {"frames": frames, "decoded": decoded}


def memory_sum(log: Path) -> float:
    """What ``memory`` would have found: not timed, for the C program does it on the way and numpy in a further pass."""
    import numpy as np

    from tipforce.host.decoding.decoder import Decoder
    from tipforce.host.logs.reader import open_log

    decoder, total = Decoder(), 0.0
    for block in open_log(log, strict=True):
        for (_, name), samples in decoder.decode(block).items():
            total += float(np.nansum(samples.columns[_FIRST[name]]))
    return total


def cantools_loop(log: Path) -> Result:
    """A loop over the lines, and cantools for each."""
    import cantools

    database: Any = cantools.database.load_file(DBC)
    messages = {message.frame_id: message for message in database.messages if message.length == 8}
    frames, decoded, total = 0, 0, 0.0
    with log.open() as lines:
        for line in lines:
            can_id, data = line.split()[2].split("#")
            frames += 1
            message = messages.get(int(can_id, 16))
            if message is not None:
                first = next(iter(message.decode(bytes.fromhex(data)).values()))
                decoded += 1
                total += first if isinstance(first, float) else 0.0
    return {"frames": frames, "decoded": decoded, "sum": total}


def log_reader(log: Path) -> Result:
    """python-can's reader alone: it does not decode."""
    import can

    return {"frames": sum(1 for _ in can.LogReader(log))}


def asammdf(log: Path) -> Result:
    """asammdf: the frames of an MF4 (made before, not counted) decoded with the DBC."""
    from asammdf import MDF

    decoded, total = 0, 0.0
    with MDF(log) as recording:
        extracted = recording.extract_bus_logging({"CAN": [(str(DBC), 0)]})
        for index, group in enumerate(extracted.groups):
            names = {channel.name for channel in group.channels}
            for first, per_unit in (("SG1", 10), ("P", 1000)):
                if first in names:
                    raw = extracted.get(first, group=index, raw=True).samples
                    decoded += len(raw)
                    total += float(raw[raw != _UNKNOWN].sum(dtype=float)) / per_unit
    return {"frames": decoded, "decoded": decoded, "sum": total}


def write_mf4(path: Path, frames: FrameArray) -> None:
    """The frames as bus logging in MF4, as asammdf reads it (python-can's writer takes half a millisecond a frame)."""
    import numpy as np
    from asammdf import MDF, Signal, Source

    kind = [
        (f"CAN_DataFrame.{name}", "u1")
        for name in ("BusChannel", "IDE", "DLC", "DataLength", "Dir", "EDL", "BRS", "ESI")
    ]
    kind += [("CAN_DataFrame.ID", "<u4"), ("CAN_DataFrame.DataBytes", "u1", (8,))]  # type: ignore[list-item]
    samples = np.zeros(len(frames), dtype=kind)
    samples["CAN_DataFrame.BusChannel"] = 1
    samples["CAN_DataFrame.ID"] = frames["can_id"]
    samples["CAN_DataFrame.DLC"] = samples["CAN_DataFrame.DataLength"] = frames["length"]
    samples["CAN_DataFrame.DataBytes"] = frames["data"]
    source = Source(source_type=Source.SOURCE_BUS, bus_type=Source.BUS_TYPE_CAN, name="CAN", path="CAN", comment="")
    seconds = (frames["t_ns"] - frames["t_ns"][0]) / 1e9
    with MDF(version="4.10") as recording:
        signal = Signal(samples, seconds, name="CAN_DataFrame", source=source)
        recording.append(signal, acq_name="CAN", acq_source=source)
        recording.groups[-1].channel_group.flags = _BUS_EVENT_FLAGS
        recording.save(path, overwrite=True)


METHODS: dict[str, Callable[[Path], Result]] = {
    "memory": memory, "LogReader": log_reader, "cantools loop": cantools_loop, "asammdf": asammdf,
}  # fmt: skip


def main() -> None:
    """Run one method on one log, after a small log has brought in what it imports; `mf4 ARRAY FILE` makes an MF4."""
    if sys.argv[1] == "mf4":
        import numpy as np

        write_mf4(Path(sys.argv[3]), np.load(sys.argv[2]))
        return
    method, log, warm_up = METHODS[sys.argv[1]], Path(sys.argv[2]), Path(sys.argv[3])
    method(warm_up)
    started_s = time.process_time()
    result = method(log)
    result["cpu_s"] = time.process_time() - started_s
    if method is memory:
        result["sum"] = memory_sum(log)
    print(json.dumps(result))


if __name__ == "__main__":
    main()
