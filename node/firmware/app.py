"""The node on a board: one loop over gauges, bus and device that never waits for any of them."""

import time

from canopen_device.core.storage import LSS_GROUP
from tipforce.fingertip.node import fingertip_node

from .source import Gauges

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Callable

    from tipforce_loader.flash import FlashStore
    from tipforce_loader.programs import Programs

    from .can_port import CanPort

LONGEST_WAIT_US = 100000
HEALTHY_US, TRIAL_US = 5000000, 60000000  # of a program on trial: it is confirmed, or given up
POLL_US = 500  # the longest sleep: the interval at which gauges and receive buffers are polled


class Clock:
    """Microseconds since power-on that never wrap, from ``ticks`` that does; ``now`` is needed once a period of it."""

    def __init__(
        self, ticks: "Callable[[], int] | None" = None, diff: "Callable[[int, int], int] | None" = None, now_us: int = 0
    ) -> None:
        self._ticks: "Callable[[], int]" = ticks or time.ticks_us  # type: ignore[attr-defined]
        self._diff: "Callable[[int, int], int]" = diff or time.ticks_diff  # type: ignore[attr-defined]
        self._now_us = now_us
        self._last = self._ticks()

    def now(self) -> int:
        """Return the time in microseconds."""
        ticks = self._ticks()
        self._now_us += self._diff(ticks, self._last)
        self._last = ticks
        return self._now_us


class Firmware:
    """A fingertip node with its gauges, its controller and its flash. ``poll`` once, or ``run`` until power-off."""

    def __init__(
        self, node_id: int, gauges: "Gauges", port: "CanPort", store: "FlashStore", serial: int, clock: Clock,
        programs: "Programs | None" = None, restart: "Callable[[], None]" = lambda: None, restarted: bool = False,
    ) -> None:  # fmt: skip
        self.gauges, self.port, self._clock = gauges, port, clock
        self.device = fingertip_node(node_id, gauges, gauges.n, serial, store.save, store.load, programs=programs)
        if restarted:
            self.device.wear.drain()
        # The bit rate stored by LSS applies from power-on (CiA 305); without one, that of the board.
        self.device.lss.bit_rate = port.bit_rate
        self.device.lss.restore(self.device.storage.read_blob(LSS_GROUP))
        if self.device.lss.bit_rate != port.bit_rate:
            port.set_bit_rate(self.device.lss.bit_rate)
        self._mute_until_us = -1
        self._bit_rate_at_us, self._bit_rate = -1, 0
        self._programs, self._restart, self._restart_at_us = programs, restart, -1
        self._began_us, self._heard = clock.now(), False

    def poll(self) -> int:
        """Run the loop once; return the microseconds until the node is due."""
        now_us = self._clock.now()
        if self._bit_rate and now_us >= self._bit_rate_at_us:
            self.port.set_bit_rate(self._bit_rate)
            self._bit_rate = 0
        self.gauges.poll(now_us)
        frames = self.port.receive()
        sent, due_us = self.device.step(now_us, frames)
        if now_us >= self._mute_until_us:
            for can_id, data in sent:
                self.port.send(can_id, data)
        for what, value, delay_ms in self.device.requests:
            if what == "bus-restart":
                self.port.restart()
            elif what == "bit-rate":
                # CiA 305, 6.4.4: no node sends during the delay before the switch and the delay after it.
                self._bit_rate, self._bit_rate_at_us = value, now_us + 1000 * delay_ms
                self._mute_until_us = now_us + 2000 * delay_ms
            elif what == "restart":
                self._restart_at_us = now_us + 1000 * delay_ms
        self.device.requests.clear()
        if self._programs is not None:
            self._heard = self._heard or bool(frames)
            self._judge(self._programs, now_us)
        return max(0, min(due_us - now_us, LONGEST_WAIT_US))

    def run(self, sleep_us: "Callable[[int], None] | None" = None, feed: "Callable[[], None]" = lambda: None) -> None:
        """Run the node until power-off. ``feed`` resets the watchdog."""
        sleep_us = sleep_us or time.sleep_us  # type: ignore[attr-defined]
        while True:
            wait_us = self.poll()
            feed()
            if wait_us and not self.port.busy():
                sleep_us(min(wait_us, POLL_US))

    def _judge(self, programs: "Programs", now_us: int) -> None:
        """Confirm a program on trial that has run for a while and received a frame; give up one that receives none."""
        if 0 <= self._restart_at_us <= now_us:
            self._restart()
        elif programs.on_trial:
            if self._heard and now_us - self._began_us >= HEALTHY_US:
                programs.confirm()
            elif now_us - self._began_us >= TRIAL_US:
                self._restart()


def start(port: "CanPort") -> None:
    """Run the node on this board with this controller until power-off, from the settings in board.py."""
    import machine

    from tipforce_loader import board, boot
    from tipforce_loader.flash import FileSlots, FlashStore

    gauges = Gauges(board.chips(), board.COUNTS_PER_MICROSTRAIN)  # type: ignore[no-untyped-call]
    store = FlashStore(FileSlots(board.FOLDER))
    restarted = machine.reset_cause() != machine.PWRON_RESET
    firmware = Firmware(
        board.NODE_ID, gauges, port, store, board.serial(), Clock(), boot.programs, board.restart, restarted
    )
    if not board.WATCHDOG_MS:
        firmware.run()
    firmware.run(feed=machine.WDT(timeout=board.WATCHDOG_MS).feed)
