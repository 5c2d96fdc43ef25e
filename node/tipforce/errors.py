"""Errors of tipforce: each message names the place, the value and what is allowed."""

from collections.abc import Iterator
from contextlib import contextmanager

from canopen_device.errors import CanopenDeviceError as TipforceError
from canopen_device.errors import EnvironmentLackError, InputError, placed

__all__ = ["DuplicateNodeError", "EnvironmentLackError", "InputError", "LogError", "NoNewSampleError"]
__all__ += ["NoResponseError", "RefusedError", "SdoAbortError", "TipforceError", "WriteError", "needing", "placed"]


@contextmanager
def needing(lack: str) -> Iterator[None]:
    """Raise EnvironmentLackError with the text ``lack`` for a package that the block cannot import."""
    try:
        yield
    except ImportError:
        raise EnvironmentLackError(lack) from None


class LogError(InputError):
    """A log is damaged, is not a log, or holds nothing of a fingertip; the text says which."""


class WriteError(TipforceError):
    """A file could not be written completely, for example on a full disk; an existing one is unchanged."""


class NoResponseError(TipforceError):
    """A node did not respond within the time-out and the number of retries."""


class NoNewSampleError(NoResponseError):
    """A finger sent no new sample in time: it is silent, not started, or polled faster than it samples."""


class SdoAbortError(TipforceError):
    """The node responded to an SDO request with an abort. ``code`` is the abort code of CiA 301, 7.2.4.3.17."""

    def __init__(self, message: str, code: int) -> None:
        super().__init__(message)
        self.code = code


class RefusedError(TipforceError):
    """The device rejected a valid request, or its content differs from the requested one."""


class DuplicateNodeError(TipforceError):
    """Two nodes use one node-id, so no value of it is known; the text says how to give one of them another."""
