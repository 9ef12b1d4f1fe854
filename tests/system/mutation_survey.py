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
import importlib.util
import math
import os
import random
import resource
import shlex
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import CodeType
from typing import Any, NamedTuple

import hypothesis
import numpy as np  # noqa: F401  imported once, before the processes are forked
import pytest

from edge.bench.provenance import provenance

ROOT = Path(__file__).parents[2]
SLOWER = 3
LEAST_LIMIT_S = 4.0
UNCHANGED_S = 300
MEMORY_BYTES = 8 << 30
WANTED = 0.95

PAIRS = (
    *((ast.Lt, ast.LtE), (ast.Gt, ast.GtE), (ast.Eq, ast.NotEq), (ast.Is, ast.IsNot), (ast.In, ast.NotIn)),
    *((ast.Add, ast.Sub), (ast.Mult, ast.Div), (ast.LShift, ast.RShift), (ast.BitAnd, ast.BitOr), (ast.And, ast.Or)),
)
OTHERS = {before: after for pair in PAIRS for before, after in (pair, pair[::-1])}
OTHERS |= {ast.FloorDiv: ast.Mult, ast.Mod: ast.Mult, ast.Pow: ast.Mult, ast.BitXor: ast.BitAnd}
TWINS = {"min": "max", "max": "min", "any": "all", "all": "any"}
"""Functions and methods that are taken for each other."""
_TEXT = (
    "Each mutant is the module with one change: a comparison, an operator, a condition, a number, a result, or a "
    "statement that is left out; texts, annotations and what errors are raised with stay. It is noticed where a test "
    "of the module's own test files fails, or takes far too long. Possible: all changes of the module; tried: those "
    "drawn by chance, less those that behave as the code does, which are listed beside the survey with their reasons."
)
SUBJECTS = {
    "slcan": ("firmware_bridge.can.slcan", ("tests/bridge/test_slcan.py",)),
    "gs_usb": ("firmware_bridge.can.gs_usb", ("tests/bridge/test_gs_usb.py",)),
    "assembler": (
        "firmware_bridge.scans.scan_assembler",
        ("tests/bridge/test_scan_assembler.py", "tests/bridge/test_slcan_scans.py", "tests/bridge/test_cycles.py"),
    ),
    "taps": (
        "edge.perception.taps",
        ("tests/runtime/test_taps.py", "tests/runtime/test_pose_runtime.py", "tests/runtime/test_baseline_doubt.py"),
    ),
    "baseline": ("firmware_bridge.zeroing.baseline", ("tests/bridge/test_baseline.py",)),
    "drift": ("firmware_bridge.zeroing.drift_tracker", ("tests/bridge/test_drift.py",)),
    "contract": (
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


class Mutant(NamedTuple):
    """One change of a syntax tree."""

    name: str  # "function or constant: code before -> code after", the same wherever that stands in its file
    line: int
    siblings: Any  # list, or attributes of a node, of which one is changed
    place: str | int  # which
    changed: ast.AST  # what comes there

    def compiled(self, tree: ast.Module, path: Path) -> CodeType:
        """Return the code of its tree with this change, which does not last."""
        before, self.siblings[self.place] = self.siblings[self.place], self.changed
        try:
            return compile(ast.fix_missing_locations(tree), path, "exec")
        finally:
            self.siblings[self.place] = before


def mutants(node: ast.AST, function: str = "module") -> Iterator[Mutant]:
    """Yield all changes below a node.

    Texts are left as they are, and so are annotations, decorators and what an error is raised with: unit tests rightly
    do not hold every word.
    """
    if isinstance(node, ast.FunctionDef | ast.ClassDef):
        function = node.name
    elif function == "module" and isinstance(node, ast.Assign | ast.AnnAssign):
        function = ast.unparse(node.target if isinstance(node, ast.AnnAssign) else node.targets[0])
    if isinstance(node, ast.Raise | ast.JoinedStr):
        return
    for field, value in ast.iter_fields(node):
        if field in {"annotation", "returns", "decorator_list"}:
            continue
        siblings, places = (value, range(len(value))) if isinstance(value, list) else (vars(node), [field])
        for place in places:
            child = siblings[place]
            if isinstance(child, ast.expr | ast.stmt):
                for changed in changes(child):
                    before, after = (ast.unparse(ast.fix_missing_locations(one)) for one in (child, changed))
                    name = f"{function}: {before.splitlines()[0]} -> {after.splitlines()[0]}"
                    yield Mutant(name, child.lineno, siblings, place, changed)
            if isinstance(child, ast.AST):
                yield from mutants(child, function)


def changes(node: ast.expr | ast.stmt) -> Iterator[ast.AST]:
    """Yield what may come in place of a node: nothing, another value, or the same with another part."""

    def with_other(**parts: Any) -> ast.AST:
        return type(node)(**(dict(ast.iter_fields(node)) | parts))

    match node:
        case ast.Constant(value=bool(value)):
            yield ast.Constant(not value)
        case ast.Constant(value=int(value)) | ast.Constant(value=float(value)):
            yield ast.Constant(value + 1)
        case ast.Constant(value=bytes(value)) if value:
            yield ast.Constant(b"?" + value[1:])
        case ast.UnaryOp(op=ast.Not() | ast.USub() | ast.Invert(), operand=operand):
            yield operand
        case ast.Return(value=ast.expr() as value) if not (isinstance(value, ast.Constant) and value.value is None):
            yield ast.Return(ast.Constant(None))
        case ast.Expr(value=ast.Call()) | ast.AugAssign() | ast.Raise() | ast.Continue() | ast.Break():
            yield ast.Pass()
        case ast.Assign(targets=[ast.Attribute() | ast.Subscript()]):
            yield ast.Pass()
    match node:
        case ast.Compare(ops=ops):
            for index, operator in enumerate(ops):
                yield with_other(ops=[*ops[:index], OTHERS[type(operator)](), *ops[index + 1 :]])
        case ast.BinOp(op=operator) | ast.AugAssign(op=operator) | ast.BoolOp(op=operator) if type(operator) in OTHERS:
            yield with_other(op=OTHERS[type(operator)]())
        case ast.If(test=test) | ast.While(test=test) | ast.IfExp(test=test):
            yield with_other(test=ast.UnaryOp(ast.Not(), test))
        case ast.Call(func=ast.Name(id=name)) if name in TWINS:
            yield with_other(func=ast.Name(TWINS[name], ast.Load()))
        case ast.Call(func=ast.Attribute(value=value, attr=name)) if name in TWINS:
            yield with_other(func=ast.Attribute(value, TWINS[name], ast.Load()))


Score = tuple[str, int, int, list[Mutant]]  # module, number of possible and of tried mutants, and those that survived


def passes(subject: str, code: CodeType, limit_s: int) -> tuple[bool, float]:
    """Return if the module's tests pass with this code in so much processor time, and the time they took in [s]."""
    gc.freeze()
    child = os.fork()
    if child == 0:
        _run_tests(*SUBJECTS[subject], code, limit_s)
    _, status, usage = os.wait4(child, 0)  # of a test that waits for ever, pytest itself makes an end
    return status == 0, usage.ru_utime + usage.ru_stime


def _run_tests(name: str, tests: Sequence[str], code: CodeType, limit_s: int) -> None:
    """Run the tests of a module that is made of this code, and end this process."""
    status = 1
    try:
        resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES))
        resource.setrlimit(resource.RLIMIT_CPU, (limit_s, limit_s))  # whatever else the machine does
        silence = os.open(os.devnull, os.O_RDWR)
        for descriptor in (0, 1, 2):
            os.dup2(silence, descriptor)
        # The same examples for each mutant; a failing one is not made smaller.
        phases = (hypothesis.Phase.explicit, hypothesis.Phase.generate)
        hypothesis.settings.register_profile("survey", derandomize=True, database=None, phases=phases, deadline=None)
        hypothesis.settings.load_profile("survey")
        spec = importlib.util.find_spec(name)
        module = sys.modules[name] = importlib.util.module_from_spec(spec)
        setattr(sys.modules[spec.parent], name.rpartition(".")[2], module)
        exec(code, vars(module))
        status = pytest.main(["-x", "-n", "0", "-p", "no:cacheprovider", *tests])
    finally:
        os._exit(int(status))


