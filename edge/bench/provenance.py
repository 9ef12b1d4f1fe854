"""Head of a report: the command, commit, models and sources that it was made from, as a block of TOML."""

import ast
import hashlib
import json
import re
import subprocess
import tomllib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from typing import Any, Final

from edge.bench.machine import this_machine

ROOT: Final = Path(__file__).resolve().parents[2]
"""Folder of the packages: the checkout's, where there is one."""
SEARCHED: Final = ("", "tests/support/", "tests/system/")
"""Folders that modules are imported from, below ROOT."""
FOR_SHOW: Final = ("edge/terminal/", "edge/bench/live_report.py", "edge/bench/provenance.py")
"""Files and folders that show progress or write the page: no figure depends on them."""
DIGITS: Final = 12
"""Number of digits kept of a SHA-256."""
UNKNOWN: Final = "unknown"

_BLOCK: Final = re.compile(r"^```toml\n(command = .*?)^```\n", re.DOTALL | re.MULTILINE)


@dataclass(frozen=True, slots=True)
class Provenance:
    """Provenance of a report.

    Attributes:
        command: that makes it.
        date: ISO 8601, UTC.
        commit: checked out meanwhile, or UNKNOWN outside a checkout.
        tree: "clean", "changed" since that commit, or a note on the origin of the commit's id.
        machine: processor, cores and versions.
        seed: of all chance, or None where each source has its own.
        sources: files that make it, below ROOT; the files that they import count, too.
        code: hash of these sources and the files that they import, see `code_hash`.
        models: file below ROOT -> hash, of each model or frozen set it used.
    """

    command: str
    date: str
    commit: str
    tree: str
    machine: str
    seed: int | None
    sources: tuple[str, ...]
    code: str
    models: dict[str, str]

    def __str__(self) -> str:
        """Return the block of TOML that stands at the head of the page."""
        keys = {key: value for key, value in asdict(self).items() if key != "models" and value is not None}
        lines = [f"{key} = {json.dumps(value)}" for key, value in keys.items()]
        lines += ["", "[models]", *(f"{json.dumps(path)} = {json.dumps(value)}" for path, value in self.models.items())]
        return "\n".join(["```toml", *(lines if self.models else lines[:-2]), "```"])


def provenance(
    command: str, sources: Sequence[str | Path], models: Iterable[Path] = (), seed: int | None = None
) -> Provenance:
    """Return the head of a report that is being made.

    Args:
        command: that makes it.
        sources: files that make it, below ROOT.
        models: files of models and frozen sets that it uses.
        seed: of all chance.
    """
    names = tuple(_below_root(Path(source)) for source in sources)
    changes = _git("status", "--porcelain", "--untracked-files=no", "--", ".", ":!reports")
    return Provenance(
        command=command,
        date=datetime.now(UTC).isoformat(timespec="seconds"),
        commit=_git("rev-parse", "--short=10", "HEAD") or UNKNOWN,
        tree=UNKNOWN if changes is None else "changed" if changes else "clean",
        machine=str(this_machine()),
        seed=seed,
        sources=names,
        code=code_hash(imported_sources(names)),
        models={_below_root(path): file_hash(path) for path in sorted({path.resolve() for path in models})},
    )


def read_provenance(page: str) -> Provenance | None:
    """Return the head of a page, or None where it has none that can be read."""
    block = _BLOCK.search(page)
    if block is None:
        return None
    try:
        values: dict[str, Any] = {"seed": None, "models": {}}
        values |= tomllib.loads(block[1])
        values["sources"] = tuple(values["sources"])
        return Provenance(**values)
    except (tomllib.TOMLDecodeError, KeyError, TypeError):
        return None


def with_head(page: str, made: Provenance) -> str:
    """Return a page with the head below its title."""
    title, _, rest = page.partition("\n")
    return f"{title}\n\n{made}\n{rest}"


def read_source(path: str) -> str | None:
    """Return the text of a file below ROOT, or None where there is none."""
    try:
        return (ROOT / path).read_text(encoding="utf-8")
    except FileNotFoundError:
        return None


def imported_sources(entries: Sequence[str], read: Callable[[str], str | None] = read_source) -> dict[str, str]:
    """Return the entries and the files of this repository that they import themselves, not FOR_SHOW: path -> text.

    Not what those import in turn: nearly every report reaches nearly every module that way, and all would be out of
    date at any change. A report that depends on more names it among its sources.

    Args:
        entries: files below ROOT.
        read: text of a file below ROOT, None where there is none.
    """
    sources = {path: text for path in entries if (text := read(path)) is not None}
    imported = {module for text in sources.values() for module in _imports(text)}
    paths = sorted(f"{folder}{module}" for module in imported for folder in SEARCHED)
    return sources | {
        path: text for path in paths if not path.startswith(FOR_SHOW) and (text := read(path)) is not None
    }


def code_hash(sources: Mapping[str, str]) -> str:
    """Return a hash of path -> source that comments, docstrings and layout do not change."""
    codes = {path: _code(text) for path, text in sources.items()}
    return _hash(json.dumps(sorted(codes.items())).encode())


def file_hash(path: Path) -> str:
    """Return a hash of a file's bytes."""
    return _hash(path.read_bytes())


def changed_files(commit: str, paths: Iterable[str]) -> list[str]:
    """Return those of the files that differ from a commit's; an empty list where git or the commit lacks."""
    names = _git("diff", "--name-only", commit, "--")
    return sorted(set(paths) & set((names or "").splitlines()))


@cache  # reports share most of their sources
def _imports(text: str) -> frozenset[str]:
    """Return the files that the imports of a source may stand for; a name from a package may be a module, too."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module is not None:
            names |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
    paths = {name.replace(".", "/") for name in names}
    return frozenset({f"{path}.py" for path in paths} | {f"{path}/__init__.py" for path in paths})


@cache
def _code(text: str) -> str:
    """Return a source as its syntax alone, without the texts that are statements of their own."""
    tree = ast.parse(text)
    for node in ast.walk(tree):
        if isinstance(body := getattr(node, "body", None), list):
            node.body = [one for one in body if not _is_text(one)] or [ast.Pass()]  # type: ignore[attr-defined]
    return ast.unparse(tree)  # ast.dump differs from one Python to the next


def _is_text(node: ast.stmt) -> bool:
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)


def _hash(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()[:DIGITS]


def _below_root(path: Path) -> str:
    path = (path if path.is_absolute() else ROOT / path).resolve()
    return path.relative_to(ROOT).as_posix() if path.is_relative_to(ROOT) else path.name


def _git(*arguments: str) -> str | None:
    """Return the output of git in ROOT; None outside a checkout, or without git."""
    try:
        done = subprocess.run(["git", "-C", ROOT, *arguments], capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return None
    return done.stdout.strip()
