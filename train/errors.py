"""Errors of training.

TrainError
+-- SurfaceError (ValueError)  a name that stands for no surface
+-- MeshError (ValueError)     a mesh file that cannot be tapped
+-- CheckpointError (ValueError)  weights that cannot be used
+-- DatasetError (ValueError)  a file of taps that cannot be read or written
"""


class TrainError(Exception):
    """Root of all errors of training."""


class SurfaceError(TrainError, ValueError):
    """A name that stands for no surface."""


class MeshError(TrainError, ValueError):
    """A mesh file that cannot be tapped: unreadable, open, flat, or of an impossible size."""


class DatasetError(TrainError, ValueError):
    """A file of taps that cannot be read or written: absent, not ours, newer, damaged, or hostile."""


class CheckpointError(TrainError, ValueError):
    """Weights or their configuration are absent, damaged, or do not fit each other."""
