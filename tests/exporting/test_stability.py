"""The table of stiff and extreme cases: every row holds, and what is broken ends the command."""

import pytest

from export import stability
from export.stability import Case
from train.physics.elastic_layer import Layer


def test_every_row_holds(tmp_path, capsys):
    stability.main(["--out", str(tmp_path)])
    assert capsys.readouterr().out.endswith("stability.md\n")
    page = (tmp_path / "stability.md").read_text()
    assert "0 are broken" in page and "BROKEN" not in page
    for part in stability.PARTS:
        assert page.split(f"## {part}\n", 1)[1].partition("## ")[0].count("\n| ") > 10


@pytest.mark.parametrize(
    ("value", "holds"),
    [(1e-3, True), (1.1e-3, False), (float("nan"), False)],
)
def test_what_is_not_within_its_bound_is_broken(value, holds):
    made = Case("press", "error", value, 1e-3)
    assert made.holds is holds and (made.cells()["verdict"] == "BROKEN") is not holds


def test_a_broken_row_ends_the_command_with_its_name(tmp_path, monkeypatch):
    cases = [Case("press", "error", 2.0, 1.0, model="a"), Case("press", "error", 0.5, 1.0, model="b")]
    monkeypatch.setattr(stability, "PARTS", {"part": lambda: iter(cases)})
    with pytest.raises(SystemExit, match=r"stability: 1 rows are broken:\n  press, error: 2\.0, at most 1\.0"):
        stability.main(["--out", str(tmp_path)])
    assert (tmp_path / "stability.md").read_text().count("BROKEN") == 1


def test_a_thick_layer_needs_a_wide_grid(monkeypatch):
    """The row that detected it: on twice the pad, copies of the pad had an effect."""
    monkeypatch.setattr("train.physics.pad_grid._DIES_WITHIN", 0)
    holds = [stability.against_a_wide_grid(Layer(thickness_mm=h), f"{h} mm").holds for h in (4.5, 50)]
    assert holds == [True, False]
