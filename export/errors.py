"""Errors of the export.

ExportError
+-- CheckpointError (ValueError)  a checkpoint that is missing, unreadable or incomplete
+-- ParityError (ArithmeticError) the ONNX graph and torch disagree
"""


class ExportError(Exception):
    """Root of all errors of the export."""


class CheckpointError(ExportError, ValueError):
    """A checkpoint that cannot be exported."""


class ParityError(ExportError, ArithmeticError):
    """The ONNX graph does not compute what the network computes."""
