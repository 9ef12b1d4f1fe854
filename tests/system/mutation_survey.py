"""Change the pure modules in one place at a time, and count the changes that their unit tests notice.

    python tests/system/mutation_survey.py --out reports/mutation.md
    python tests/system/mutation_survey.py slcan drift --mutants 30 --seed 2

Each mutant runs in a process forked after numpy, pytest and hypothesis have been imported, against the test files of
its module, up to the first failure. One that takes three times the processor time of the code unchanged is noticed,
too.
"""

import argparse
import ast
import gc
import importlib.abc
import importlib.machinery
import importlib.util
import math
import os
import random
import resource
import shlex
import signal
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import CodeType, ModuleType

import hypothesis
import numpy as np  # noqa: F401  imported once, before the processes are forked
import pytest
from mutants import Mutant, compiled, mutants

from edge.bench.provenance import provenance

ROOT = Path(__file__).parents[2]
SLOWER = 3
LEAST_LIMIT_S = 4.0
STUCK_S = 300
MEMORY_BYTES = 8 << 30
WANTED = 0.95


_TEXT = (
    "Each mutant is the module with one change: a comparison, an operator, a condition, a number, a result, or a "
    "statement that is left out; texts, annotations and what errors are raised with stay. It is noticed where a test "
    "of the module's own test files fails, or takes far too long. Possible: all changes of the module; tried: those "
    "drawn by chance, less those that behave as the code does, which are listed beside the survey with their reasons."
)


@dataclass(frozen=True, slots=True)
class Subject:
    """A module and its unit tests: files, and other arguments of pytest."""

    module: str
    tests: tuple[str, ...]

    @property
    def path(self) -> Path:
        """The module's file."""
        return ROOT / (self.module.replace(".", "/") + ".py")


SUBJECTS = {
    "slcan": Subject("firmware_bridge.can.slcan", ("tests/bridge/test_slcan.py",)),
    "gs_usb": Subject("firmware_bridge.can.gs_usb", ("tests/bridge/test_gs_usb.py",)),
    "assembler": Subject(
        "firmware_bridge.scans.scan_assembler",
        (
            "tests/bridge/test_scan_assembler.py",
            "tests/bridge/test_slcan_scans.py",
            "tests/bridge/test_cycles.py",
        ),
    ),
    "taps": Subject(
        "edge.perception.taps",
        ("tests/runtime/test_taps.py", "tests/runtime/test_pose_runtime.py", "tests/runtime/test_baseline_doubt.py"),
    ),
    "baseline": Subject("firmware_bridge.zeroing.baseline", ("tests/bridge/test_baseline.py",)),
    "drift": Subject("firmware_bridge.zeroing.drift_tracker", ("tests/bridge/test_drift.py",)),
    "contract": Subject(
        "edge.inference.contract",
        ("tests/runtime/test_contract.py", "tests/bridge/test_pad.py", "tests/runtime/test_session.py"),
    ),
}

EQUIVALENT: dict[str, dict[str, str]] = {
    "assembler": {
        "_end_of_run: self._taxels and self._gap_ns(time_ns, own_ns, at) > wire.pause_ns -> "
        "self._taxels or self._gap_ns(time_ns, own_ns, at) > wire.pause_ns": "readings are judged one by one instead",
        "_close: 1 -> 2": "seventeen are missing behind a scan, and the most that is given out is sixteen",
    },
    "taps": {
        "__init__: -1 -> 1": "before a pattern there is no pose, whatever the number of its tap",
        "_choose: 0.0 -> 1.0": "a tap alone has no turn, whatever the step of the schedule",
        "_choose: earlier.away_mm(other, self._radius_mm) < 0.5 -> earlier.away_mm(other, self._radius_mm) <= 0.5": (
            "no tap lies half a millimetre away to the last digit"
        ),
    },
    "baseline": {
        "deformation: signed.min() >= -half -> signed.min() > -half": "the slower way gives the same",
        "deformation: signed += half -> signed -= half": "a turn apart, of which the remainder is taken",
        "refuse_load: 0 -> 1": "one count of a taxel that is unknown in either is below the limit",
        "save_baselines: 1 -> 2": "the blanks before a line of the file",
    },
    "drift": {
        "push: 1000000000.0 -> 1000000001.0": "seconds that are off by a billionth",
        "push: return False -> return None": "its caller asks for nothing but whether it is true",
        "_step_note: counts > 0 -> counts >= 0": "a step that is named has more than seven counts",
    },
}
"""Mutants by subject that behave as the code does, each with the reason; left out of the score."""


@dataclass(frozen=True, slots=True)
class Score:
    """Outcome of one module's mutants."""

    subject: str
    possible: int
    noticed: int
    survivors: tuple[Mutant, ...]

    @property
    def tried(self) -> int:
        """Mutants that were tried."""
        return self.noticed + len(self.survivors)


