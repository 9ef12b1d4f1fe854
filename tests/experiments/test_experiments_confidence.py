import csv

import numpy as np
import pytest
from experiment_samples import quick_bench

from train.experiments.sensor import confidence
from train.experiments.sensor.confidence import taps_until_stop


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    return confidence.run(quick_bench(tmp_path_factory), tmp_path_factory.mktemp("reports"))


def test_the_page_tells_what_was_expected_and_what_came_out(page):
    text = page.read_text()
    assert "Early stop" in text and "quick run" in text and page.with_suffix(".png").stat().st_size > 10_000
    with page.with_suffix(".csv").open() as file:
        rows = list(csv.DictReader(file))
    assert {row["taps"] for row in rows} == {"1", "2"}
    assert all(0.5 < float(row["ratio"]) < 2 for row in rows)


def test_a_tap_is_added_as_long_as_another_is_worth_it():
    gains = [np.array([0.5, 0.5, 0.0, 0.02]), np.array([0.5, 0.0, 0.5, 0.019]), None]
    assert taps_until_stop(gains).tolist() == [3, 2, 1, 2]
    with pytest.raises(ValueError, match="one tap"):
        taps_until_stop([None])
