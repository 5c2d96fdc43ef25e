"""Errors of a device and its files: each message names the place, the value and what is allowed."""

from collections.abc import Iterator
from contextlib import contextmanager


class CanopenDeviceError(Exception):
    """Base of every error that this package raises on purpose."""


class InputError(CanopenDeviceError):
    """A file, an argument or a value of the user is invalid; the text names it and what is allowed."""


def cause(error: BaseException) -> str:
    """Return the text of an error of a bus, without the traceback that socketcand's has."""
    return str(error).partition("  Traceback")[0]


@contextmanager
def placed(place: str) -> Iterator[None]:
    """Put a place in front of the text of an InputError that the block raises."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{place}: {error}") from None


class EnvironmentLackError(CanopenDeviceError):
    """The machine lacks an interface, a kernel module, a program or a permission; the text says how to provide it."""
