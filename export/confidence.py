"""Errors in a model's contract: on the frozen test set, and as its deviations predict them."""

from collections.abc import Collection
from typing import Final

import numpy as np
from numpy.typing import NDArray

from edge.evaluation.test_set import FrozenSet, judge_model, mean_error, windows_of
from edge.inference.intervals import doubt
from edge.inference.onnx_session import ModelSession
from edge.perception.runtime import Model
from edge.terminal.progress_bar import tracked

BINS: Final = 10


def judge_in_contract(session: ModelSession, frozen: FrozenSet, validation: Collection[FrozenSet]) -> list[str]:
    """Put errors on the test set and confidence into a model's contract, and return the errors as text.

    A model of another scale than the frozen set's is not evaluated.
    """
    contract = session.contract
    parts = [f"x{contract.scale}"]
    if contract.scale == frozen.scale:
        for given in tracked(range(1, contract.taps + 1), "judging", "run"):
            contract.test_error[str(given)] = mean_error(judge_model(session, frozen, given))
        error = contract.test_error[str(contract.taps)]
        parts.append(f"{error['psnr_db']:.2f} dB, SSIM {error['ssim']:.3f}")
        if "coverage_90" in error:
            parts.append(f"interval covers {error['coverage_90']:.1%}")
    else:
        parts.append(f"not evaluated, the test set is of x{frozen.scale}")
    fitting = [one for one in validation if one.scale == contract.scale]
    if fitting and session.deviation is not None:
        contract.confidence.update(fit_confidence(session, fitting))
    return parts


def fit_confidence(model: Model, sets: Collection[FrozenSet]) -> dict[str, dict[str, list[float]]]:
    """Fit the table of edge.inference.intervals for a model with deviations.

    Frames are sorted by their uncertainty into bins of equally many; a bin's gain is that of its frames together.
    """
    taps = model.contract.taps
    parts = [
        [doubts_and_errors(model, given, frozen) for given in range(1, taps + 1)]
        for frozen in tracked(sets, "confidence", "set")
    ]
    found = [np.concatenate([part[given] for part in parts], axis=1) for given in range(taps)]
    rows = {str(given): _row(found[given - 1 : given + 1]) for given in range(1, taps + 1)}
    return {given: row for given, row in rows.items() if row["doubt"]}  # empty if no pattern exceeds zero


def doubts_and_errors(model: Model, given: int, frozen: FrozenSet) -> NDArray[np.float64]:
    """Return uncertainty, RMS error and RMS of the pattern for every frame, (3, n), with the newest `given` taps.

    ValueError if the model gives no deviation.
    """
    rows, contract = [], model.contract
    for window, truth in zip(windows_of(frozen, contract, given), frozen.patterns(), strict=True):
        pattern, deviation = model.run(contract.scale_window(window)), model.deviation
        if deviation is None:
            raise ValueError(f"model '{model.name}' gives no deviation, so its error cannot be predicted")
        about, size = doubt(pattern, deviation)
        rows.append((about, float(np.sqrt(np.mean((pattern - truth) ** 2))), size))
    return np.array(rows).T


def _rising(bins: list[NDArray[np.intp]], about: NDArray[np.float64]) -> list[NDArray[np.intp]]:
    """Join bins until each lies above the one before in its first four digits."""
    joined: list[NDArray[np.intp]] = []
    for part in bins:
        if joined and float(f"{about[part].mean():.4g}") <= float(f"{about[joined[-1]].mean():.4g}"):
            joined[-1] = np.concatenate([joined[-1], part])
        else:
            joined.append(part)
    return joined


def _row(found: list[NDArray[np.float64]]) -> dict[str, list[float]]:
    about, error, size = found[0]
    seen = size > 0  # a pattern of zeros has no uncertainty relative to its size
    about, share = about[seen], error[seen] / size[seen]
    bins = _rising([part for part in np.array_split(np.argsort(about), BINS) if part.size], about)
    row = {
        "doubt": [float(about[part].mean()) for part in bins],
        "error": [float(share[part].mean()) for part in bins],
        "gain": [],
    }
    if len(found) == 2:
        later = found[1][1][seen] / size[seen]
        row["gain"] = [float(1 - later[part].sum() / share[part].sum()) for part in bins]
    return {name: [float(f"{value:.4g}") for value in values] for name, values in row.items()}
