"""Stiff and extreme cases, as one table; the exit code is 1 where a row is broken.

python -m export.stability --out reports

Two parts: the bundled graphs (no touch, denormals, presses beyond any sensor, soft and stiff pads, one and several
threads), and the program from raw counts to records (saturated, wrapped, absent and single taxels).
"""

import argparse
import sys
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from edge.api import infer
from edge.errors import UsageError, WindowError
from edge.inference.bundled import DEFAULT_MODEL, POSED_MODEL, bundled_models, find_model
from edge.inference.contract import Contract
from edge.inference.intervals import doubt
from edge.inference.onnx_session import ModelSession
from edge.perception.trust_check import PatternCheck
from edge.terminal.progress_bar import tracked
from export.parity import FULL_RANGE_COUNTS, extreme_windows
from firmware_bridge.pad_geometry import USPA44
from firmware_bridge.scans.pad_constants import Pad
from firmware_bridge.scans.scan import ABSENT
from train.errors import ended_by_errors
from train.physics.pad_draws import RANGES
from train.report import Report, Row

INT8_BEYOND: Final = 1.05
"""Largest difference of int8 from itself on windows beyond any touch, where it saturates, as a share of the pattern."""
TOUCHES: Final = ("press", "press x 1e-06", "press x 0.001")
NO_TOUCH: Final = ("zeros", "denormals", "a count in one taxel", "press x 1e-06")
MOST_MM: Final = 5.0  # bound of a pattern and its deviation in a record: the pad is 4.5 mm thick
THREADS: Final = 4
TOGETHER: Final = 16
LARGEST: Final = 65_535
PRESS: Final = 3000
FREE_SCANS, TOUCHED_SCANS, KEPT_SCANS = 30, 40, 10
"""Scans of the free pad and of the case; a taxel's last reading is kept for a few scans."""


class Case(NamedTuple):
    """One row of the table: a stiff or extreme input, the measured quantity and its upper bound.

    Where the case must be refused the value is None, and `note` the error; else it may hold the states of the records.
    """

    name: str
    what: str
    value: float | None
    most: float
    note: str = ""
    model: str = ""

    @property
    def holds(self) -> bool:
        """True within the bound, which NaN never is, or if refused."""
        return bool(self.note) if self.value is None else self.value <= self.most

    def cells(self) -> Row:
        """Return the case as cells of a table."""
        verdict = ("refused" if self.value is None else "holds") if self.holds else "BROKEN"
        cells: Row = {"case": self.name, "measured": self.what, "value": self.value, "at most": self.most}
        return cells | {"model": self.model, "verdict": verdict, "note": self.note}


def refused(name: str, work: Callable[[], object], by: type[Exception], model: str = "") -> Case:
    """Return a case that must end in an error; broken if it does not."""
    try:
        work()
    except by as error:
        return Case(name, "refused", None, 0.0, str(error), model)
    return Case(name, "refused", float("nan"), 0.0, f"expected {by.__name__}, but there was none", model)


def graph_cases() -> Iterator[Case]:
    """Yield the cases of every bundled graph, through the session of the runtime."""
    for path in bundled_models():
        one, several = ModelSession(path), ModelSession(path, threads=THREADS)
        given = windows(one.contract)
        for name, window in given.items():
            yield from _graph(name, window, one, several)
        for name, pad in pads(one.contract).items():
            size_mm = largest(one.run(given["press"], one.contract.pad_row(pad)), one.deviation)
            yield Case(name, "largest, mm", size_mm, MOST_MM, model=path.stem)
    for model in (DEFAULT_MODEL, POSED_MODEL):
        session = ModelSession(find_model(model))
        good = windows(session.contract)["press"]
        for bad in (np.nan, np.inf, -np.inf):
            spoiled = good.copy()
            spoiled[0, 2, 1, 1] = bad
            yield refused(f"{bad} in one place", partial(session.run, spoiled), WindowError, model)


def windows(contract: Contract) -> Mapping[str, NDArray[np.float32]]:
    """Return windows (K, 3, rows, cols) in network units by name, from no touch to beyond any sensor."""
    shape = (contract.taps, *USPA44.scan_shape)
    press, tangential = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    press[:, 2, 1:3, 1:3] = PRESS
    tangential[:, :2] = FULL_RANGE_COUNTS
    rows, cols = np.indices(shape[2:])
    opposite = np.broadcast_to(np.where((rows + cols) % 2, -1, 1), shape) * np.float32(PRESS)
    counts = {f"press x {scale:g}": press * np.float32(scale) for scale in (1e-6, 1e-3, 1e3, 1e6)}
    counts |= {"press": press, "tangential alone, full range": tangential, "neighbours opposite": opposite}
    counts["earlier taps opposite"] = press * np.where(np.arange(shape[0]) % 2, -1, 1)[:, None, None, None]
    made = {name: contract.scale_window(values.astype(np.float32)) for name, values in counts.items()}
    return made | {name: window.reshape(shape) for name, window in extreme_windows(contract).items()}


