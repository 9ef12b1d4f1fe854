"""The page of the architecture is true of imports, files, names and values; files are short.

The documentation builds strictly as a site, so all links lead somewhere, and fetches nothing from elsewhere.
"""

import ast
import re
import subprocess
from collections import Counter
from functools import cache
from itertools import permutations
from pathlib import Path
from urllib.parse import urldefrag

import grimp
import pytest
from edge_samples import ROOT
from mkdocs.commands.build import build
from mkdocs.config import load_config

PACKAGES = ("export", "train", "edge", "firmware_bridge")
WITH_ROOMS = ("edge", "firmware_bridge")
PAGE = (ROOT / "docs" / "architecture.md").read_text()
DRAWING = PAGE.partition("```text\n")[2].partition("```")[0].splitlines()
STEPS, QUESTIONS = (re.findall(start, PAGE, re.MULTILINE) for start in (r"^\d+\. .*(?:\n  .*)*", r"^\| .*`.*"))


def drawn():
    """Return packages and rooms from the top, as package or package.room, and the arrows between them."""
    places, arrows = [], []
    for line in DRAWING:
        left, _, led_to = line.partition("-> ")
        if names := left.partition(":")[0].split() if ":" in left else left.split()[:1]:
            package = places[-1].partition(".")[0] if left.startswith(" ") else ""
            places += [f"{package}.{name}".lstrip(".") for name in names]
        package = f"{places[-1].partition('.')[0]}." if "." in places[-1] else ""
        arrows += [(places[-1], package + name) for name in led_to.split()]
    return places, arrows


def imported():
    """Return packages and rooms that there are, and the arrows that imports make."""
    graph = grimp.build_graph(*PACKAGES, cache_dir=None)
    floors = [PACKAGES, *map(graph.find_children, WITH_ROOMS)]
    pairs = [pair for floor in floors for pair in permutations(floor, 2)]
    arrows = [
        pair for pair in pairs if graph.direct_import_exists(importer=pair[0], imported=pair[1], as_packages=True)
    ]
    return {place for floor in floors for place in floor}, arrows


def test_the_page_draws_each_room_and_each_import_and_no_other():
    (places, arrows), (there, made) = drawn(), imported()
    assert sorted(places) == sorted(there)
    assert sorted(arrows) == sorted(made)
    assert [arrow for arrow in arrows if places.index(arrow[0]) > places.index(arrow[1])] == []  # all lead down


@cache
def inside(path):
    """Return the names in a file, the methods of its classes, and the values that it assigns at its top level."""
    tree = ast.parse((ROOT / path).read_text())
    names = {getattr(node, key, None) for node in ast.walk(tree) for key in ("name", "id")}
    classes = [node for node in tree.body if isinstance(node, ast.ClassDef)]
    methods = {f"{one.name}.{part.name}" for one in classes for part in one.body if isinstance(part, ast.FunctionDef)}
    return names, methods, {node.target.id: node.value for node in tree.body if isinstance(node, ast.AnnAssign)}


@cache
def all_methods():
    return {method for package in PACKAGES for path in (ROOT / package).rglob("*.py") for method in inside(path)[1]}


@pytest.mark.parametrize("text", STEPS + QUESTIONS)
def test_each_file_is_there_with_what_is_named_after_it(text):
    path = None
    for word in re.findall(r"`([^`\n]+)`", text):
        name, equals, value = word.partition(" = ")
        if "/" in word:
            assert (ROOT / word).exists(), word
            path = word
        elif equals:
            assert ast.literal_eval(inside(path)[2][name]) == ast.literal_eval(value), f"{path}: {word}"
        elif re.fullmatch(r"\w+(\.\w+)?", word):
            assert word.partition(".")[0] in inside(path)[0], f"{path}: {word}"
            assert "." not in word or word in all_methods(), f"{path}: {word}"


def test_twenty_steps_and_every_row_of_the_index_are_read():
    assert (len(STEPS), len(QUESTIONS)) == (20, PAGE.partition("| question")[2].count("\n|") - 1)


MOST_LINES = 400
SOURCES = {".py", ".js", ".css", ".html"}


def test_no_file_is_of_four_hundred_lines_or_more():
    command = ["git", "ls-files", "--cached", "--others", "--exclude-standard"]
    names = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout.splitlines()
    files = [ROOT / name for name in names if Path(name).suffix in SOURCES and (ROOT / name).is_file()]
    assert [path.name for path in files if len(path.read_bytes().splitlines()) >= MOST_LINES] == []


LONGER = {  # in files by whose code reports/mutation.md is stale
    "test_another_name_or_type_and_a_lack_of_a_contract_are_refused",
}


def test_no_name_of_a_test_is_of_more_than_sixty_characters():
    names = {name or "" for path in (ROOT / "tests").rglob("test_*.py") for name in inside(path)[0]}
    assert {name for name in names if name.startswith("test_") and len(name) > 60} == LONGER


@pytest.mark.parametrize("package", PACKAGES)
def test_a_class_has_a_name_of_its_own(package):
    found = (node for path in (ROOT / package).rglob("*.py") for node in ast.parse(path.read_text()).body)
    names = Counter(one.name for one in found if isinstance(one, ast.ClassDef) and not one.name.startswith("_"))
    assert [name for name, count in names.items() if count > 1] == []


FETCHING = re.compile(r"<(?:img|script|link|iframe|source|video|object)\b[^>]*>")
ELSEWHERE = re.compile(r"\b(?:src|href|data)=[\"']?(?:\w+:)?//|(?:url\(|@import)\s*[\"']?(?:https?:)?//")


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("site")
    build(load_config(str(ROOT / "mkdocs.yml"), site_dir=str(folder), strict=True))
    return folder


def test_the_first_page_and_the_reports_are_there(site):
    for page in ("index.html", "trouble.html", "reports/families.html", "decisions.html"):
        assert (site / page).is_file(), page
    assert not list(site.rglob("*.py"))
    assert "<code>echo 1 | sudo tee /sys/" in (site / "trouble.html").read_text()


def test_nothing_is_fetched_from_elsewhere(site):
    for path in (*site.rglob("*.html"), *site.rglob("*.css")):
        text = path.read_text(encoding="utf-8")
        parts = FETCHING.findall(text) if path.suffix == ".html" else [text]
        assert [one for one in parts if ELSEWHERE.search(one) and "canonical" not in one] == [], path.name


def test_what_links_of_the_repository_lead_to_is_there():
    for page in (ROOT / "README.md", *(ROOT / "docs").glob("*.md")):
        for address in re.findall(r"\]\(([^)\s]+)\)", page.read_text(encoding="utf-8")):
            address, _ = urldefrag(address)
            if address and not re.match(r"\w+:", address):
                assert (page.parent / address).exists(), f"{page.name} leads to {address}"
