"""Head of a report: the command, commit and models that it was made from, as a block of TOML, and the report's age.

    python -m edge.bench.provenance

prints a line for each report: fresh, or stale and why. A report is stale where a model or set that it names has
changed, or a source that it names is gone or has changed since its commit. It is a list and not a gate: exit code 0.
"""

import argparse
import hashlib
import json
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, fields
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

from edge.bench.machine import this_machine

ROOT: Final = Path(__file__).resolve().parents[2]
"""Folder of the packages: the checkout's, where there is one."""
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
        sources: files that make it, below ROOT.
        models: file below ROOT -> hash, of each model or frozen set it used.
    """

    command: str
    date: str
    commit: str
    tree: str
    machine: str
    seed: int | None
    sources: tuple[str, ...]
    models: dict[str, str]

    def __str__(self) -> str:
        """Return the block of TOML that stands at the head of the page."""
        keys = {key: value for key, value in asdict(self).items() if key != "models" and value is not None}
        lines = [f"{key} = {json.dumps(value)}" for key, value in keys.items()]
        lines += ["", "[models]", *(f"{json.dumps(path)} = {json.dumps(value)}" for path, value in self.models.items())]
        return "\n".join(["```toml", *(lines if self.models else lines[:-2]), "```"])

    def stale(self) -> Iterator[str]:
        """Yield why the report is stale; nothing where it is fresh."""
        for name, before in self.models.items():
            if not (ROOT / name).exists():
                yield f"{name} is not here, so whether it has changed is unknown"
            elif file_hash(ROOT / name) != before:
                yield f"{name} has changed"
        yield from (f"{name} is gone" for name in self.sources if not (ROOT / name).exists())
        names = _git("diff", "--name-only", self.commit, "--", *self.sources)
        if names is None:
            yield f"commit {self.commit} is not here, so whether its sources have changed is unknown"
        yield from (f"{name} has changed" for name in (names or "").splitlines() if (ROOT / name).exists())


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
    changes = _git("status", "--porcelain", "--untracked-files=no", "--", ".", ":!reports")
    return Provenance(
        command=command,
        date=datetime.now(UTC).isoformat(timespec="seconds"),
        commit=_git("rev-parse", "--short=10", "HEAD") or UNKNOWN,
        tree=UNKNOWN if changes is None else "changed" if changes else "clean",
        machine=this_machine(),
        seed=seed,
        sources=tuple(_below_root(Path(source)) for source in sources),
        models={_below_root(path): file_hash(path) for path in sorted({path.resolve() for path in models})},
    )


def read_provenance(page: str) -> Provenance | None:
    """Return the head of a page, or None where it has none that can be read."""
    block = _BLOCK.search(page)
    if block is None:
        return None
    try:
        values: dict[str, Any] = {"seed": None, "models": {}} | tomllib.loads(block[1])
        values["sources"] = tuple(values["sources"])
        return Provenance(**{field.name: values[field.name] for field in fields(Provenance)})
    except (tomllib.TOMLDecodeError, KeyError, TypeError):
        return None


def with_head(page: str, made: Provenance) -> str:
    """Return a page with the head below its title."""
    title, _, rest = page.partition("\n")
    return f"{title}\n\n{made}\n{rest}"


def file_hash(path: Path) -> str:
    """Return a hash of a file's bytes."""
    return hashlib.sha256(path.read_bytes()).hexdigest()[:DIGITS]


def _below_root(path: Path) -> str:
    path = (path if path.is_absolute() else ROOT / path).resolve()
    return path.relative_to(ROOT).as_posix() if path.is_relative_to(ROOT) else path.name


def _git(*arguments: str) -> str | None:
    """Return the output of git in ROOT; None outside a checkout, without git, or where it refuses."""
    try:
        done = subprocess.run(["git", "-C", ROOT, *arguments], capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return None
    return done.stdout.strip()


def lines(folder: Path) -> Iterator[str]:
    """Yield one line per report of a folder and those in it."""
    for path in sorted(folder.rglob("*.md")):
        made = read_provenance(path.read_text(encoding="utf-8"))
        name = path.relative_to(folder).as_posix()
        if made is None:
            yield f"{name}: no head: make it again with its command"
        elif why := "; ".join(made.stale()):
            yield f"{name}: stale, of {made.date[:10]} ({made.commit}): {why}"
        else:
            yield f"{name}: fresh ({made.commit})"


def main(arguments: list[str] | None = None) -> None:
    """Run the command line."""
    summary = "List the reports: fresh, or stale and why."
    parser = argparse.ArgumentParser(prog="python -m edge.bench.provenance", description=summary)
    parser.add_argument(
        "folder", type=Path, nargs="?", default=ROOT / "reports", help="folder of the reports (default: reports)"
    )
    for text in lines(parser.parse_args(arguments).folder):
        sys.stdout.write(f"{text}\n")


if __name__ == "__main__":
    main()
