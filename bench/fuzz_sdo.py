"""Let the SDO client talk to servers that lie, and check after each conversation that it ended as it must.

    python -m bench.fuzz_sdo                               20 000 conversations
    python -m bench.fuzz_sdo --conversations 1_000_000     the long run
    python -m bench.fuzz_sdo --seed 1 --only 4711          the requests of conversation 4711 of seed 1

A conversation is one transfer with the device core as the server, in fake time; on its way each response may be
disturbed. It follows from the seed and its number alone."""

import gc
import heapq
import itertools
import re
import struct
import time
import tracemalloc
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from random import Random

from bench.fuzz import BrokenError, require
from bench.measure import arguments

from canopen_device.core.node import Device
from canopen_device.core.object_dictionary import ObjectDictionary
from canopen_device.core.sdo_block import MAX_BLOCK
from canopen_device.core.sdo_client import BlockDownload, BlockUpload, Download, Transfer, Upload

INDEX, SUB = 0x2000, 0
TIMEOUT_US, DEADLINE_US = 500_000, 5_000_000
LIMIT_BYTES = 2048
MOST_STEPS = 200_000
# Peak of a conversation: most of it are frames in flight, up to three blocks with two foreign frames for each segment.
MEMORY_LIMIT_BYTES = 400_000
HELD_LIMIT_BYTES = 30_000  # after its end
MEMORY_CONVERSATIONS = 100  # one of so many runs under tracemalloc, which makes it several times slower
_DAMAGES = ("change", "lose", "repeat", "delay", "replace", "join", "abort", "storm")


@dataclass(slots=True)
class Response:
    """Data after so many microseconds; perhaps repeated ``times``, ``every_us``."""

    delay_us: int
    data: bytes
    times: int = 1
    every_us: int = 100


def play(transfer: Transfer, server: Callable[[int, bytes], Iterable[Response]], latest_us: int) -> list[bytes]:
    """Let a transfer and ``server(now_us, request)`` talk in fake time; return the requests.

    Raises BrokenError unless it ends by ``latest_us``, with at most one abort, its last request."""
    now_us, aborts, order = 0, 0, itertools.count()
    flight: list[tuple[int, int, Response]] = []
    requests: list[bytes] = []
    response: bytes | None = None
    for _ in range(MOST_STEPS):
        sent, due_us = transfer.step(now_us, response)
        for request in sent:
            require(len(request) == 8 and not aborts, f"request {request.hex()} after {aborts} aborts")
            aborts += request[0] == 0x80 and request[1:4] == transfer.place
            for answer in server(now_us, request):
                heapq.heappush(flight, (now_us + answer.delay_us, next(order), answer))
        requests = (requests + sent)[-MAX_BLOCK:]
        if transfer.ended:
            require(now_us <= latest_us, f"ended at {now_us} us, its deadline was {latest_us} us")
            return requests
        require(due_us >= now_us, f"due at {due_us} us, now is {now_us} us")
        if flight and flight[0][0] <= due_us:
            now_us, _, answer = heapq.heappop(flight)
            response = answer.data
            if answer.times > 1:
                answer.times -= 1
                heapq.heappush(flight, (now_us + answer.every_us, next(order), answer))
        else:
            now_us, response = due_us, None
    raise BrokenError(f"no end after {MOST_STEPS} steps")


class Server:
    """The device core, and what happens to its responses."""

    def __init__(self, rng: Random, content: bytes) -> None:
        od = ObjectDictionary(5)
        od.add(0x1000, 0, ("I", "ro", 0, 0, None, None))
        od.add(INDEX, SUB, ("D", "rw", 0, content, None, None))
        self.device = Device(od)
        self.device.step(0)
        self._rng = rng
        self.damages = 0
        self._chance = rng.choice((0.0, 0.05, 0.2, 0.5, 1.0))
        self._kinds = rng.sample(_DAMAGES, rng.randint(1, 3))
        self._delay_us = rng.choice((0, 100, 5000))

    def __call__(self, now_us: int, request: bytes) -> list[Response]:
        sent, _ = self.device.step(now_us, [(0x605, request)])
        return [response for can_id, data in sent if can_id == 0x585 for response in self._on_the_way(data)]

    def _on_the_way(self, data: bytes) -> list[Response]:
        rng, delay_us = self._rng, self._delay_us
        if rng.random() >= self._chance:
            return [Response(delay_us, data)]
        self.damages += 1
        kind = rng.choice(self._kinds)
        if kind == "change":
            changed = bytearray(data)
            changed[rng.randrange(8) if rng.random() < 0.5 else 0] ^= 1 << rng.randrange(8)
            return [Response(delay_us, bytes(changed))]
        if kind == "repeat":
            return [Response(delay_us, data, rng.choice((2, 3, 200)), 10)]
        if kind == "delay":
            return [Response(delay_us + rng.randrange(2 * TIMEOUT_US), data)]
        if kind == "replace":
            return [Response(delay_us, rng.randbytes(rng.choice((0, 1, 4, 7, 8, 8, 8))))]
        if kind == "join":
            return [Response(delay_us, part) for part in (self._foreign(), data, self._foreign())]
        if kind == "abort":
            return [Response(delay_us, struct.pack("<BHBI", 0x80, INDEX, SUB, rng.getrandbits(32)))]
        if kind == "storm":
            return [Response(delay_us, self._foreign(), 300)]
        return []

    def _foreign(self) -> bytes:
        """A response to somebody else, or a frame of another kind of transfer."""
        rng = self._rng
        head = struct.pack("<BHB", rng.choice((0x43, 0x41, 0x60, 0x80, 0xC6, 0xA4)), 0x1000 + rng.randrange(4), 0)
        return rng.choice((head + rng.randbytes(4), rng.randbytes(8)))