def pads(contract: Contract) -> Mapping[str, Pad]:
    """Return the softest and the stiffest pad of the training, of the constants that a model takes."""
    names = [name for name, *_ in contract.pad_inputs]
    soft: dict[str, Any] = {name: RANGES[name][name == "thickness_mm"] for name in names}
    stiff: dict[str, Any] = {name: RANGES[name][name != "thickness_mm"] for name in names}
    return {"the softest pad": Pad(**soft), "the stiffest pad": Pad(**stiff)} if names else {}


def _graph(name: str, window: NDArray[np.float32], one: ModelSession, several: ModelSession) -> Iterator[Case]:
    pattern = one.run(window).copy()
    size_mm, full_scale = largest(pattern, one.deviation), one.contract.output_full_scale
    size, touch = float(np.abs(pattern).max()), name in TOUCHES or name.endswith("taps")
    extreme = name in extreme_windows(one.contract)
    if extreme and not touch and name not in NO_TOUCH and (trust := one.contract.read_trust()):
        about = None if one.deviation is None else doubt(pattern, one.deviation)[0]
        verdict = PatternCheck(trust, one.contract).judge(0, window[0], pattern, about, one.traction, 0)
        yield Case(name, "believed", float(verdict.trusted is True), 0.0, model=one.name)
    strength = max(1.0, float(np.abs(window).max()))  # patterns grow with the readings: no bound beyond them
    yield Case(name, "largest over the largest reading, mm", size_mm / strength, MOST_MM, model=one.name)
    spread = float(np.abs(several.run(window) - pattern).max())
    together = one.run_together([window] * TOGETHER)
    spread = max(spread, float(np.abs(together - pattern).max()))
    # Beyond any touch a last bit may move int8 by whole steps.
    most = 1e-5 if touch or one.contract.arithmetic == "float32" else INT8_BEYOND
    what = f"{THREADS} threads and {TOGETHER} windows, to one"
    yield Case(name, what, spread / max(size, full_scale), most, model=one.name)


def largest(pattern: NDArray[np.float32], deviation: NDArray[np.float32] | None) -> float:
    """Return the largest value of both; NaN unless all are finite and every deviation is above 0."""
    maps = [pattern] if deviation is None else [pattern, deviation]
    sure = all(np.isfinite(one).all() for one in maps) and (deviation is None or bool((deviation > 0).all()))
    return max(float(np.abs(one).max()) for one in maps) if sure else float("nan")


def program_cases() -> Iterator[Case]:
    """Yield the cases of raw counts, through edge.api, by the default model and the one for poses."""
    for model in (DEFAULT_MODEL, POSED_MODEL):
        session = ModelSession(find_model(model))
        for name, (raw, patterns) in scans().items():
            yield played(name, session, raw, patterns)
        for rest in (0, 1, LARGEST - 1, LARGEST):
            yield resting(f"free pad at {rest}, wraps by noise", session, rest)
        wrong = np.full((1, *USPA44.scan_shape), np.nan)
        yield refused("NaN counts", partial(infer, session, wrong, _free(1)), UsageError, model)


def scans() -> Mapping[str, tuple[NDArray[np.int32], bool]]:
    """Return raw scans by name, as a broken chip or bus may send them, and whether patterns may be made of them."""
    rest = _free(1)[0]
    rows, cols = np.indices(rest.shape[1:])
    names: dict[str, tuple[NDArray[np.int32], bool]] = {"a press": (_pressed_raw(PRESS), True)}
    names["a press of 26000 counts in every taxel"] = (rest + np.array([0, 0, 26_000])[:, None, None], True)
    names["tangential alone, 15000 counts"] = (rest + np.array([15_000, -15_000, 0])[:, None, None], True)
    one = rest.copy()
    one[2, 3, 3] += PRESS
    absent, wild = _pressed_raw(PRESS), _pressed_raw(PRESS)
    absent[:, 0, 0], wild[:, 0, 0] = ABSENT, LARGEST
    names |= {"one taxel": (one, True), "a chip sends nothing": (absent, True), "a chip at its end": (wild, True)}
    names["neighbours at both ends"] = (np.where((rows + cols) % 2, 0, LARGEST) + 0 * rest, False)
    return names | {"all at zero": (0 * rest, False), "all at the largest": (0 * rest + LARGEST, False)}


