"""Errors of the runtime.

EdgeError
+-- ModelError (ValueError)   a model that is missing, unreadable or breaks the contract
+-- WindowError (ValueError)  an input that cannot be inferred from: shape, type, not finite
+-- UsageError (ValueError)   what the caller asked for cannot be done as asked
+-- MessageError (ValueError) bytes that are no packed message
+-- SinkError (OSError)       a sink that cannot be opened or written
    +-- SinkClosedError       whoever read the sink has gone
"""


class EdgeError(Exception):
    """Root of all errors of the runtime."""


class ModelError(EdgeError, ValueError):
    """A model that is missing, unreadable or breaks the contract."""


class WindowError(EdgeError, ValueError):
    """An input window that the network must not see."""


class UsageError(EdgeError, ValueError):
    """What the caller asked for cannot be done as asked."""


class MessageError(EdgeError, ValueError):
    """Bytes that are no packed message."""


class SinkError(EdgeError, OSError):
    """A sink that cannot be opened or written."""


class SinkClosedError(SinkError):
    """Whoever read the sink has gone: an ordinary end."""
