"""Two slots for programs: one runs, a download goes into the other. Runs on MicroPython.

The slot that starts is a record in a store of its own, which replaces it as a whole (``flash``). A download changes no
record, so a power cut at any byte leaves the old program. ``start`` puts the new one on trial: it is started once, and
the next restart returns to the old one unless ``confirm`` came before. If no slot is sound, the program starts that was
copied to the board's file system with the loader."""

from . import image
from .flash import FileSlots

TYPE_CHECKING = False
if TYPE_CHECKING:
    from typing import BinaryIO, Protocol

    from .flash import FlashStore

    class ProgramSlots(Protocol):
        """Memory for two images."""

        size: int

        def open(self, slot: int, mode: str) -> "BinaryIO": ...  # "rb", or "wb" to replace it; raises OSError


INSTALLED, NONE = 2, 255  # in place of a slot: the program on the file system; no slot
_GROUP = "program"


class Programs:
    """The slots of a board.

    Call ``choose`` at power-on, ``confirm`` when the program has proved healthy. ``product`` is 1018h:2. ``version`` is
    that of the program on the file system, after ``choose`` of the running one, as is ``crc`` (0 on the file system).
    ``reason`` says why the last download or trial failed (``image``), else 0."""

    def __init__(self, slots: "ProgramSlots", store: "FlashStore", key: bytes, product: int, version: str) -> None:
        self._slots, self._store, self._key, self._product = slots, store, key, product
        self._file: "BinaryIO | None" = None
        self._head = b""
        record = store.load(_GROUP)
        # The slot that was confirmed, the slot on trial, whether the trial has begun, the reason of a failure.
        self._active, self._trial, self._begun, self.reason = record or (INSTALLED, NONE, 0, 0)
        self.version, self.crc = version, 0
        self.ready = False

    def choose(self) -> int:
        """Return the slot to start, or INSTALLED."""
        if self._trial != NONE and self._begun:
            self._give_up(image.UNHEALTHY)
        if self._trial != NONE:
            # Recorded before the start: whatever happens from here on, the next power-on returns to the old program.
            reason = self._load(self._trial) if self._save(self._active, self._trial, 1, 0) else image.FLASH_FAILED
            if not reason:
                return self._trial
            self._give_up(reason)
        if self._active != INSTALLED:
            reason = self._load(self._active)
            if reason:
                self._active, self.reason = INSTALLED, reason
        return self._active

    @property
    def locked(self) -> bool:
        """Return whether a program is on trial, or about to be."""
        return self._trial != NONE

    @property
    def on_trial(self) -> bool:
        """Return whether the running program is on trial."""
        return bool(self._begun)

    def confirm(self) -> None:
        """Make the program on trial the one that starts from now on."""
        if self._begun:
            self._save(self._trial, NONE, 0, 0)

    def _give_up(self, reason: int) -> None:
        if not self._save(self._active, NONE, 0, reason):
            self._trial, self.reason = NONE, reason

    def _save(self, active: int, trial: int, begun: int, reason: int) -> bool:
        if not self._store.save(_GROUP, bytes((active, trial, begun, reason))):
            return False
        self._active, self._trial, self._begun, self.reason = active, trial, begun, reason
        return True

    def _load(self, slot: int) -> int:
        reason, header = self._check(slot)
        if header is not None:
            self.version, self.crc = header.version_text(), header.crc
        return reason

    def _check(self, slot: int) -> "tuple[int, image.Header | None]":
        try:
            with self._slots.open(slot, "rb") as file:
                return image.check(file, self._key)
        except OSError:
            return image.FLASH_FAILED, None

    @property
    def busy(self) -> bool:
        """Return whether a download or a trial is in progress."""
        return self._file is not None or self.locked

    @property
    def _target(self) -> int:
        return 1 - self._active if self._active < INSTALLED else 0

    def begin(self, size: int) -> int:
        """Erase the slot that does not run, for an image of ``size`` bytes; return 0 or a reason."""
        self.cancel()
        self.ready = False
        self._head, self._size = b"", size
        self.reason = image.TOO_LARGE if size > self._slots.size else 0
        if not self.reason:
            try:
                self._file = self._slots.open(self._target, "wb")
            except OSError:
                self.reason = image.FLASH_FAILED
        return self.reason

    def write(self, part: bytes) -> int:
        """Write the next bytes; return 0 or a reason. The head is checked as soon as it has arrived."""
        if self._file is None:
            return image.FLASH_FAILED
        if len(self._head) < image.HEAD_SIZE:
            self._head += part[: image.HEAD_SIZE - len(self._head)]
            if len(self._head) == image.HEAD_SIZE:
                self.reason = self._refusal()
        if not self.reason:
            try:
                self._file.write(part)
            except OSError:
                self.reason = image.FLASH_FAILED
        return self.reason

    def _refusal(self) -> int:
        try:
            header = image.Header(self._head)
        except ValueError:
            return image.NOT_AN_IMAGE
        if not header.fits(self._product):
            return image.OTHER_PRODUCT
        return 0 if header.length + image.HEAD_SIZE == self._size else image.DAMAGED

    def end(self) -> int:
        """Read the downloaded image back and check it; return 0 or a reason."""
        self.cancel()
        if not self.reason:
            self.reason = self._check(self._target)[0]
            self.ready = not self.reason
        return self.reason

    def cancel(self) -> None:
        """Close the slot."""
        file, self._file = self._file, None
        if file is not None:
            try:
                file.close()
            except OSError:
                self.reason = image.FLASH_FAILED

    def clear(self) -> int:
        """Erase what was downloaded; return 0 or a reason."""
        self.ready = False
        try:
            self._slots.open(self._target, "wb").close()
        except OSError:
            self.reason = image.FLASH_FAILED
            return self.reason
        return 0

    def start(self) -> int:
        """Put the downloaded program on trial from the next restart on; return 0 or a reason."""
        if not self._save(self._active, self._target, 0, 0):
            self.reason = image.FLASH_FAILED
        return self.reason


class FileProgramSlots(FileSlots):
    """Two files in a directory of the board's file system, which is created if it is missing."""

    def __init__(self, folder: str, size: int = 1 << 20) -> None:
        FileSlots.__init__(self, folder)
        self.size = size

    def open(self, slot: int, mode: str) -> "BinaryIO":
        """Open the file of a slot."""
        return open("%s/program%d.bin" % (self._folder, slot), mode)  # type: ignore[return-value]
