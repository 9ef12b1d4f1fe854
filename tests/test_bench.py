import subprocess
import sys
import time
from dataclasses import replace

import numpy as np
import pytest

from edge.bench import bench, header, model_rows, pace, surface_table, table_line
from edge.bundle import BUNDLE_DIR, find_model
from edge.errors import ModelError
from edge.frozen import load_frozen_set
from edge.session import ModelSession


@pytest.fixture(scope="module")
def rows():
    return list(bench([find_model("mtsr2")], rate_hz=2000, ticks=20))


def test_each_method_has_its_rows_and_a_model_one_for_few_and_one_for_all_taps(rows):
    assert [(row.method, row.given) for row in rows] == [
        *(("bilinear", 1), ("linear map", 1), ("bicubic", 1)),
        *(("mtsr2", 1), ("mtsr2", 2)),
    ]


def test_the_error_is_that_of_the_contract(rows):
    contract = ModelSession(find_model("mtsr2")).contract
    for row in rows[3:]:
        assert row.error == pytest.approx(contract.test_error[str(row.given)], rel=1e-3, abs=2e-4)


def test_a_row_becomes_a_line_with_a_cell_for_each_column(rows):
    head = header(100, 20).splitlines()
    assert head[0].startswith("20 ticks a row at 100 Hz")
    for row in rows:
        assert table_line(row).count("|") == head[-1].count("|") == head[-2].count("|")
    assert f"| {rows[0].error['psnr_db']:.2f} |" in table_line(rows[0])


def test_how_many_pixels_an_interval_holds_is_told_where_there_is_one(rows):
    column = [cell.strip() for cell in header(100, 20).splitlines()[-2].split("|")].index("covered %")
    cells = [table_line(row).split("|")[column].strip() for row in rows]
    expected = [f"{100 * row.error['coverage_90']:.1f}" if "coverage_90" in row.error else "-" for row in rows]
    assert cells == expected
    assert {row.method for row in rows if "coverage_90" not in row.error}.isdisjoint({"mtsr2"})


def test_the_second_table_names_every_surface(rows):
    lines = surface_table(rows).splitlines()
    assert len(lines) == 2 + 18
    assert f"| {rows[3].psnr_db_by_surface['S']:.1f} |" in next(line for line in lines if line.startswith("| S |"))
    mean_db = np.mean(list(rows[3].psnr_db_by_surface.values()))
    assert mean_db == pytest.approx(rows[3].error["psnr_db"], abs=1e-3)


def test_pace_runs_once_a_tick_and_counts_what_came_late():
    ticks = []
    easy = pace(ticks.append, rate_hz=500, ticks=25)
    assert ticks == list(range(25))
    assert 0 < easy.p50_us <= easy.p99_us <= easy.max_us
    assert pace(lambda tick: time.sleep(0.004), rate_hz=500, ticks=10).missed > 0


def test_a_model_of_another_scale_is_refused():
    frozen = load_frozen_set(BUNDLE_DIR / "frozen.npz")
    coarse = replace(frozen, unit_patterns=frozen.unit_patterns[:, :16, :16])
    with pytest.raises(ModelError, match="'scale' is 10, the test set's is 4"):
        list(model_rows(find_model("stsr"), coarse, 1000, 10))


def test_the_command_prints_the_table():
    command = [sys.executable, "-m", "edge.cli", "bench", "--ticks", "10", "--rate-hz", "1000", "--by-surface"]
    out = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    assert all(f"| {name} |" in out for name in ("bilinear", "linear map", "stsr", "mtsr2", "mtsr4"))
    assert "| small triangle |" in out
