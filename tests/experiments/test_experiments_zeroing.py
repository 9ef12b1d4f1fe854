import csv

import numpy as np
import pytest
from experiment_samples import quick_bench

from edge.inference.bundled import find_model
from edge.inference.onnx_session import ModelSession
from train.experiments.sensor import zeroing


@pytest.fixture(scope="module")
def model():
    return ModelSession(find_model(zeroing.MODEL))


def scene(name):
    return next(one for one in zeroing.scenes() if one.name == name)


def test_the_report_has_every_scene_by_every_method(tmp_path_factory, monkeypatch):
    monkeypatch.setattr(zeroing, "_QUICK", 400)
    monkeypatch.setattr(zeroing, "_LEAD_S", 3.0)
    page = zeroing.run(quick_bench(tmp_path_factory), tmp_path_factory.mktemp("reports"))
    with page.with_suffix(".csv").open() as file:
        rows = list(csv.DictReader(file))
    assert {row["method"] for row in rows} == {"followed", "fixed", "high-pass"}
    assert {one.name for one in zeroing.scenes()} <= {row["scene"] for row in rows}
    assert "quick run" in page.read_text() and page.with_suffix(".png").stat().st_size > 10_000
    with page.with_name("zeroing-cost.csv").open() as file:
        assert [row["baseline"] for row in csv.DictReader(file)] == ["fixed", "followed"]


def test_what_is_followed_makes_no_contact_where_a_fixed_baseline_does(model):
    told = zeroing.play(scene("1000 counts in a minute"), 30.0, model)
    assert told["followed"].false == 0 and told["followed"].steps == 0
    assert told["fixed"].false > 1000


def test_a_hold_is_eaten_by_a_high_pass_alone(model):
    told = zeroing.play(scene("an hour's hold, warming up"), 20.0, model)
    assert told["followed"].eaten_counts == 0
    assert told["high-pass"].eaten_counts > 0.5 * 4000


def test_a_tally_counts_each_press_by_itself():
    press, correction = np.zeros((2, 8, 3, 4, 4))
    press[2:4, 2, 0, 0] = press[6:, 2, 0, 0] = 100
    correction[:, 2, 1, 1] = [0, 0, 10, 15, 30, 40, 40, 41]
    tally = zeroing.Tally()
    for part in (slice(0, 3), slice(3, 8)):  # cut within a press
        tally.add(np.zeros_like(press[part]), press[part], correction[part], np.zeros(8, dtype=bool)[part])
    assert tally.eaten_counts == 5 + 1 and tally.row("", "")["press eaten %"] == 3.0
    assert tally.free == 4 and tally.worst_counts == 40
