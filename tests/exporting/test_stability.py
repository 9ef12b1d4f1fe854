"""The table of stiff and extreme cases: every row holds, and what is broken ends the command."""

import pytest

from export import stability
from export.stability import Case, refused


def test_every_row_holds(tmp_path, capsys):
    stability.main(["--out", str(tmp_path)])
    assert capsys.readouterr().out.endswith("stability.md\n")
    page = (tmp_path / "stability.md").read_text()
    assert "0 are broken" in page and "BROKEN" not in page
    for part in stability.PARTS:
        assert page.split(f"## {part}\n", 1)[1].partition("## ")[0].count("\n| ") > 10


@pytest.mark.parametrize(
    ("value", "note", "holds"),
    [(1e-3, "", True), (1.1e-3, "", False), (float("nan"), "", False), (None, "", False), (None, "no", True)],
)
def test_what_is_not_within_its_bound_is_broken(value, note, holds):
    made = Case("press", "error", value, 1e-3, note)
    assert made.holds is holds and (made.cells()["verdict"] == "BROKEN") is not holds


def test_a_guard_that_is_gone_is_broken():
    assert refused("press", lambda: [].remove(1), ValueError).holds
    assert not refused("press", lambda: None, ValueError).holds


def test_a_broken_row_is_shown_and_returned(tmp_path):
    cases = [Case("press", "error", 2.0, 1.0, model="a"), Case("press", "error", 0.5, 1.0, model="b")]
    assert stability.run(tmp_path, {"part": lambda: iter(cases)}) == cases[:1]
    assert (tmp_path / "stability.md").read_text().count("BROKEN") == 1