def converse(seed: int, number: int, show: Callable[[str], object] = len) -> str:
    """Hold one conversation; return what it ended with. Raises BrokenError."""
    rng = Random(f"{seed} {number}")
    content = rng.randbytes(rng.choice((0, 1, 3, 4, 5, 7, 8, 14, 28, 29, 60, rng.randrange(100), rng.randrange(1000))))
    kind = rng.choice((Upload, BlockUpload, Download, BlockDownload))
    reads = kind in (Upload, BlockUpload)
    transfer: Transfer = kind(INDEX, SUB, TIMEOUT_US, DEADLINE_US, LIMIT_BYTES if reads else content)  # type: ignore[arg-type]
    server = Server(rng, content if reads else b"")
    for request in play(transfer, server, DEADLINE_US):
        show(request.hex(" "))
    return _judge(transfer, server, content)


def _judge(transfer: Transfer, server: Server, content: bytes) -> str:
    """Check that a transfer ended in exactly one way, and that without damage it did what it was for."""
    name, damaged = type(transfer).__name__, bool(server.damages)
    failed = transfer.abort_code is not None or transfer.failure is not None
    require(transfer.abort_code is None or transfer.failure is None, f"{name}: aborted by both sides")
    require(len(transfer.data) <= LIMIT_BYTES, f"{name}: {len(transfer.data)} bytes, allowed are {LIMIT_BYTES}")
    require(damaged or not failed, f"{name} of {len(content)} bytes failed without damage: {transfer.failure}")
    if failed:
        require(not transfer.data, f"{name}: failed, and has data")
        return f"{name}: {'aborted by the server' if transfer.failure is None else transfer.failure or 'no response'}"
    result = transfer.data if isinstance(transfer, Upload) else server.device.od.get(INDEX, SUB)
    require(damaged or result == content, f"{name}: {len(content)} bytes became {result!r}")
    return f"{name}: done"


def rounds(seed: int, numbers: Iterable[int]) -> Counter[str]:
    """Hold conversations; return how often each end occurred. Raises BrokenError that names the conversation."""
    ends: Counter[str] = Counter()
    for number in numbers:
        measured = number % MEMORY_CONVERSATIONS == 0
        if measured:
            tracemalloc.start()
        try:
            end = converse(seed, number)
            peak_bytes = tracemalloc.get_traced_memory()[1]  # 0 unless measured
            if measured:
                gc.collect()  # empties the interpreter's free lists, too
            held_bytes = tracemalloc.get_traced_memory()[0]
            bounded = held_bytes <= HELD_LIMIT_BYTES and peak_bytes <= MEMORY_LIMIT_BYTES
            require(bounded, f"{peak_bytes} bytes of memory, {held_bytes} at its end")
        except Exception as error:
            raise BrokenError(f"--seed {seed} --only {number}: {type(error).__name__}: {error}") from error
        finally:
            tracemalloc.stop()
        ends[re.sub(r"\d+", "n", end)] += 1
    return ends


def main() -> None:
    """Run the conversations. Raises BrokenError."""
    parser = arguments(__doc__)
    parser.add_argument("--conversations", type=int, default=20_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--only", type=int, help="the number of one conversation")
    args = parser.parse_args()
    if args.only is not None:
        print(converse(args.seed, args.only, print))
        return
    started_s = time.perf_counter()
    ends = rounds(args.seed, range(args.conversations))
    for end, count in ends.most_common():
        print(f"{count:9} {end}")
    print(f"{args.conversations} conversations, seed {args.seed}, {time.perf_counter() - started_s:.0f} s: all ended")


if __name__ == "__main__":
    main()
