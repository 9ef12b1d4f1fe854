"""Error on the frozen test set: every metric of a subject, by the number of taps that it gets."""

from collections.abc import Iterator
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from edge.bench.contenders import CLASSICAL_FILE, Subject
from edge.errors import ModelError
from edge.evaluation.classical_methods import CONTACT_LEVEL, fit_gain, fitted_methods
from edge.evaluation.metrics import volume_mm3
from edge.evaluation.test_set import FrozenSet, infer_with_intervals, judge, mean_error
from edge.inference.onnx_session import ModelSession
from firmware_bridge.pad_geometry import USPA44

FORCE_RANGE_N: Final = 5.0  # force at which every tap of a frozen set ends, unless the sensor's depth limit comes first


class ErrorRow(NamedTuple):
    """Errors of a subject that is given its newest taps: the mean of each metric over all frames, and of the force."""

    name: str
    given: int
    error: dict[str, float]


def error_rows(subject: Subject, frozen: FrozenSet) -> Iterator[ErrorRow]:
    """Yield the error of a classical method with the newest tap, of a model with one tap and with all it takes.

    Raises:
        ModelError: the model cannot be used, or was made for another scale than the test set.
        FrozenSetError: the model takes more taps than the test set has.
    """

    def row(
        given: int, patterns: NDArray[np.floating], level: float, half_width_mm: NDArray[np.floating] | None = None
    ) -> ErrorRow:
        error = mean_error(judge(patterns, frozen, level, half_width_mm))
        force_percent = round(force_error_percent(patterns, frozen), 4)
        return ErrorRow(subject.name, given, error | {"force_percent": force_percent})

    if subject.path is None:
        method = fitted_methods(CLASSICAL_FILE, frozen.scale)[subject.name]
        yield row(1, method(frozen.newest.astype(np.float32)), CONTACT_LEVEL)
        return
    session = ModelSession(Path(subject.path))
    contract = session.contract
    if contract.scale != frozen.scale:
        raise ModelError(f"{subject.path}: contract key 'scale' is {contract.scale}, the test set's is {frozen.scale}")
    for given in sorted({1, contract.taps}):
        patterns, half_width_mm = infer_with_intervals(session, frozen, given)
        yield row(given, patterns, contract.contact_level, half_width_mm)


def force_error_percent(patterns: NDArray[np.floating], frozen: FrozenSet) -> float:
    """Return the RMS error of the force that patterns (n, H, W) in [mm] sum up to, in [% of FORCE_RANGE_N].

    A pattern's deformation summed over its area becomes newtons by one factor, the same for every subject: the one that
    brings the true patterns nearest to the true forces, least squares, no offset. It is not fitted to the evaluated
    patterns: a pattern that is too deep on the whole is an error. Shapes have factors of their own, so true patterns
    are off too, which is the floor of the error (`force_floor_percent`).
    """
    pixel_mm = USPA44.pixel_pitch_mm(frozen.scale)
    newtons_per_mm3 = fit_gain(volume_mm3(frozen.patterns(), pixel_mm), frozen.force_n)
    error_n = newtons_per_mm3 * volume_mm3(patterns, pixel_mm) - frozen.force_n
    return 100 * float(np.sqrt(np.mean(np.square(error_n, dtype=np.float64)))) / FORCE_RANGE_N


def force_floor_percent(frozen: FrozenSet) -> float:
    """Return the `force_error_percent` of the true patterns."""
    return force_error_percent(frozen.patterns(), frozen)