def played(name: str, model: ModelSession, raw: NDArray[np.int32], patterns: bool) -> Case:
    """Return the case of a scan that stays, after a free pad: bounded, and without a pattern where nothing is known."""
    noise = np.arange(TOUCHED_SCANS)[:, None, None, None] % 2  # a taxel without noise is stuck
    touched = np.where((raw <= 0) | (raw == LARGEST), raw, raw + noise)  # a saturated one has none, nor an absent one
    results = infer(model, np.concatenate([_free(FREE_SCANS), touched]), _free(FREE_SCANS))[FREE_SCANS:]
    made = [(result.pattern, result.deviation) for result in results[KEPT_SCANS:] if result.pattern is not None]
    states = ", ".join(dict.fromkeys(result.state for result in results))
    if not patterns:
        return Case(name, "patterns made of it", float(len(made)), 0.0, states, model.name)
    sizes = [largest(pattern, deviation) for pattern, deviation in made]
    return Case(name, "largest in a record, mm", float(np.max(sizes, initial=0.0)), MOST_MM, states, model.name)


def resting(name: str, model: ModelSession, rest: int) -> Case:
    """Return the case of a free pad whose taxels rest where 16 bits wrap around: every scan must be idle."""
    noise = np.arange(TOUCHED_SCANS)[:, None, None, None] % 2
    counts = (np.full((TOUCHED_SCANS, *USPA44.scan_shape), rest) + noise) % (LARGEST + 1)
    states = [result.state for result in infer(model, counts, np.full((1, *USPA44.scan_shape), rest))]
    return Case(name, "scans that are not idle", float(len(states) - states.count("idle")), 0.0, model=model.name)


def _free(count: int) -> NDArray[np.int32]:
    rest = np.array([16_000, 16_400, 38_600], dtype=np.int32)[:, None, None]
    return np.broadcast_to(rest, (count, *USPA44.scan_shape)) + (np.arange(count) % 2)[:, None, None, None]


def _pressed_raw(counts: int) -> NDArray[np.int32]:
    raw = _free(1)[0]
    raw[2, 1:3, 1:3] += counts
    return raw


PARTS: Final[Mapping[str, Callable[[], Iterator[Case]]]] = {
    "Bundled graphs": graph_cases,
    "From raw counts to records": program_cases,
}


def worst(cases: list[Case]) -> list[Case]:
    """Return, of rows that differ in the model alone, those that are broken, or else the one nearest to its bound."""
    kept: list[Case] = []
    for key in dict.fromkeys((case.name, case.what, case.most) for case in cases):
        same = [case for case in cases if (case.name, case.what, case.most) == key]
        kept += [case for case in same if not case.holds] or [max(same, key=lambda case: case.value or 0.0)]
    return kept


def run(folder: Path, parts: Mapping[str, Callable[[], Iterator[Case]]] = PARTS) -> list[Case]:
    """Write the report `stability`, and return the rows that are broken."""
    report = Report("stability", folder, __file__, [find_model(path.stem) for path in bundled_models()])
    cases = {part: list(work()) for part, work in tracked(parts.items(), "stability", "part")}
    every = [case for same in cases.values() for case in same]
    broken = [case for case in every if not case.holds]
    report.say(
        f"{len(every)} rows, {sum(case.value is None for case in every)} of them refused by a clear error; "
        f"{len(broken)} are broken. A value that is not a number is broken, whatever its bound. Of the models the one "
        "that is nearest to its bound is shown."
    )
    for part, same in cases.items():
        report.table([case.cells() for case in worst(same)], f"## {part}")
    report.write()
    return broken


def main(arguments: list[str] | None = None) -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(prog="python -m export.stability", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("reports"), help="folder of the report (default: reports)")
    options: Any = parser.parse_args(arguments)
    with ended_by_errors("stability"):
        broken = run(options.out)
    sys.stdout.write(f"{options.out / 'stability.md'}\n")
    if broken:
        names = "\n".join(f"  {case.name}, {case.what}: {case.value}, at most {case.most}" for case in broken)
        sys.exit(f"stability: {len(broken)} rows are broken:\n{names}")


if __name__ == "__main__":
    main()
