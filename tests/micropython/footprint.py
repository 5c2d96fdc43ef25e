"""How much of MicroPython's heap code and node take."""

from collections.abc import Mapping
from dataclasses import dataclass

from micropython import engine
from micropython.recording import STEPS_PER_CALL, Talk, all_steps
from tipforce.dictionary import table_objects

ROUNDS = 1000


@dataclass
class Heap:
    """Bytes in use, garbage collected before each count."""

    code: int  # all modules imported
    node: int  # one node, n = 3, without its EDS, booted and calibrated; in addition to the code
    peak: int  # code, node and the table while it is walked: more than building needs at any moment
    after_some: int  # code and node after as many rounds of SYNC and SDO ...
    after_many: int  # ... and after twice as many
    garbage_per_sync: int  # what one SYNC with two TPDOs leaves for the collector


def ready_node() -> Talk:
    """A node that is calibrated, operational and in contact: two TPDOs on each SYNC."""
    talk = Talk("ready")
    talk.calibrate()
    talk.start()
    talk.load(1.0, 10.0, 5.0)
    talk.sync(2)
    return talk


def bring_up(talk: Talk) -> list[str]:
    """Calls that leave on MicroPython, as ``replay.device``, the node of ``/ready`` in its final state."""
    return ["replay = on_node.Replay('/ready')", *all_steps(talk.recording)]


def heap(files: Mapping[str, bytes]) -> Heap:
    """Count with ``files`` (sources or compiled) as the library."""
    talk = ready_node()
    # mem_alloc() must be the first thing that a call does: what it makes itself would count.
    count = "print('heap', on_node.heap())"
    now_us = talk.now_us + 1000
    rounds = [
        f"on_node.microseconds(replay.device, (0x80, b''), {STEPS_PER_CALL}, {now_us + 1000 * k})\n"
        "on_node.microseconds(replay.device, (0x605, b'\\x40\\x00\\x10\\x00\\0\\0\\0\\0'), 5, 0)"
        for k in range(0, ROUNDS, STEPS_PER_CALL)
    ]
    # As fingertip.node builds: one object after the other. Garbage is collected between two calls.
    walk = ["row = next(rows, None)", "most = max(most, on_node.heap())"] * len(table_objects.objects(3, True))
    build = [
        "most, rows = 0, table_objects.declared(3, True, table.CONVERTER_16)",
        *walk, "print('heap', most)", "rows = row = None",
    ]  # fmt: skip
    calls = [
        "import gc", "print('heap', gc.mem_alloc())",
        "import on_node", "from tipforce.dictionary import table, table_objects\ntable_objects.objects()", count,
        *bring_up(talk), count,
        *build,
        *rounds, count, *rounds, count,
        "before = on_node.heap()\n"
        f"on_node.microseconds(replay.device, (0x80, b''), 10, {now_us + 10**7})\n"
        "print('heap', (on_node.heap() - before) // 10)",
    ]  # fmt: skip
    told = {**files, **engine.program(), "/ready": talk.recording.text().encode()}
    lines = [line for line in engine.run(told, calls) if line.startswith("heap")]
    empty, code, node, peak, some, many, garbage = [int(line.split()[1]) for line in lines]
    return Heap(code - empty, node - code, peak - empty, some - empty, many - empty, garbage)
