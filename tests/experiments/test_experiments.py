"""Every experiment runs, in miniature, and leaves a page with its tables."""

import pytest
from experiment_samples import tables_of

from train.experiments.__main__ import EXPERIMENTS, experiment, main, run
from train.experiments.paper_tables import HELD_OUT, training_sets
from train.experiments.workbench import Workbench

ERRORS = {"test PSNR dB", "run time ms"}
COLUMNS = {
    "table3": [ERRORS | {"method", "validation PSNR dB", "test SSIM", "parameters", "MMAC"}],
    "table4": [ERRORS | {"scale", "paper's test PSNR dB", "MMAC"}],
    "angle": [ERRORS | {"network", "angle deg", "over STSR dB"}],
    "taps": [ERRORS | {"network", "taps given", "over STSR dB"}],
    "unseen": [ERRORS | {"trained on", "tested on", "taps", "covered %", "width %", "steps"}],
    "force": [{"force N", "PSNR dB", "SSIM at own scale", "relative error %", "MMAC"}],
    "force-recovery": [{"error %", "loop %", "at no load %", "MMAC"}],
    "families": [{"method", "run time us"}, {"family", "model, over"}, {"edge", "far"}],
    "pads": [{"constant", "model, down", "model, all known, up"}],
    "posed-taps": [
        *[{"schedule", "taps", "over one tap"}] * 3,
        {"off mm", "over one tap, not stated", "left out %, stated"},
        {"model", "over one tap"},
    ],
    "fig5": [{"surface", "beta by search mm"}, {"slope per N"}],
    "fig7": [{"method", "error %", "ms a pattern"}],
}
"""Some columns of the tables of each experiment that needs no recordings."""
IN_GATE = ("fig5", "fig7")
"""The others take half a minute, for networks of the paper's size or a training for each row."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("experiments")


def page_of(folder, name, *, again=False):
    """The report, made once, unless asked for again."""
    page = folder / "reports" / f"{name}.md"
    if again or not page.exists():
        run(name, Workbench(folder / "data", folder / "checkpoints", quick=True), page.parent)
    return page


@pytest.mark.parametrize(
    "name", [name if name in IN_GATE else pytest.param(name, marks=pytest.mark.night) for name in COLUMNS]
)
def test_it_runs_in_miniature(folder, name):
    page = page_of(folder, name)
    assert page.read_text().startswith(f"# {name}\n") and "quick run" in page.read_text()
    tables = tables_of(page)
    assert len(tables) == len(COLUMNS[name])
    for rows, columns in zip(tables, COLUMNS[name], strict=True):
        assert rows and columns <= set(rows[0])


@pytest.mark.night
def test_table3_has_every_method_and_the_papers_figures(folder):
    rows = {row["method"]: row for row in tables_of(page_of(folder, "table3"))[0]}
    assert {"bilinear", "bicubic", "linear map", "srgan", "stsr", "mtsr2", "compact stsr", "compact mtsr7"} <= set(rows)
    assert rows["mtsr2"]["paper's test PSNR dB"] == "23.8"
    assert float(rows["stsr"]["MMAC"]) == pytest.approx(7321, abs=1)


@pytest.mark.night
def test_unseen_has_every_training_set_on_every_test_set_over_the_one_without_figures(folder):
    (rows,) = tables_of(page_of(folder, "unseen"))
    assert len({(row["trained on"], row["tested on"], row["taps"]) for row in rows}) == len(rows) == 5 * 4 * 2
    assert all(row["over the 15 dB"] == "+0.00 (+0.00..+0.00)" for row in rows if row["trained on"] == "15")


@pytest.mark.night
def test_training_sets_keep_to_their_names(folder):
    sets = training_sets(Workbench(folder / "data", folder / "checkpoints", quick=True))
    surfaces = {name: set(data.family.tolist()) for name, (_, data) in sets.items()}
    assert [name for name, there in surfaces.items() if there & set(HELD_OUT)] == ["18 + figures"]
    assert surfaces["15, half as long"] == surfaces["15"]
    assert surfaces["15 + figures"] - surfaces["15"] == {"glyph", "polygon"}
    assert surfaces["18 + figures"] == surfaces["15 + figures"] | set(HELD_OUT)


@pytest.mark.night
def test_networks_and_data_are_made_once(folder):
    page_of(folder, "taps")
    made_ns = {path: path.stat().st_mtime_ns for path in folder.glob("[dc]*/*")}
    page_of(folder, "taps", again=True)
    assert made_ns == {path: path.stat().st_mtime_ns for path in folder.glob("[dc]*/*")}
    assert all(path.name.startswith("quick-") for path in (folder / "checkpoints").glob("*.pt")), "apart from real ones"


def test_every_experiment_is_a_function_with_a_line():
    assert all(experiment(name).__doc__ for name in EXPERIMENTS)


def test_a_folder_without_recordings_is_named_before_anything_is_made(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("TACTILE_RECORDINGS", str(tmp_path / "none"))
    with pytest.raises(SystemExit, match=r"^experiments: .*TACTILE_RECORDINGS"):
        main(["real"])
    assert not (tmp_path / "data").exists()
