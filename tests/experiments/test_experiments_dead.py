import csv

import numpy as np
import pytest
from experiment_samples import quick_bench

from edge.evaluation.test_set import load_frozen_set
from edge.inference.bundled import BUNDLE_DIR, TAXELS, find_model
from edge.inference.onnx_session import ModelSession
from edge.perception.dead_taxel_fill import load_estimator
from train.experiments.sensor import dead


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    return dead.run(quick_bench(tmp_path_factory), tmp_path_factory.mktemp("reports"))


def rows_of(path):
    with path.open() as file:
        return list(csv.DictReader(file))


def test_the_report_has_every_fault_found_and_unfound_and_no_false_alarm(page):
    rows = rows_of(page.with_suffix(".csv"))
    assert {row["model"] for row in rows} == set(dead.MODELS)
    assert {row["fault"] for row in rows if row["taxels"] == "found"} == {"none", *dead.FAULTS}
    assert page.with_suffix(".png").stat().st_size > 10_000
    alarms = rows_of(page.with_name("dead-alarms.csv"))
    assert len(alarms) >= 3 and {row["with an alarm"] for row in alarms} == {"0"}
    assert "quick run" in page.read_text()


def test_eight_silent_give_no_pattern_and_one_found_is_better_than_unfound(page):
    rows = rows_of(page.with_suffix(".csv"))
    for model in dead.MODELS:
        mine = [row for row in rows if row["model"] == model]
        (silent,) = [row for row in mine if row["dead"] == "8" and row["fault"] == "silent"]
        assert silent["PSNR dB"] == "" and int(silent["no pattern"]) > 0
        one = {row["taxels"]: row for row in mine if row["dead"] == "1" and row["fault"] == "stuck at random"}
        assert float(one["found"]["PSNR dB"].split()[0]) > float(one["unfound"]["PSNR dB"].split()[0]) + 5


def test_no_dead_taxel_is_what_the_models_own_judge_says():
    frozen = load_frozen_set(BUNDLE_DIR / "frozen.npz")
    few = frozen.thinned(len(frozen) // 4)
    model = ModelSession(find_model("mtsr4"))
    told = dead.play(model, few, load_estimator(TAXELS, (4, 4)), 0, "silent")
    windows = few.windows(model.contract.taps)
    direct = np.stack([model.run(model.contract.scale_window(window)).copy() for window in windows])
    # Noise of one count is all that is between them.
    assert np.abs(np.stack(told.patterns) - direct).max() < 0.02
    assert told.delays_scans == []
