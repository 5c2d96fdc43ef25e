"""Workers for the parts of a recording on a Dask cluster, which repeats the work of a worker that ends."""

from __future__ import annotations

from typing import Any

from tipforce.errors import EnvironmentLackError, TipforceError
from tipforce.host.decoding.decoded_part import Ends, Start
from tipforce.host.decoding.log_part import Piece, Reading
from tipforce.host.decoding.recording import State
from tipforce_tools.decode.parts import Event, Sink, Work, Written
from tipforce_tools.decode.writers import Shape

CONNECT_S = 10
"""Timeout of the scheduler's response."""
_PER_THREAD = 2
"""Parts in work for each thread of the cluster: one is decoded while another one waits for the parts in front."""


class Cluster:
    """The workers of a scheduler. They must see the logs and the output by the same names."""

    def __init__(self, scheduler: str, reading: Reading, sink: Sink) -> None:
        """Raises EnvironmentLackError without Dask or without a response of the scheduler."""
        try:
            import distributed
        except ImportError:
            raise EnvironmentLackError("--scheduler needs Dask: `pip install 'tipforce[dask]'`") from None
        try:
            self._client: Any = distributed.Client(scheduler, timeout=CONNECT_S)
        except (OSError, ValueError) as error:
            raise EnvironmentLackError(f"--scheduler {scheduler}: no response: {error}") from error
        self._waiting: Any = distributed.as_completed([])
        self._reading, self._sink = reading, sink
        self._works: dict[int, Any] = {}
        self._numbers: dict[str, int] = {}

    @property
    def free(self) -> int:
        """How many parts can be begun now."""
        threads: int = sum(self._client.nthreads().values())
        return max(_PER_THREAD * max(threads, 1) - len(self._works), 0)

    def decode(self, number: int, piece: Piece) -> None:
        """Begin to decode a part."""
        work = self._works[number] = self._client.submit(_decoded, number, piece, self._reading, pure=False)
        self._wait(number, self._client.submit(_ends, work, pure=False, priority=1))

    def write(self, number: int, start: Start, shape: Shape) -> None:
        """Complete and write a decoded part."""
        self._wait(number, self._client.submit(_write, self._works[number], start, shape, self._sink, pure=False,
                                               priority=2))  # fmt: skip

    def alone(self, number: int, state: State, shape: Shape, last: bool) -> None:
        """Decode and write a part after the ones in front."""
        self._wait(number, self._client.submit(_alone, self._works[number], state, shape, self._sink, last, pure=False,
                                               priority=2))  # fmt: skip

    def _wait(self, number: int, future: Any) -> None:
        self._numbers[future.key] = number
        self._waiting.add(future)

    def next(self) -> Event:
        """Wait for the next event. Raises EnvironmentLackError for a part whose workers end again and again."""
        import distributed

        future = next(self._waiting)
        number = self._numbers.pop(future.key)
        try:
            told = future.result()
        except distributed.KilledWorker as error:
            raise EnvironmentLackError(f"--scheduler: the workers of part {number} ended: {error}") from error
        future.release()
        if not isinstance(told, Ends):
            self._works.pop(number).release()
        return Event(number, told)

    def close(self) -> None:
        """End all work."""
        self._works.clear()
        self._client.close()


def _decoded(number: int, piece: Piece, reading: Reading) -> tuple[Work, Ends | Exception]:
    work = Work(number, piece, reading)
    try:
        return work, work.decode()
    except (TipforceError, OSError) as error:
        return work, error


def _ends(decoded: tuple[Work, Ends | Exception]) -> Ends | Exception:
    return decoded[1]


def _write(decoded: tuple[Work, Ends], start: Start, shape: Shape, sink: Sink) -> Written | Exception:
    try:
        return decoded[0].write(start, shape, sink)
    except (TipforceError, OSError) as error:
        return error


def _alone(decoded: tuple[Work, Ends], state: State, shape: Shape, sink: Sink, last: bool) -> Written | Exception:
    try:
        return decoded[0].alone(state, shape, last, sink)
    except (TipforceError, OSError) as error:
        return error
