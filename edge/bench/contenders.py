"""Subjects of a bench: methods without a network, models with their contracts, and peers' networks."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from edge.errors import ModelError, UsageError
from edge.evaluation.classical_methods import fitted_methods
from edge.inference.bundled import BUNDLE_DIR, bundled_models
from edge.inference.onnx_session import ORT_ERRORS, ModelSession, load_session

FROZEN_FILE: Final = BUNDLE_DIR / "frozen.npz"
WEIGHTS_KEY: Final = "tactile.weights"
"""Metadata key that marks a network with untrained weights."""
PEER_SEED: Final = 0
_CLASSICAL_FILE: Final = BUNDLE_DIR / "classical.npz"

Infer = Callable[[NDArray[np.float32]], object]
"""Inference on a window (K, 3, rows, cols) in zeroed counts, of as many taps as it takes or more."""


@dataclass(frozen=True, slots=True)
class Subject:
    """Method or network that can be measured.

    Attributes:
        name: as tables show it.
        kind: a peer has no contract, so its error cannot be computed.
        path: of the model or the peer; None for a classical method.
        scale: pattern pixels per taxel pitch that a classical method makes.
    """

    name: str
    kind: Literal["classical", "model", "peer"]
    path: str | None = None
    scale: int = 10


def classical_subjects(scale: int) -> list[Subject]:
    """Return the methods without a network."""
    return [Subject(name, "classical", None, scale) for name in fitted_methods(_CLASSICAL_FILE, scale)]


def bundled_subjects() -> list[Subject]:
    """Return the bundled models."""
    return [Subject(path.stem, "model", str(path)) for path in bundled_models()]


def models_in(folder: Path, refused: Callable[[str], object]) -> list[Subject]:
    """Return the user's own models, named FOLDER/NAME; `refused` gets a line for each file that is no usable model.

    Raises:
        UsageError: no such folder, or no .onnx in it.
    """
    if not folder.is_dir():
        raise UsageError(f"--models {folder}: not a folder: name the one that holds your .onnx files")
    paths = sorted(folder.glob("*.onnx"))
    if not paths:
        raise UsageError(f"--models {folder}: holds no .onnx file: export one with 'python -m export.to_onnx'")
    subjects: list[Subject] = []
    for path in paths:
        try:
            ModelSession(path)
        except ModelError as error:
            refused(f"left out: {' '.join(str(error).split())}")
        else:
            subjects.append(Subject(f"{folder.resolve().name}/{path.stem}", "model", str(path.resolve())))
    return subjects


def peer_subject(path: Path) -> Subject:
    """Return a peer's network, which only has to run on floats.

    Raises:
        ModelError: it cannot be loaded, or has an input that is not of floats.
    """
    random_feeds(load_session(path), path)
    return Subject(f"peer {path.stem}", "peer", str(path.resolve()))


def peer_weights(path: Path) -> str | None:
    """Return a network's own note that its weights are untrained, or None."""
    return load_session(path).get_modelmeta().custom_metadata_map.get(WEIGHTS_KEY)


def chosen(subjects: list[Subject], names: list[str] | None) -> list[Subject]:
    """Return the subjects of these names, or all if there are no names.

    Raises:
        UsageError: no subject has this name; the names are listed.
    """
    if names is None:
        return subjects
    known = {subject.name for subject in subjects}
    for name in names:
        if name not in known:
            raise UsageError(f"--only {name}: not one of {', '.join(sorted(known))}")
    return [subject for subject in subjects if subject.name in names]


def opened(subject: Subject, threads: int) -> Infer:
    """Return the subject ready to run.

    Raises:
        ModelError: it cannot be used.
    """
    if subject.path is None:
        method = fitted_methods(_CLASSICAL_FILE, subject.scale)[subject.name]
        return lambda window: method(window[None, 0])
    path = Path(subject.path)
    if subject.kind == "model":
        model = ModelSession(path, threads)
        taps, scale_window = model.contract.taps, model.contract.scale_window
        return lambda window: model.run(scale_window(window[:taps]))
    return _opened_peer(path, threads)


def _opened_peer(path: Path, threads: int) -> Infer:
    session = load_session(path, threads)
    binding = session.io_binding()
    for name, array in random_feeds(session, path).items():
        binding.bind_cpu_input(name, array)
    for output in session.get_outputs():
        binding.bind_output(output.name)

    def infer(window: NDArray[np.float32]) -> None:
        del window  # a peer's inputs are its own
        try:
            session.run_with_iobinding(binding)
        except ORT_ERRORS as error:
            raise ModelError(f"{path}: cannot be run: {error}") from error

    return infer


def taps_of(subject: Subject) -> int:
    """Return the number of taps of a window, all that the subject takes; 1 for a peer, whose taps are unknown.

    Raises:
        ModelError: it cannot be used.
    """
    return ModelSession(Path(subject.path)).contract.taps if subject.path and subject.kind == "model" else 1


def random_feeds(session: Any, path: Path, taps: int = 1) -> dict[str, NDArray[np.floating]]:
    """Return seeded normal numbers for every input.

    Args:
        session: of the network.
        path: of the network.
        taps: size of each dimension named "taps"; another one that is not fixed is 1.

    Raises:
        ModelError: an input is not of floats.
    """
    rng = np.random.default_rng(PEER_SEED)
    types = {"tensor(float)": np.float32, "tensor(double)": np.float64, "tensor(float16)": np.float16}
    feeds: dict[str, NDArray[np.floating]] = {}
    for tensor in session.get_inputs():
        if tensor.type not in types:
            raise ModelError(
                f"{path}: input {tensor.name} is {tensor.type}, expected floats: export it with float inputs"
            )
        shape = [size if isinstance(size, int) else taps if size == "taps" else 1 for size in tensor.shape]
        feeds[tensor.name] = rng.standard_normal(shape).astype(types[tensor.type])
    return feeds