def survey(name: str, most: int, seed: int) -> Score:
    """Try a module's mutants, at most so many, drawn by chance; end where its tests fail on the code as it is."""
    module, tests = SUBJECTS[name]
    path = ROOT / (module.replace(".", "/") + ".py")
    tree = ast.parse(path.read_text(encoding="utf-8"))
    passed, taken_s = passes(name, compile(tree, path, "exec"), UNCHANGED_S)
    if not passed:
        sys.exit(f"{name}: the tests fail on the code unchanged: run {' '.join(tests)}")
    limit_s = math.ceil(max(LEAST_LIMIT_S, SLOWER * taken_s))
    possible = sorted(mutants(tree), key=lambda mutant: mutant.line)
    drawn = random.Random(seed).sample(possible, min(most, len(possible)))
    drawn = [mutant for mutant in drawn if mutant.name not in EQUIVALENT.get(name, {})]
    survivors = []
    for mutant in drawn:
        if passes(name, mutant.compiled(tree, path), limit_s)[0]:
            survivors.append(mutant)
            sys.stderr.write(f"{name}:{mutant.line} {mutant.name}\n")
    return module, len(possible), len(drawn), sorted(survivors, key=lambda mutant: mutant.line)


def page(names: Sequence[str], scores: Sequence[Score], seed: int) -> str:
    """Return the report."""
    tests = [path for name in names for path in SUBJECTS[name][1]]
    command = shlex.join(["python", "tests/system/mutation_survey.py", *sys.argv[1:]])
    lines = ["# Mutation", "", str(provenance(command, [__file__, *tests], seed=seed)), "", _TEXT, ""]
    lines += ["| module | possible | tried | noticed | score |", "|---|---|---|---|---|"]
    for module, possible, tried, survivors in scores:
        noticed = tried - len(survivors)
        lines.append(f"| {module} | {possible} | {tried} | {noticed} | {100 * noticed / tried:.1f} % |")
    tried = sum(tried for *_, tried, _ in scores)
    noticed = tried - sum(len(survivors) for *_, survivors in scores)
    lines += ["", f"Together {noticed} of {tried}, {100 * noticed / tried:.1f} %; {100 * WANTED:.0f} % are wanted.", ""]
    for module, *_, survivors in scores:
        if survivors:
            lines += [f"## Survivors in {module}", ""]
            lines += [f"- line {mutant.line}, `{mutant.name}`" for mutant in survivors] + [""]
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
    names, scores, text = options.names or [*SUBJECTS], list[Score](), ""
    for name in names:
        scores.append(survey(name, options.mutants, options.seed))
        text = page(names[: len(scores)], scores, options.seed)
        if options.out is not None:  # what has been surveyed is kept where the run is broken off
            options.out.write_text(text, encoding="utf-8")
    if options.out is None:
        sys.stdout.write(text)


if __name__ == "__main__":
    main()
