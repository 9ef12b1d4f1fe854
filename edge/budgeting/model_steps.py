"""`--budget-us`: the models that may take turns, loaded and calibrated, and who changes them while it runs."""

import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from edge.budgeting.model_choice import Candidate, Choice, choose
from edge.budgeting.run_time_cache import CalibrationCache
from edge.budgeting.run_times import ROUND_TICKS, ROUNDS, RunTime, calibrate
from edge.budgeting.step_rule import Governor
from edge.errors import ModelError
from edge.inference.bundled import alternatives, bundled_models
from edge.inference.expected_error import is_number
from edge.inference.onnx_session import ModelSession
from edge.perception.result import Result, age_text
from edge.perception.runtime import Model, Runtime
from edge.pipeline.sink import Sink
from firmware_bridge.schedule import Clock

USUAL_RATE_HZ: Final = 100.0
UNEVEN: Final = 3.0
"""99th percentile over median, 1.2 to 1.4 on a quiet machine. What a busy one gives holds for now, not for months."""


@dataclass(frozen=True, slots=True)
class Ladder:
    """Models that may take turns, loaded, so that a step costs nothing.

    Attributes:
        choice: the rungs, and which of them to begin with.
        budget_us: longest run time of a pattern, in [us].
        models: by name, one for each rung.
    """

    choice: Choice
    budget_us: float
    models: Mapping[str, Model]

    @property
    def model(self) -> Model:
        """The one to begin with."""
        return self.models[self.choice.ladder[self.choice.rung].name]

    @property
    def most_taps(self) -> int:
        """Taps that the largest of them takes."""
        return max(model.contract.taps for model in self.models.values())

    def steps(self, runtime: Runtime) -> Sink:
        """What changes the runtime's model between results; give it every one."""
        return ModelSteps(self, runtime)


class ModelSteps(Sink):
    """Hears of every pattern, and changes the runtime's model when the governor says so.

    It is a sink because that is where results are heard, one by one and between scans.
    """

    def __init__(self, ladder: Ladder, runtime: Runtime, clock_ns: Clock = time.monotonic_ns) -> None:
        """Start with the model chosen; the runtime's first result will tell why.

        Args:
            ladder: whose models take turns.
            runtime: whose model is changed.
            clock_ns: monotonic, in [ns].
        """
        self._governor = Governor(ladder.choice.ladder, ladder.choice.rung, ladder.budget_us)
        self._models = ladder.models
        self._runtime = runtime
        self._clock_ns = clock_ns
        runtime.change_model(ladder.model, ladder.choice.why)

    def write(self, result: Result, counters: Mapping[str, int]) -> None:
        """Hear of one result; one without a pattern, or of a model that is not on any more, tells nothing."""
        if result.run_time_us is None or result.model != self._governor.present.name:
            return
        step = self._governor.watch(self._clock_ns(), result.run_time_us)
        if step is not None:
            self._runtime.change_model(self._models[self._governor.present.name], step.why)

    def close(self) -> None:
        """Nothing to finish."""


def open_ladder(
    model: Path,
    budget_us: float,
    *,
    rate_hz: float,
    cache: Path | None,
    recalibrate: bool,
    stop: threading.Event,
    tell: Callable[[str], object],
) -> Ladder | None:
    """Load a model and what may stand in for it, and choose by run times measured here, now or at an earlier start.

    Args:
        model: file of the one asked for.
        budget_us: longest run time of a pattern, in [us].
        rate_hz: of the sensor, in [Hz].
        cache: file that run times are kept in; None keeps nothing.
        recalibrate: measure anew what is kept.
        stop: gives up early.
        tell: hears, a line each, what is done, what is wrong and what was chosen.

    Returns:
        The ladder, or None if it was stopped.

    Raises:
        ModelError: the model cannot be used, or does not tell its error.
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
    names = {candidate.name for candidate in choice.ladder}
    return Ladder(choice, budget_us, {one.name: one for one in sessions.values() if one.name in names})


def candidate_sessions(
    model: Path, tell: Callable[[str], object], stop: threading.Event | None = None
) -> dict[Path, ModelSession]:
    """A model and all that may stand in for it, by file: patterns of the same meaning, no more taps, error known.

    A model in integers was asked for to save time, so float32 does not stand in for it. What lies beside a file as its
    integers and does not fit is told; among the bundled ones most do not.

    Raises:
        ModelError: the model cannot be used, or does not tell its error.
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
    """Why one does not stand in for the other, told or raised; None if it does."""
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
    """On the frozen test set with all taps given, in [dB]."""
    taps, errors = session.contract.taps, session.contract.test_error
    psnr_db = errors.get(str(taps), {}).get("psnr_db")
    if not is_number(psnr_db):
        got = f"model '{session.name}': contract key 'test_error' is {repr(errors)[:200]}"
        raise ModelError(f"{got}, expected a psnr_db for {taps} taps, which --budget-us chooses by: export it again")
    return psnr_db
