"""Every experiment runs, in miniature, and leaves a page with its tables."""

import pytest
from experiment_samples import quick_bench, tables_of

from train.experiments.__main__ import main, run

COLUMNS = {
    "families": [{"method", "run time us"}, {"family", "model, over"}, {"edge", "far"}],
    "pads": [{"constant", "model, down", "model, all known, up"}],
    "posed-taps": [
        *[{"schedule", "taps", "over one tap"}] * 3,
        {"off mm", "over one tap, not stated", "left out %, stated"},
        {"model", "over one tap"},
    ],
    "fig5": [{"surface", "beta by search mm"}, {"slope per N"}],
}
"""Some columns of the tables of each experiment that needs no recordings."""


@pytest.mark.parametrize(
    "name", [name if name == "fig5" else pytest.param(name, marks=pytest.mark.night) for name in COLUMNS]
)
def test_it_runs_in_miniature(tmp_path, tmp_path_factory, name):
    page = run(name, quick_bench(tmp_path_factory), tmp_path)
    assert page.read_text().startswith(f"# {name}\n") and "quick run" in page.read_text()
    tables = tables_of(page)
    assert len(tables) == len(COLUMNS[name])
    for rows, columns in zip(tables, COLUMNS[name], strict=True):
        assert rows and columns <= set(rows[0])


def test_a_folder_without_recordings_is_named_first(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("TACTILE_RECORDINGS", str(tmp_path / "none"))
    with pytest.raises(SystemExit, match=r"^experiments: .*TACTILE_RECORDINGS"):
        main(["real"])
    assert not (tmp_path / "data").exists()
