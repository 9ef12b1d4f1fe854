"""Errors of the runtime: EdgeError, and leaves that are also the builtin that fits."""

from firmware_bridge.errors import harmless


class EdgeError(Exception):
    """Root of all errors of the runtime; its text holds no control characters."""

    def __str__(self) -> str:
        return harmless(super().__str__())


class ModelError(EdgeError, ValueError):
    """A model that is missing, unreadable or breaks the contract."""


class WindowError(EdgeError, ValueError):
    """An input window that the network must not see."""


class UsageError(EdgeError, ValueError):
    """A request of the caller that cannot be met."""


class NoResultError(EdgeError, TimeoutError):
    """No new result in the time that the caller gave."""


class SinkError(EdgeError, OSError):
    """A sink that cannot be opened or written."""


class SinkClosedError(SinkError):
    """A sink whose reader has gone, which is an ordinary end."""
