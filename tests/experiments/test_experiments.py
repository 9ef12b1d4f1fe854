"""Every experiment runs, in miniature, and leaves a page with its tables."""

import pytest
from experiment_samples import quick_bench, tables_of

from train.experiments.__main__ import main, run
from train.experiments.paper_tables import HELD_OUT, training_sets

ERRORS = {"test PSNR dB", "run time ms"}
COLUMNS = {
    "table3": [ERRORS | {"method", "validation PSNR dB", "test SSIM", "parameters"}],
    "table4": [ERRORS | {"scale"}],
    "angle": [ERRORS | {"network", "angle deg", "over STSR dB"}],
    "taps": [ERRORS | {"network", "taps given", "over STSR dB"}],
    "unseen": [ERRORS | {"trained on", "tested on", "taps"}],
    "families": [{"method", "run time us"}, {"family", "model, over"}, {"edge", "far"}],
    "pads": [{"constant", "model, down", "model, all known, up"}],
    "posed-taps": [
        *[{"schedule", "taps", "over one tap"}] * 3,
        {"off mm", "over one tap, not stated", "left out %, stated"},
        {"model", "over one tap"},
    ],
    "nonnegative": [{"world", "known", "over one tap", "run time us"}],
    "second-world": [{"method", "sinking, PSNR dB", "as drawn, wrong %"}, {"truth"}, {"sensor, after 10 %"}],
    "blind-sensors": [{"patterns", "figures, over"}, {"sensor", "its own, all", "all families", "handed over"}],
    "fig7": [{"method", "error %", "ms a pattern"}],
}
"""Some columns of the tables of each experiment that needs no recordings."""


@pytest.mark.parametrize(
    "name", [name if name.startswith("fig") else pytest.param(name, marks=pytest.mark.night) for name in COLUMNS]
)
def test_it_runs_in_miniature(tmp_path, tmp_path_factory, name):
    page = run(name, quick_bench(tmp_path_factory), tmp_path)
    assert page.read_text().startswith(f"# {name}\n")
    tables = tables_of(page)
    assert len(tables) == len(COLUMNS[name])
    for rows, columns in zip(tables, COLUMNS[name], strict=True):
        assert rows and columns <= set(rows[0])


@pytest.mark.night
def test_training_sets_keep_to_their_names(tmp_path_factory):
    sets = training_sets(quick_bench(tmp_path_factory))
    surfaces = {name: set(data.family.tolist()) for name, (_, data) in sets.items()}
    assert [name for name, there in surfaces.items() if there & set(HELD_OUT)] == ["18 + figures"]
    assert surfaces["15 + figures"] - surfaces["15"] == {"glyph", "polygon"}
    assert surfaces["18 + figures"] == surfaces["15 + figures"] | set(HELD_OUT)


def test_a_folder_without_recordings_is_named_first(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("TACTILE_RECORDINGS", str(tmp_path / "none"))
    with pytest.raises(SystemExit, match=r"^experiments: .*TACTILE_RECORDINGS"):
        main(["real"])
    assert not (tmp_path / "data").exists()
