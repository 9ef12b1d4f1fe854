"""Subjects of a bench, methods without a network and models, and their error on the frozen test set.

The error is every metric of a subject, by the number of taps that it gets.
"""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from edge.errors import ModelError, UsageError
from edge.evaluation.classical_methods import CONTACT_LEVEL, fit_gain, fitted_methods
from edge.evaluation.metrics import volume_mm3
from edge.evaluation.test_set import FrozenSet, infer_with_intervals, judge, mean_error
from edge.inference.bundled import BUNDLE_DIR, bundled_models
from edge.inference.onnx_session import ModelSession
from firmware_bridge.pad_geometry import USPA44

FROZEN_FILE: Final = BUNDLE_DIR / "frozen.npz"
CLASSICAL_FILE: Final = BUNDLE_DIR / "classical.npz"
FORCE_RANGE_N: Final = 5.0  # force at which every tap of a frozen set ends, unless the sensor's depth limit comes first

Infer = Callable[[NDArray[np.float32]], object]
"""Inference on a window (K, 3, rows, cols) in zeroed counts, of as many taps as it takes or more."""


class Subject(NamedTuple):
    """Method or model that can be measured: the path of a model, or the scale of a method without a network."""

    name: str
    path: str | None = None
    scale: int = 10


def subjects(scale: int, folder: Path | None, refused: Callable[[str], object]) -> list[Subject]:
    """Return the methods without a network, the bundled models, and the user's own in a folder, named FOLDER/NAME.

    `refused` gets a line for each file in it that is no usable model; `scale` is that of the test set. Raises
    UsageError where there is no such folder, or no .onnx in it.
    """
    everyone = [Subject(name, None, scale) for name in fitted_methods(CLASSICAL_FILE, scale)]
    everyone += [Subject(path.stem, str(path)) for path in bundled_models()]
    if folder is None:
        return everyone
    if not folder.is_dir():
        raise UsageError(f"--models {folder}: not a folder: name the one that holds your .onnx files")
    paths = sorted(folder.glob("*.onnx"))
    if not paths:
        raise UsageError(f"--models {folder}: holds no .onnx file: export one with 'python -m export.to_onnx'")
    for path in paths:
        try:
            ModelSession(path)
        except ModelError as error:
            refused(f"left out: {' '.join(str(error).split())}")
        else:
            everyone.append(Subject(f"{folder.resolve().name}/{path.stem}", str(path.resolve())))
    return everyone


def chosen(everyone: list[Subject], names: list[str] | None) -> list[Subject]:
    """Return the subjects of these names, or all if there are no names; raises UsageError for an unknown one."""
    if names is None:
        return everyone
    available = {subject.name for subject in everyone}
    for name in names:
        if name not in available:
            raise UsageError(f"--only {name}: not one of {', '.join(sorted(available))}")
    return [subject for subject in everyone if subject.name in names]


def opened(subject: Subject, threads: int) -> Infer:
    """Return the subject ready to run."""
    if subject.path is None:
        method = fitted_methods(CLASSICAL_FILE, subject.scale)[subject.name]
        return lambda window: method(window[None, 0])
    model = ModelSession(Path(subject.path), threads)
    taps, scale_window = model.contract.taps, model.contract.scale_window
    return lambda window: model.run(scale_window(window[:taps]))


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
