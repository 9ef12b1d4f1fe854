"""Needs of a scan: nothing, the pattern before, or one from the taps that matter."""

import numpy as np
import pytest
from edge_samples import FakeModel, make_contract
from runtime_samples import PRESS, Pushed, make_runtime

from edge.perception.change_gate import CHANGED_COUNTS, NOISE_COUNTS, LastReading
from edge.perception.contact_options import RuntimeOptions

SHAPE = (3, 4, 4)
SURE = make_contract(interval_factor=1.6)
BEFORE = (2000.0 * np.random.default_rng(0).random(SHAPE)).astype(np.float32)


@pytest.fixture
def last():
    """The last reading, of which a model has made a pattern."""
    last = LastReading(SHAPE)
    last.keep(BEFORE, "model")
    return last


class TestLastReading:
    def test_noise_is_no_change_and_a_little_everywhere_is(self, last):
        noise = NOISE_COUNTS * np.random.default_rng(1).standard_normal((2001, *SHAPE), dtype=np.float32)
        last.keep(BEFORE + noise[0], "model")
        assert sum(last.holds(BEFORE + one, "model") for one in noise[1:]) >= 1990
        last.keep(BEFORE, "model")
        assert last.holds(BEFORE + np.float32(3.9), "model")
        assert not last.holds(BEFORE + np.float32(4.0), "model")

    def test_one_taxel_that_changed_is_seen(self, last):
        for place in np.ndindex(SHAPE):
            after = BEFORE.copy()
            after[place] -= CHANGED_COUNTS + 1
            assert not last.holds(after, "model")

    def test_drift_is_followed_however_slowly(self, last):
        counts, made = BEFORE, 0
        for _ in range(400):
            counts = counts + np.float32(0.1)
            if not last.holds(counts, "model"):
                last.keep(counts, "model")
                made += 1
        assert made == 10

    def test_another_maker_or_none_makes_it_anew(self, last):
        last.keep(BEFORE, ("model", 0, 1))
        assert last.holds(BEFORE, ("model", 0, 1)) and not last.holds(BEFORE, ("model", 1, 1))
        last.keep(BEFORE, None)
        assert not last.holds(BEFORE, ("model", 0, 1)) and not LastReading(SHAPE).holds(BEFORE, "model")


def make_pad(**settings):
    model = FakeModel(SURE)
    return Pushed(make_runtime(model, **settings)), model


def test_a_still_grip_is_inferred_once():
    pad, model = make_pad()
    results = [pad.push(PRESS, noise=3) for _ in range(15)]
    assert len(model.windows) == 1
    assert [result.reused_from for result in results] == [None] + [0] * 14
    for result in results[1:]:
        assert result.state == "contact" and result.run_time_us is None and result.pattern is results[0].pattern
        assert result.interval_mm == results[0].interval_mm and result.area_mm2 == results[0].area_mm2
    moved = pad.push(PRESS + 20)
    assert moved.reused_from is None and moved.run_time_us is not None and len(model.windows) == 2
    pad.runtime.reset()
    assert pad.push(PRESS + 20).reused_from is None, "a reset"
    pad.push()
    again = [pad.push(PRESS + 20).reused_from for _ in range(2)]
    assert again == [None, 18] and len(model.windows) == 4, "the same touch in the next tap"


def test_every_scan_is_inferred_where_that_is_asked_for():
    pad, model = make_pad(options=RuntimeOptions(every_scan=True))
    assert all(pad.push(PRESS).reused_from is None for _ in range(5))
    assert len(model.windows) == 5
