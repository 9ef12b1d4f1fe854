"""Every experiment runs, in miniature, and leaves a page, a table and a plot."""

import csv
import re
from dataclasses import replace

import pytest
from edge_samples import ROOT

from train.experiments.__main__ import EXPERIMENTS, function_of, main
from train.experiments.support import workbench
from train.experiments.support.workbench import Workbench

COLUMNS = {
    "table3": {"method", "validation PSNR dB", "test PSNR dB", "test SSIM", "parameters", "MMAC", "run time ms"},
    "table4": {"scale", "test PSNR dB", "paper's test PSNR dB", "MMAC", "run time ms"},
    "angle": {"network", "angle deg", "test PSNR dB", "over STSR dB", "run time ms"},
    "taps": {"network", "taps given", "test PSNR dB", "over STSR dB", "run time ms"},
    "fig5": {"surface"},
    "fig7": {"method", "error %", "ms a pattern"},
}


@pytest.fixture(autouse=True)
def little_of_the_papers_size(monkeypatch):
    """Skip the cost of its networks, which takes seconds to measure and is asserted nowhere; judge half of a set."""
    monkeypatch.setattr(workbench, "_TIMED_MS", 0.001)
    names, whole = ("newest", "tap", "indentation_mm", "force_n"), Workbench.frozen

    def frozen(self, *given, **options):
        judged = whole(self, *given, **options)
        return replace(judged, **{name: getattr(judged, name)[1::2] for name in names})

    monkeypatch.setattr(Workbench, "frozen", frozen)


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


AT_NIGHT = ("table3", "table4", "angle", "taps")
"""Networks of the paper's size, and a training for each row, take half a minute."""
NAMES = [pytest.param(name, marks=pytest.mark.night) if name in AT_NIGHT else name for name in COLUMNS]


@pytest.mark.parametrize("name", NAMES)
def test_it_runs_in_miniature(folder, name, capsys):
    report = run(folder, name)
    assert capsys.readouterr().out.endswith(f"{report}.md\n")
    page = report.with_suffix(".md").read_text()
    assert page.startswith(f"# {name}\n") and "quick run" in page
    with report.with_suffix(".csv").open() as file:
        rows = list(csv.DictReader(file))
    assert rows and COLUMNS[name] <= set(rows[0])
    assert report.with_suffix(".png").exists()


@pytest.mark.night
def test_table3_has_every_method_and_the_papers_figures(folder):
    report = run(folder, "table3")
    with report.with_suffix(".csv").open() as file:
        rows = {row["method"]: row for row in csv.DictReader(file)}
    assert {"bilinear", "bicubic", "linear map", "srgan", "stsr", "mtsr2", "compact stsr", "compact mtsr7"} <= set(rows)
    assert rows["mtsr2"]["paper's test PSNR dB"] == "23.8"
    assert float(rows["stsr"]["MMAC"]) == pytest.approx(7321, abs=1)


@pytest.mark.night
def test_networks_and_data_are_made_once(folder, capsys):
    run(folder, "taps", again=True)
    assert "steps in" not in capsys.readouterr().out


def test_every_experiment_is_a_file_that_can_be_run():
    for name in EXPERIMENTS:
        assert callable(function_of(name)), name


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_its_own_steps_are_followed_by_a_bar(name):
    """A bar of a single page would never move; that of its training is another."""
    source = {"fig5": "train/networks/tpsf_net.py"}.get(name, f"{function_of(name).__module__.replace('.', '/')}.py")
    assert re.search(r"\bfor .* in .*tracked\(", (ROOT / source).read_text())


def test_a_quick_bench_keeps_apart_from_a_real_one(folder):
    assert all(path.name.startswith("quick-") for path in (folder / "checkpoints").glob("*.pt"))
    assert Workbench().quick is False
