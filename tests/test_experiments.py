"""Every experiment runs, in miniature, and leaves a page, a table and a plot."""

import csv

import pytest

from train.experiments.__main__ import EXPERIMENTS, main
from train.experiments.workbench import Workbench

COLUMNS = {
    "table3": {"method", "validation PSNR dB", "test PSNR dB", "test SSIM", "parameters", "MMAC", "run time ms"},
    "table4": {"scale", "test PSNR dB", "paper's test PSNR dB", "MMAC", "run time ms"},
    "angle": {"network", "angle deg", "test PSNR dB", "over STSR dB", "run time ms"},
    "taps": {"network", "taps given", "test PSNR dB", "over STSR dB", "run time ms"},
    "fig5": {"surface"},
    "curved": {"surface", "method"},
    "psf_speed": {"route", "times the direct"},
    "fig7": {"method", "error %", "ms a pattern"},
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("experiments")


def run(folder, name):
    places = [f"--{place}={folder / place}" for place in ("reports", "data", "checkpoints")]
    main([name, "--quick", *places])
    return folder / "reports" / name


@pytest.mark.parametrize("name", COLUMNS)
def test_it_runs_in_miniature(folder, name, capsys):
    report = run(folder, name)
    assert capsys.readouterr().out.endswith(f"{report}.md\n")
    page = report.with_suffix(".md").read_text()
    assert page.startswith(f"# {name}\n") and "quick run" in page
    with report.with_suffix(".csv").open() as file:
        rows = list(csv.DictReader(file))
    assert rows and COLUMNS[name] <= set(rows[0])
    assert report.with_suffix(".png").exists()


def test_table3_has_every_method_and_the_papers_figures(folder):
    report = run(folder, "table3")
    with report.with_suffix(".csv").open() as file:
        rows = {row["method"]: row for row in csv.DictReader(file)}
    assert {"bilinear", "bicubic", "linear map", "srgan", "stsr", "mtsr2", "compact stsr", "compact mtsr7"} <= set(rows)
    assert rows["mtsr2"]["paper's test PSNR dB"] == "23.8"
    assert float(rows["stsr"]["MMAC"]) == pytest.approx(7321, abs=1)


def test_networks_and_data_are_made_once(folder, capsys):
    run(folder, "taps")
    assert "steps in" not in capsys.readouterr().out


def test_every_experiment_is_a_file_that_can_be_run():
    import importlib

    for name in EXPERIMENTS:
        assert callable(importlib.import_module(f"train.experiments.{name.replace('-', '_')}").run), name


def test_a_quick_bench_keeps_apart_from_a_real_one(folder):
    assert all(path.name.startswith("quick-") for path in (folder / "checkpoints").glob("*.pt"))
    assert Workbench().quick is False
