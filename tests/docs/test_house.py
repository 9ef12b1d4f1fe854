"""House rules of the tree: few modules at a root, one meaning of a file name, no long file."""

import subprocess
from collections import Counter
from pathlib import Path

import pytest
from edge_samples import ROOT

PACKAGES = ("firmware_bridge", "edge", "train", "export")
MOST_ROOT_MODULES = 10
MOST_LINES = 400
OF_A_ROOM = {"__init__.py", "__main__.py", "command.py", "options.py", "errors.py", "base.py", "sink.py"}
"""Names that mean the same in every room."""
SOURCES = {".py", ".js", ".css", ".html"}
LONG: set[str] = set()
"""Files that are longer all the same; keep this empty."""


def sources() -> list[Path]:
    names = subprocess.run(
        ["git", "ls-files", "--cached", "--others", "--exclude-standard"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    ).stdout.splitlines()
    return [Path(name) for name in names if Path(name).suffix in SOURCES and (ROOT / name).is_file()]


@pytest.mark.parametrize("package", PACKAGES)
def test_no_root_of_a_package_has_more_than_ten_modules(package):
    modules = [path.name for path in (ROOT / package).glob("*.py") if path.name != "__init__.py"]
    assert len(modules) <= MOST_ROOT_MODULES, sorted(modules)


@pytest.mark.parametrize("package", (*PACKAGES, "tests"))
def test_no_file_name_of_a_package_stands_for_two_things(package):
    names = Counter(path.name for path in sources() if path.parts[0] == package)
    assert {name for name, count in names.items() if count > 1} - OF_A_ROOM == set()


def test_no_file_is_of_four_hundred_lines_or_more():
    long = {str(path) for path in sources() if len((ROOT / path).read_bytes().splitlines()) >= MOST_LINES}
    assert long == LONG
