"""Head of a report: the command, commit and inputs that it was made from, as a block of TOML, and the report's age.

`python -m edge.bench.provenance` prints a line for each report: fresh, or stale, where an input that it names, a model,
a set or one of the few sources, is gone or has changed.
"""

import argparse
import ast
import hashlib
import json
import os
import platform
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, fields
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

import numpy as np
import onnxruntime

ROOT: Final = Path(__file__).resolve().parents[2]  # folder of the packages: the checkout's, where there is one
UNKNOWN: Final = "unknown"
_BLOCK: Final = re.compile(r"^```toml\n(command = .*?)^```\n", re.DOTALL | re.MULTILINE)


@dataclass(frozen=True, slots=True)
class Provenance:
    """Provenance of a report: how it was made, and the hash of each model or set and each source."""

    command: str
    date: str
    commit: str
    tree: str  # "clean" or "changed" since the commit
    machine: str
    seed: int | None  # None where each source has its own
    models: dict[str, str]
    sources: dict[str, str]

    def __str__(self) -> str:
        """Return the block of TOML that stands at the head of the page."""
        lines = ["```toml"]
        for key, value in asdict(self).items():
            if isinstance(value, dict):
                lines += ["", f"[{key}]", *(f"{json.dumps(path)} = {json.dumps(value[path])}" for path in value)]
            elif value is not None:
                lines.append(f"{key} = {json.dumps(value)}")
        return "\n".join([*lines, "```"])

    def stale(self) -> Iterator[str]:
        """Yield why the report is stale; nothing where it is fresh."""
        for name, before in {**self.models, **self.sources}.items():
            if not (ROOT / name).exists():
                yield f"{name} is not here"
            elif file_hash(ROOT / name) != before:
                yield f"{name} has changed"


def provenance(
    command: str, sources: Sequence[str | Path], models: Iterable[Path] = (), seed: int | None = None
) -> Provenance:
    """Return the head of a report that is being made; its sources are those by which its figures would change."""
    changes = _git("status", "--porcelain", "--untracked-files=no", "--", ".", ":!reports")
    return Provenance(
        command=command,
        date=datetime.now(UTC).isoformat(timespec="seconds"),
        commit=_git("rev-parse", "--short=10", "HEAD") or UNKNOWN,
        tree=UNKNOWN if changes is None else "changed" if changes else "clean",
        machine=this_machine(),
        seed=seed,
        models={_below_root(path): file_hash(path) for path in sorted({path.resolve() for path in models})},
        sources={_below_root(ROOT / source): file_hash(ROOT / source) for source in sources},
    )


def read_provenance(page: str) -> Provenance | None:
    """Return the head of a page, or None where it has none that can be read."""
    block = _BLOCK.search(page)
    if block is None:
        return None
    try:
        values: dict[str, Any] = {"seed": None, "models": {}, "sources": {}} | tomllib.loads(block[1])
        return Provenance(**{field.name: values[field.name] for field in fields(Provenance)})
    except (tomllib.TOMLDecodeError, KeyError):
        return None


def with_head(page: str, made: Provenance) -> str:
    """Return a page with the head below its title."""
    title, _, rest = page.partition("\n")
    return f"{title}\n\n{made}\n{rest}"


def this_machine() -> str:
    """Return what run times depend on: processor, cores and versions."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return (
        f"{_cpu()}, {platform.machine()}, {cores} of {os.cpu_count() or 1} cores, "
        f"Python {platform.python_version()}, numpy {np.__version__}, onnxruntime {onnxruntime.__version__}"
    )


def _cpu() -> str:
    """Return the model name of the processor; on ARM, where /proc/cpuinfo has none, the board's name."""
    for path, pattern in (("/proc/cpuinfo", r"^model name\s*:\s*(.+)$"), ("/proc/device-tree/model", r"^([^\0]+)")):
        with suppress(OSError):
            if match := re.search(pattern, Path(path).read_text(errors="replace"), re.MULTILINE):
                return match[1].strip()
    return platform.processor() or "unknown CPU"


def file_hash(path: Path) -> str:
    """Return a hash of a file, or of all Python files below a folder; of Python it is that of the code alone."""
    files = sorted(path.rglob("*.py")) if path.is_dir() else [path]
    return hashlib.sha256(b"".join(map(_content, files))).hexdigest()[:12]


def _content(file: Path) -> bytes:
    """Return the bytes of a file; of Python without comments, docstrings and imports, by which no figure changes."""
    if file.suffix != ".py":
        return file.read_bytes()
    tree = ast.parse(file.read_bytes())
    for node in ast.walk(tree):
        if isinstance(body := getattr(node, "body", None), list):
            body[:] = [statement for statement in body if not _is_aside(statement)] or [ast.Pass()]
    return ast.unparse(tree).encode()


def _is_aside(node: ast.AST) -> bool:
    is_text = isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
    return is_text or isinstance(node, (ast.Import, ast.ImportFrom))


def _below_root(path: Path) -> str:
    path = path.resolve()
    return path.relative_to(ROOT).as_posix() if path.is_relative_to(ROOT) else path.name


def _git(*arguments: str) -> str | None:
    """Return the output of git in ROOT; None outside a checkout, without git, or where it refuses."""
    try:
        done = subprocess.run(["git", "-C", ROOT, *arguments], capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return None
    return done.stdout.strip()


def main(arguments: list[str] | None = None) -> None:
    """Print a line for each report of a folder and those in it."""
    parser = argparse.ArgumentParser(description="List the reports: fresh, or stale and why.")
    parser.add_argument("folder", type=Path, nargs="?", default=ROOT / "reports", help="default: reports")
    folder: Path = parser.parse_args(arguments).folder
    for path in sorted(folder.rglob("*.md")):
        made = read_provenance(path.read_text(encoding="utf-8"))
        verdict = "no head: make it again with its command"
        if made is not None:
            why = "; ".join(made.stale())
            verdict = f"stale, of {made.date[:10]} ({made.commit}): {why}" if why else f"fresh ({made.commit})"
        sys.stdout.write(f"{path.relative_to(folder).as_posix()}: {verdict}\n")


if __name__ == "__main__":
    main()
