"""House rules of the tree: few modules at a root, one meaning of a file name, no long file, and a checked English."""

import ast
import importlib.util
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


_SPEC = importlib.util.spec_from_file_location("plain_english", ROOT / ".ci" / "plain_english.py")
assert _SPEC is not None and _SPEC.loader is not None
plain_english = importlib.util.module_from_spec(_SPEC)
_SPEC.loader.exec_module(plain_english)


def shown(source):
    return [text for _, text in plain_english.strings(ast.parse(source))]


@pytest.mark.parametrize(
    "planted", ["no scan was heard yet", "no sensor is told apart", "If none is dead, measured anew."]
)
def test_a_planted_word_of_the_dialect_is_seen_in_shown_text(planted):
    assert shown(f"raise UsageError({planted!r})") == [planted]
    assert plain_english.shown_dialect(planted)


@pytest.mark.parametrize("package", PACKAGES)
def test_a_class_has_a_name_of_its_own(package):
    names = Counter(
        node.name
        for path in (ROOT / package).rglob("*.py")
        for node in ast.parse(path.read_text()).body
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_")
    )
    assert [name for name, count in names.items() if count > 1] == []
