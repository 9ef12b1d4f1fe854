"""Errors of the export.

ExportError
+-- ParityError (ArithmeticError) the ONNX graph and torch disagree
"""


class ExportError(Exception):
    """Root of all errors of the export."""


class ParityError(ExportError, ArithmeticError):
    """Failed comparison: the ONNX graph does not compute what the network computes."""
