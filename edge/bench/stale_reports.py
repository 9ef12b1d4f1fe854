"""List the reports: fresh, or stale and why.

python -m edge.bench.stale_reports

A report is stale where a model that it names, a file that makes it, or a file that one of these imports has changed
since; comments and docstrings do not count. It is a list and not a gate: exit code 0.
"""

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from edge.bench.provenance import (
    ROOT,
    Provenance,
    changed_files,
    code_hash,
    file_hash,
    imported_sources,
    read_provenance,
)

_NAMED: Final = 3
"""Most changed files that a line names; the others are counted."""


def reasons(made: Provenance) -> Iterator[str]:
    """Yield why a report with this head is stale; nothing where it is fresh."""
    for name in made.models:
        if not (ROOT / name).exists():
            yield f"{name} is not here, so whether it has changed is unknown"
    present = {name: before for name, before in made.models.items() if (ROOT / name).exists()}
    if changed := [name for name, before in present.items() if file_hash(ROOT / name) != before]:
        yield f"models have changed: {_some(changed)}"
    sources = imported_sources(made.sources)
    for name in made.sources:
        if name not in sources:
            yield f"{name} is gone"
    if code_hash(sources) != made.code:
        files = changed_files(made.commit, sources)
        unknown = f"which files is unknown, as commit {made.commit} cannot be compared"
        yield f"code has changed: {_some(files) if files else unknown}"


def _some(files: list[str]) -> str:
    """Return the first of the files, and how many more there are."""
    more = f" and {len(files) - _NAMED} more" if len(files) > _NAMED else ""
    return f"{', '.join(files[:_NAMED])}{more}"


def lines(folder: Path) -> Iterator[str]:
    """Yield one line per report of a folder and those in it."""
    for path in sorted(folder.rglob("*.md")):
        made = read_provenance(path.read_text(encoding="utf-8"))
        name = path.relative_to(folder).as_posix()
        if made is None:
            yield f"{name}: no head: make it again with its command"
        elif why := "; ".join(reasons(made)):
            yield f"{name}: stale, of {made.date[:10]} ({made.commit}): {why}"
        else:
            yield f"{name}: fresh ({made.commit})"


def main(arguments: list[str] | None = None) -> None:
    """Run the command line."""
    summary = (__doc__ or "").splitlines()[0]
    parser = argparse.ArgumentParser(prog="python -m edge.bench.stale_reports", description=summary)
    parser.add_argument(
        "folder", type=Path, nargs="?", default=ROOT / "reports", help="folder of the reports (default: reports)"
    )
    for line in lines(parser.parse_args(arguments).folder):
        sys.stdout.write(f"{line}\n")


if __name__ == "__main__":
    main()
