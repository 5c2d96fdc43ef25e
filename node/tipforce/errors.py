"""What can go wrong, as one small family: each message names the place, the value and what is allowed."""


class TipforceError(Exception):
    """Base of every error that tipforce raises on purpose."""


class InputError(TipforceError):
    """A file, an argument or a value that the user gave is not usable; the text says which and what is allowed."""


class NoResponseError(TipforceError):
    """A node did not answer within the time and the number of tries that were set."""


class NoNewSampleError(NoResponseError):
    """A finger gave no new sample in time: it is silent, not started, or asked faster than it measures."""


class SdoAbortError(TipforceError):
    """The node answered an SDO request with an abort. ``code`` is the abort code of CiA 301, 7.2.4.3.17."""

    def __init__(self, message: str, code: int) -> None:
        super().__init__(message)
        self.code = code


class RefusedError(TipforceError):
    """The device understood the request and refused it, or what it holds is not what was asked for."""


class EnvironmentLackError(TipforceError):
    """The machine lacks an interface, a kernel module, a program or a permission; the text says what to do."""
