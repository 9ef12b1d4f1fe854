"""`--budget-us`: calibrate a model and its alternatives on this machine, and choose one that fits the budget."""

import threading
from collections.abc import Callable
from pathlib import Path
from typing import Final

from edge.budgeting.model_choice import Candidate, choose
from edge.budgeting.run_time_cache import CalibrationCache
from edge.budgeting.run_times import ROUND_TICKS, ROUNDS, RunTime, calibrate
from edge.errors import ModelError
from edge.inference.bundled import alternatives, bundled_models
from edge.inference.expected_error import is_number
from edge.inference.onnx_session import ModelSession
from edge.perception.result import age_text

USUAL_RATE_HZ: Final = 100.0
UNEVEN: Final = 3.0
"""Ratio of 99th percentile to median from which run times are uneven, 1.2 to 1.4 on a quiet machine. Figures of a busy
one hold now, but not for months."""


def choose_model(
    model: Path,
    budget_us: float,
    *,
    rate_hz: float,
    cache: Path | None,
    recalibrate: bool,
    stop: threading.Event,
    tell: Callable[[str], object],
) -> ModelSession | None:
    """Load a model and its alternatives, and return the one that run times measured on this machine choose.

    Args:
        model: file of the requested model.
        budget_us: longest run time of a pattern, in [us].
        rate_hz: rate of the sensor, in [Hz].
        cache: file of stored run times; None stores nothing.
        recalibrate: measure again although stored run times exist.
        stop: event that ends the measurement early.
        tell: called with one line each about what is measured, what is wrong and which model was chosen.

    Returns:
        The loaded model, or None if it was stopped.

    Raises:
        ModelError: the model cannot be used, or its contract does not state its error.
    """
    sessions = candidate_sessions(model, tell, stop)
    kept = CalibrationCache(cache, rate_hz)
    found = {} if recalibrate else {path: entry for path in sessions if (entry := kept.find(path)) is not None}
    missing = {path: session for path, session in sessions.items() if path not in found}
    run_times = {path: run_time for path, (run_time, _) in found.items()}
    if missing:
        names = ", ".join(session.name for session in missing.values())
        tell(f"calibrating {names}: {ROUNDS * ROUND_TICKS} patterns each at {rate_hz:g} Hz")
        measured = calibrate(list(missing.values()), rate_hz, stop=stop)
        if measured is None:
            return None
        fresh = dict(zip(missing, measured, strict=True))
        uneven = {path for path, run_time in fresh.items() if run_time.p99_us > UNEVEN * run_time.p50_us}
        kept.keep({path: run_time for path, run_time in fresh.items() if path not in uneven})
        run_times |= fresh
        if uneven:
            names = ", ".join(sorted(path.stem for path in uneven))
            tell(f"run times of {names} are uneven, as on a busy machine, and are not kept")
    for note in kept.notes:
        tell(note)
    choice = choose([_candidate(session, run_times[path]) for path, session in sessions.items()], budget_us)
    age = f" (calibrated {age_text(max(age_s for _, age_s in found.values()))} ago)" if found else ""
    tell(f"{'' if choice.fits else 'warning: '}{choice.why}{age}")
    return next(session for session in sessions.values() if session.name == choice.name)


def candidate_sessions(
    model: Path, tell: Callable[[str], object], stop: threading.Event | None = None
) -> dict[Path, ModelSession]:
    """Load a model and all that may replace it, by file: patterns of one meaning, no more taps, a stated error.

    An int8 model was requested to save time, so float32 does not replace it. An int8 file next to a model's file that
    does not fit is reported; of the bundled models most do not fit.

    Raises:
        ModelError: the model cannot be used, or does not state its error.
    """
    asked = ModelSession(model, stop=stop)
    _psnr_db(asked)
    bundled = model.resolve() in bundled_models()
    sessions = {model: asked}
    for path in alternatives(model):
        try:
            session = ModelSession(path, stop=stop)
            misfit = _misfit(session, asked)
        except ModelError as error:
            misfit = str(error)
        else:
            if misfit is None:
                sessions[path] = session
        if misfit is not None and not bundled:
            tell(f"{path} is left out: {misfit}")
    return sessions


def _misfit(session: ModelSession, asked: ModelSession) -> str | None:
    """Return or raise the reason why a model cannot replace the requested one; None if it can."""
    contract, wanted = session.contract, asked.contract
    contract.check_stands_in(wanted)
    if contract.taps > wanted.taps:
        return f"it takes {contract.taps} taps, '{asked.name}' only {wanted.taps}"
    if contract.arithmetic != wanted.arithmetic == "int8":
        return f"its arithmetic is {contract.arithmetic}, that of '{asked.name}' {wanted.arithmetic}"
    if contract.test_set_sha256 != wanted.test_set_sha256:
        return f"its error is of another test set than that of '{asked.name}': export both again"
    _psnr_db(session)
    return None


def _candidate(session: ModelSession, run_time: RunTime) -> Candidate:
    return Candidate(session.name, _psnr_db(session), run_time.p50_us, run_time.p99_us)


def _psnr_db(session: ModelSession) -> float:
    """Return the PSNR on the frozen test set with all taps in the window, in [dB]."""
    taps, errors = session.contract.taps, session.contract.test_error
    psnr_db = errors.get(str(taps), {}).get("psnr_db")
    if not is_number(psnr_db):
        got = f"model '{session.name}': contract key 'test_error' is {repr(errors)[:200]}"
        raise ModelError(f"{got}, expected a psnr_db for {taps} taps, which --budget-us chooses by: export it again")
    return psnr_db
