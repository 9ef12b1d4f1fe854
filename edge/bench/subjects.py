"""Subjects of a bench, methods without a network and models, and their error on the frozen test set."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from edge.errors import ModelError, UsageError
from edge.evaluation.classical_methods import CONTACT_LEVEL, fitted_methods
from edge.evaluation.test_set import FrozenSet, infer_with_intervals, judge, mean_error
from edge.inference.bundled import BUNDLE_DIR, bundled_models
from edge.inference.onnx_session import ModelSession

FROZEN_FILE: Final = BUNDLE_DIR / "frozen.npz"
CLASSICAL_FILE: Final = BUNDLE_DIR / "classical.npz"

Infer = Callable[[NDArray[np.float32]], object]  # on a window (K, 3, rows, cols) in zeroed counts


class Subject(NamedTuple):
    """Method or model that can be measured: the path of a model, or the scale of a method without a network."""

    name: str
    path: str | None = None
    scale: int = 10


def subjects(scale: int, folder: Path | None, refused: Callable[[str], object]) -> list[Subject]:
    """Return the methods without a network, the bundled models, and the user's own in a folder, named FOLDER/NAME.

    `refused` gets a line for each file in it that is no usable model; without any a UsageError is raised.
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


def opened(subject: Subject) -> Infer:
    """Return the subject ready to run."""
    if subject.path is None:
        method = fitted_methods(CLASSICAL_FILE, subject.scale)[subject.name]
        return lambda window: method(window[None, 0])
    model = ModelSession(Path(subject.path))
    taps, scale_window = model.contract.taps, model.contract.scale_window
    return lambda window: model.run(scale_window(window[:taps]))


class ErrorRow(NamedTuple):
    """Errors of a subject that is given its newest taps: the mean of each metric over all frames."""

    name: str
    given: int
    error: dict[str, float]


def error_rows(subject: Subject, frozen: FrozenSet) -> Iterator[ErrorRow]:
    """Yield the error of a method with the newest tap, of a model with one and with all, or raise an EdgeError."""

    def row(
        given: int, patterns: NDArray[np.floating], level: float, half_width_mm: NDArray[np.floating] | None = None
    ) -> ErrorRow:
        return ErrorRow(subject.name, given, mean_error(judge(patterns, frozen, level, half_width_mm)))

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
