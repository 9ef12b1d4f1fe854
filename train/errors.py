"""Errors of training, TrainError being the root of all others, and how they end a program."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager

from edge.errors import EdgeError
from firmware_bridge.errors import BridgeError


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


@contextmanager
def ended_by_errors(program: str) -> Iterator[None]:
    """End a program by an error of its user, in one line and with exit code 1, or with 130 when interrupted."""
    try:
        yield
    except BaseException as error:
        if _interrupted(error):
            sys.stderr.write(f"{program}: interrupted; the same command continues\n")
            sys.exit(130)
        if isinstance(error, (TrainError, BridgeError, EdgeError)):
            sys.exit(f"{program}: {error}")
        if isinstance(error, OSError):
            where = f"{error.filename}: " if error.filename else ""
            sys.exit(f"{program}: {where}{error.strerror or error}")
        raise


def _interrupted(error: BaseException | None) -> bool:
    """Return whether Ctrl-C came, also where what it cut off failed then: zipfile closes no archive in mid-array."""
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__context__
    return error is not None
