"""Errors of training: TrainError is the root of all others."""


class TrainError(Exception):
    """Root of all errors of training."""


class SurfaceError(TrainError, ValueError):
    """Unknown name of a surface, or a surface that does not lie under the pad."""


class MeshError(TrainError, ValueError):
    """A mesh file that cannot be tapped: unreadable, open, flat, or of an impossible size."""


class DatasetError(TrainError, ValueError):
    """File of taps that cannot be read or written: absent, of another format, newer, damaged, or hostile."""


class CheckpointError(TrainError, ValueError):
    """Weights or configuration that are absent, damaged, or do not fit each other."""
