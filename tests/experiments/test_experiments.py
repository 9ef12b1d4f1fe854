"""Every experiment runs, in miniature, and leaves a page and its tables."""

import csv

import pytest

from train.experiments.__main__ import EXPERIMENTS, function_of, main
from train.experiments.paper.protocol import HELD_OUT
from train.experiments.paper.tables import training_sets
from train.experiments.workbench import Workbench

ERRORS = {"test PSNR dB", "run time ms"}
COLUMNS = {
    "table3": {"": ERRORS | {"method", "validation PSNR dB", "test SSIM", "parameters", "MMAC"}},
    "table4": {"": ERRORS | {"scale", "paper's test PSNR dB", "MMAC"}},
    "angle": {"": ERRORS | {"network", "angle deg", "over STSR dB"}},
    "taps": {"": ERRORS | {"network", "taps given", "over STSR dB"}},
    "unseen": {"": ERRORS | {"trained on", "tested on", "taps", "covered %", "width %", "steps"}},
    "force": {"": {"force N", "PSNR dB", "SSIM at own scale", "relative error %", "MMAC"}},
    "force-recovery": {"": {"error %", "loop %", "at no load %", "MMAC"}, "-surfaces": {"surface"}},
    "families": {"": {"family", "model, over"}, "-methods": {"method", "run time us"}, "-intervals": {"edge", "far"}},
    "pads": {"": {"constant", "model, down", "model, all known, up"}},
    "posed-taps": {
        "-schedules": {"schedule", "taps", "over one tap"},
        "-wrong-poses": {"off mm", "over one tap, not stated", "left out %, stated"},
        "-paper": {"model", "over one tap"},
    },
    "fig5": {"": {"surface"}},
    "fig7": {"": {"method", "error %", "ms a pattern"}},
}
"""Some columns of the tables of each experiment that needs no recordings."""
IN_GATE = ("fig5", "fig7")
"""The others take half a minute, for networks of the paper's size or a training for each row."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("experiments")


def run(folder, name, *options, again=False):
    """The report's files without their endings; made once, unless asked for again."""
    report = folder / "reports" / name
    if again or not report.with_suffix(".md").exists():
        places = (f"--{place}={folder / place}" for place in ("reports", "data", "checkpoints"))
        main([name, "--quick", *options, *places])
    return report


@pytest.mark.parametrize(
    "name", [name if name in IN_GATE else pytest.param(name, marks=pytest.mark.night) for name in COLUMNS]
)
def test_it_runs_in_miniature(folder, name, capsys):
    report = run(folder, name)
    assert capsys.readouterr().out.endswith(f"{report}.md\n")
    page = report.with_suffix(".md").read_text()
    assert page.startswith(f"# {name}\n") and "quick run" in page
    for part, columns in COLUMNS[name].items():
        with report.with_name(f"{name}{part}.csv").open() as file:
            rows = list(csv.DictReader(file))
        assert rows and columns <= set(rows[0])


@pytest.mark.night
def test_table3_has_every_method_and_the_papers_figures(folder):
    report = run(folder, "table3")
    with report.with_suffix(".csv").open() as file:
        rows = {row["method"]: row for row in csv.DictReader(file)}
    assert {"bilinear", "bicubic", "linear map", "srgan", "stsr", "mtsr2", "compact stsr", "compact mtsr7"} <= set(rows)
    assert rows["mtsr2"]["paper's test PSNR dB"] == "23.8"
    assert float(rows["stsr"]["MMAC"]) == pytest.approx(7321, abs=1)


@pytest.mark.night
def test_unseen_has_every_training_set_on_every_test_set_over_the_one_without_figures(folder):
    with run(folder, "unseen").with_suffix(".csv").open() as file:
        rows = list(csv.DictReader(file))
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
    run(folder, "taps")
    made_ns = {path: path.stat().st_mtime_ns for path in folder.glob("[dc]*/*")}
    run(folder, "taps", again=True)
    assert made_ns == {path: path.stat().st_mtime_ns for path in folder.glob("[dc]*/*")}
    assert all(path.name.startswith("quick-") for path in (folder / "checkpoints").glob("*.pt")), "apart from real ones"


def test_every_experiment_is_a_file_that_can_be_run():
    for name in EXPERIMENTS:
        assert callable(function_of(name)), name
