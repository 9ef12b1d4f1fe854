"""Reports know their age: what stands at their head, and when it is out of date."""

from dataclasses import replace
from pathlib import Path

import pytest
from edge_samples import ROOT

from edge.bench import provenance as reports
from edge.bench.provenance import UNKNOWN, file_hash, provenance, read_provenance, with_head
from edge.inference.bundled import DEFAULT_MODEL, find_model

SOURCE = "edge/bench/errors.py"


@pytest.fixture(scope="module")
def made():
    return provenance('python x.py --out "a b"', [ROOT / SOURCE, "edge/bench"], [find_model(DEFAULT_MODEL)], seed=3)


def listed(folder: Path, made, capsys, name="mine.md"):
    (folder / name).parent.mkdir(exist_ok=True)
    (folder / name).write_text(with_head("# mine\n\nWhat was measured.\n", made))
    reports.main([str(folder)])
    return capsys.readouterr().out


def test_a_head_is_read_as_it_was_written(made):
    page = with_head("# mine\n\nText.\n", made)
    assert page.startswith("# mine\n\n```toml\ncommand = ") and page.endswith("```\n\nText.\n")
    assert read_provenance(page) == made
    bare = replace(made, seed=None, models={})
    assert read_provenance(with_head("# b\n", bare)) == bare


def test_a_head_names_commit_seed_and_the_hashes_of_its_inputs(made):
    assert made.sources == {name: file_hash(ROOT / name) for name in (SOURCE, "edge/bench")} and made.seed == 3
    assert made.models == {f"edge/models/{DEFAULT_MODEL}.onnx": file_hash(find_model(DEFAULT_MODEL))}
    assert made.tree in {"clean", "changed", UNKNOWN} and len(set(made.sources.values())) == 2


@pytest.mark.parametrize(
    "page", ["# no head\n", "# a\n\n```toml\ncommand = \n```\n", '# a\n\n```toml\ncommand = "x"\n```\n']
)
def test_a_head_that_lacks_or_is_damaged_is_none(page):
    assert read_provenance(page) is None


def test_a_report_just_made_is_fresh(made, tmp_path, capsys):
    assert listed(tmp_path, made, capsys) == f"mine.md: fresh ({made.commit})\n"


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"models": {"README.md": "0" * 12}}, "README.md has changed"),
        ({"models": {"gone.onnx": "0" * 12}}, "gone.onnx is not here"),
        ({"sources": {SOURCE: "0" * 12}}, f"{SOURCE} has changed"),
        ({"sources": {"gone.py": "0" * 12}}, "gone.py is not here"),
        ({"sources": {SOURCE: UNKNOWN}}, f"of {SOURCE} no hash was kept"),
    ],
)
def test_a_report_is_stale_and_the_line_says_why(made, tmp_path, capsys, change, why):
    line = listed(tmp_path, replace(made, **change), capsys, "load/mine.md")
    assert line == f"load/mine.md: stale, of {made.date[:10]} ({made.commit}): {why}\n"


def test_a_report_without_a_head_is_named(tmp_path, capsys):
    (tmp_path / "old.md").write_text("# old\n")
    reports.main([str(tmp_path)])
    assert capsys.readouterr().out == "old.md: no head: make it again with its command\n"


def test_every_report_has_a_head():
    pages = sorted((ROOT / "reports").rglob("*.md"))
    assert [page.name for page in pages if read_provenance(page.read_text()) is None] == []
    assert len(pages) > 5