class _InPlaceOf(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Importer of a module with other code than its file's."""

    def __init__(self, subject: Subject, code: CodeType) -> None:
        self._subject, self._code = subject, code

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> importlib.machinery.ModuleSpec | None:
        if fullname != self._subject.module:
            return None
        return importlib.util.spec_from_file_location(fullname, self._subject.path, loader=self)

    def create_module(self, spec: importlib.machinery.ModuleSpec) -> None:
        return None

    def exec_module(self, module: ModuleType) -> None:
        exec(self._code, module.__dict__)


def passes(subject: Subject, code: CodeType, limit_s: int) -> tuple[bool, float]:
    """Return if the module's tests pass with this code in so much processor time, and the time they took in [s]."""
    gc.freeze()
    child = os.fork()
    if child == 0:
        _run_tests(subject, code, limit_s)
    ends = time.monotonic() + STUCK_S
    while time.monotonic() < ends:
        ended, status, usage = os.wait4(child, os.WNOHANG)
        if ended:
            return status == 0, usage.ru_utime + usage.ru_stime
        time.sleep(0.01)
    os.killpg(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return False, math.inf


def _run_tests(subject: Subject, code: CodeType, limit_s: int) -> None:
    """Run them and end this process."""
    status = 1
    try:
        os.setsid()
        resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES))
        resource.setrlimit(resource.RLIMIT_CPU, (limit_s, limit_s))  # whatever else the machine does
        silence = os.open(os.devnull, os.O_RDWR)
        for descriptor in (0, 1, 2):
            os.dup2(silence, descriptor)
        # The same examples for each mutant; a failing one is not made smaller.
        phases = (hypothesis.Phase.explicit, hypothesis.Phase.generate)
        hypothesis.settings.register_profile("survey", derandomize=True, database=None, phases=phases, deadline=None)
        hypothesis.settings.load_profile("survey")
        sys.meta_path.insert(0, _InPlaceOf(subject, code))
        status = pytest.main(["-x", "-n", "0", "-p", "no:cacheprovider", *subject.tests])
    finally:
        os._exit(int(status))


def survey(name: str, most: int, seed: int) -> Score:
    """Try a module's mutants, at most so many, drawn by chance.

    Raises:
        SystemExit: the tests fail on the code as it is.
    """
    subject = SUBJECTS[name]
    tree = ast.parse(subject.path.read_text(encoding="utf-8"))
    passed, taken_s = passes(subject, compile(tree, str(subject.path), "exec"), STUCK_S)
    if not passed:
        sys.exit(f"{name}: the tests fail on the code unchanged: run {' '.join(subject.tests)}")
    limit_s = math.ceil(max(LEAST_LIMIT_S, SLOWER * taken_s))
    possible = mutants(tree)
    drawn = random.Random(seed).sample(possible, min(most, len(possible)))
    drawn = [mutant for mutant in drawn if mutant.name not in EQUIVALENT.get(name, {})]
    survivors = []
    for mutant in drawn:
        if passes(subject, compiled(tree, mutant, str(subject.path)), limit_s)[0]:
            survivors.append(mutant)
            sys.stderr.write(f"{name}:{mutant.line} {mutant.name}\n")
    survivors.sort(key=lambda mutant: mutant.line)
    return Score(name, len(possible), len(drawn) - len(survivors), tuple(survivors))


def page(scores: Sequence[Score], seed: int) -> str:
    """Return the report."""
    names = [score.subject for score in scores]
    tests = [path for name in names for path in SUBJECTS[name].tests]
    command = shlex.join(["python", "tests/system/mutation_survey.py", *sys.argv[1:]])
    lines = ["# Mutation", "", str(provenance(command, [__file__, *tests], seed=seed)), "", _TEXT, ""]
    lines += ["| module | possible | tried | noticed | score |", "|---|---|---|---|---|"]
    lines += [
        f"| {SUBJECTS[score.subject].module} | {score.possible} | {score.tried} | {score.noticed} "
        f"| {100 * score.noticed / score.tried:.1f} % |"
        for score in scores
    ]
    noticed, tried = (sum(getattr(score, key) for score in scores) for key in ("noticed", "tried"))
    lines += ["", f"Together {noticed} of {tried}, {100 * noticed / tried:.1f} %; {100 * WANTED:.0f} % are wanted.", ""]
    for score in scores:
        if score.survivors:
            lines += [f"## Survivors in {SUBJECTS[score.subject].module}", ""]
            lines += [f"- line {mutant.line}, `{mutant.name}`" for mutant in score.survivors] + [""]
    return "\n".join(lines).rstrip() + "\n"


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("names", nargs="*", choices=[*SUBJECTS, []], metavar="MODULE", help=", ".join(SUBJECTS))
    parser.add_argument("--mutants", type=int, default=60, help="the most of each module (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=1, help="by which they are drawn (default: %(default)s)")
    parser.add_argument("--out", type=Path, help="report (default: on stdout)")
    options = parser.parse_args(arguments)
    os.chdir(ROOT)
    scores: list[Score] = []
    text = ""
    for name in options.names or SUBJECTS:
        scores.append(survey(name, options.mutants, options.seed))
        text = page(scores, options.seed)
        if options.out is not None:  # what has been surveyed is kept where the run is broken off
            options.out.write_text(text, encoding="utf-8")
    if options.out is None:
        sys.stdout.write(text)


if __name__ == "__main__":
    main()
