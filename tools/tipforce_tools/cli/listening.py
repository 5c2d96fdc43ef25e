"""The buses of a command line, listened to: what `dump` and `log` share."""

from __future__ import annotations

import signal
from argparse import Namespace
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from typing import TYPE_CHECKING, Any, Self

from tipforce_tools.cli import common

if TYPE_CHECKING:
    from tipforce.host.live.receive_group import ReceiverGroup
    from tipforce_tools.dump.targets import Target


def open_targets(targets: Sequence[Target], args: Namespace, *, tick_s: float | None = None) -> ReceiverGroup:
    """Listen to ``targets``, each on its channel; with none of them, to the bus that the flags name.

    ``tick_s`` is the least time between two batches (None: that of a live display).

    Raises EnvironmentLackError when a bus can't be opened; the others are closed then.
    """
    from tipforce.host.live.can_filter import Selection
    from tipforce.host.live.receive import open_receiver
    from tipforce.host.live.receive_group import ReceiverGroup
    from tipforce.host.live.receiver import TICK_S

    options = resolved_options(args, named=bool(targets))
    tick = TICK_S if tick_s is None else tick_s
    with ExitStack() as opened:
        if targets:
            receivers = [
                opened.enter_context(
                    open_receiver({**options, "channel": target.channel}, target.selection, tick_s=tick)
                )
                for target in targets
            ]
        else:
            receivers = [opened.enter_context(open_receiver(options, Selection(), tick_s=tick))]
        opened.pop_all()
    return ReceiverGroup(receivers, tick_s=tick)


def resolved_options(args: Namespace, *, named: bool) -> dict[str, Any]:
    """The flags' bus options with what python-can's files and environment add.

    A channel that is ``named`` on the command line is a SocketCAN interface, where nothing says otherwise, so that
    `dump vcan0` works as `candump vcan0` does.
    """
    import can

    options = common.bus_options(args)
    if "interface" in options and (named or "channel" in options):
        return options
    try:
        configured = can.util.load_config()
    except can.CanInterfaceNotImplementedError:
        return {"interface": "socketcan", **options} if named else options
    for key in ("interface", "channel"):
        if configured.get(key) is not None:
            options.setdefault(key, configured[key])
    return options


def counted(number: int, what: str) -> str:
    """`1 frame`, `2 frames`."""
    return f"{number} {what}" if number == 1 else f"{number} {what}s"


class StopSignals:
    """Notes SIGINT and SIGTERM instead of raising, so that nothing that was received is lost. A context manager.

    The second signal raises KeyboardInterrupt: something hangs.
    """

    def __init__(self) -> None:
        self.stopped = False
        self._before: dict[int, Any] = {}

    def __enter__(self) -> Self:
        for number in (signal.SIGINT, signal.SIGTERM):
            with suppress(ValueError):  # not the main thread: signals go there
                self._before[number] = signal.signal(number, self._stop)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _stop(self, _number: int, _frame: object) -> None:
        if self.stopped:
            raise KeyboardInterrupt
        self.stopped = True
