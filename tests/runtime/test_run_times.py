"""Run times: how they are taken and kept."""

import itertools
import json
import math
import threading

import numpy as np
import pytest
from edge_samples import FakeModel, make_contract

from edge.budgeting.run_time_cache import FILE_NAME, CalibrationCache, cache_path, machine
from edge.budgeting.run_times import LEAST_RATE_HZ, ROUND_TICKS, ROUNDS, RunTime, calibrate
from firmware_bridge.schedule import Ticker

TICKS = ROUNDS * ROUND_TICKS


class World:
    """A clock that models and sleeping move."""

    def __init__(self):
        self.now_ns = 0
        self.order = []
        self.starts_ns = []
        self.rates_hz = []

    def ticker(self, rate_hz):
        self.rates_hz.append(rate_hz)
        return Ticker(rate_hz, lambda: self.now_ns, self.sleep)

    def sleep(self, duration_s):
        self.now_ns += math.ceil(duration_s * 1e9)

    def model(self, name, run_times_us, **changes):
        endless = itertools.cycle(run_times_us)

        def on_run():
            self.order.append(name)
            self.starts_ns.append(self.now_ns)
            self.now_ns += round(next(endless) * 1000)

        return FakeModel(make_contract(**changes), on_run)

    def calibrate(self, *models, rate_hz=100.0, stop=None):
        stop = stop or threading.Event()
        return calibrate(models, rate_hz, stop=stop, ticker_of=self.ticker, clock_ns=lambda: self.now_ns)


def test_models_take_turns_each_at_its_tick():
    world = World()
    one, four = world.model("one", [800], taps=1), world.model("four", range(1001, 1151))
    assert world.calibrate(one, four) == [RunTime(800, 800), RunTime(1075, 1149)]
    turn = ["one"] * ROUND_TICKS + ["four"] * ROUND_TICKS
    assert world.order == turn * ROUNDS
    gaps_ns = np.diff(world.starts_ns[:ROUND_TICKS])
    assert np.abs(gaps_ns - 10_000_000).max() < 10
    assert one.windows[0].shape == (1, 3, 4, 4) and np.unique(four.windows[0]).size > 100
    again = World()
    repeated = again.model("one", [800], taps=1)
    again.calibrate(repeated)
    np.testing.assert_array_equal(repeated.windows[0], one.windows[0])


def test_a_slow_sensor_does_not_make_it_long():
    world = World()
    world.calibrate(world.model("one", [800]), rate_hz=1.0)
    assert set(world.rates_hz) == {LEAST_RATE_HZ}
    world.calibrate(world.model("one", [800]), rate_hz=333.0)
    assert set(world.rates_hz[ROUNDS:]) == {333.0}


def test_it_can_be_stopped():
    world, stop = World(), threading.Event()
    model = FakeModel(on_run=lambda: stop.set() if len(model.windows) == 9 else None)
    assert world.calibrate(model, stop=stop) is None
    assert len(model.windows) == 10


def test_the_99th_percentile_is_the_one_of_150_that_is_over_the_true_one_most_nearly_in_half_of_the_cases():
    assert TICKS == 150
    took_us = np.random.default_rng(0).permutation(np.arange(1, TICKS + 1) * 1.0)
    assert RunTime.of(took_us) == RunTime(75.0, 149.0)
    # The k-th longest is over it if at least k of 150 are.
    over = list(itertools.accumulate(math.comb(TICKS, k) * 0.01**k * 0.99 ** (TICKS - k) for k in range(4)))
    assert 1 - over[0] == pytest.approx(0.78, abs=0.005) and 1 - over[1] == pytest.approx(0.44, abs=0.005)
    assert abs(0.5 - over[1]) < min(abs(0.5 - over[0]), abs(0.5 - over[2]))


@pytest.fixture
def models(tmp_path):
    """Two files; what is in them does not matter here."""
    for name in ("a", "b"):
        (tmp_path / f"{name}.onnx").write_text(name)
    return tmp_path / "a.onnx", tmp_path / "b.onnx"


def cache(tmp_path, rate_hz=100.0, now_s=1000.0):
    return CalibrationCache(tmp_path / "cache" / FILE_NAME, rate_hz, lambda: now_s)


KEPT = RunTime(800.0, 1100.0)


class TestCache:
    def test_what_is_kept_is_found_with_its_age_by_what_the_file_holds(self, tmp_path, models):
        a, b = models
        first = cache(tmp_path)
        first.keep({a: KEPT})
        second = cache(tmp_path, now_s=1060.0)
        assert second.find(a) == (KEPT, 60.0) and second.find(b) is None
        second.keep({b: RunTime(1.0, 2.0)})
        third = cache(tmp_path, now_s=900.0)
        assert third.find(a) == (KEPT, 0.0) and third.find(b) == (RunTime(1.0, 2.0), 0.0)
        a.rename(tmp_path / "c.onnx")
        assert third.find(tmp_path / "c.onnx") is not None
        b.write_text("exported again")
        assert cache(tmp_path).find(b) is None
        assert first.notes == second.notes == third.notes == []
        assert [path.name for path in (tmp_path / "cache").iterdir()] == [FILE_NAME]

    def test_another_rate_or_machine_or_version_is_measured(self, tmp_path, models, monkeypatch):
        cache(tmp_path).keep({models[0]: KEPT})
        assert cache(tmp_path, rate_hz=50.0).find(models[0]) is None
        facts = machine()
        for fact in facts:
            monkeypatch.setattr("edge.budgeting.run_time_cache.machine", lambda fact=fact: facts | {fact: "another"})
            assert cache(tmp_path).find(models[0]) is None, fact

    def test_nothing_to_keep_writes_nothing(self, tmp_path):
        cache(tmp_path).keep({})
        assert not (tmp_path / "cache").exists()

    def test_the_machine_is_known(self):
        facts = machine()
        assert set(facts) == {"cpu", "cores", "host", "onnxruntime", "numpy", "version"} and facts["cpu"]

    @pytest.mark.parametrize("content", [b"", b"{", b"\xff", b"[]", b"3", b"[" * 100_000])
    def test_a_damaged_file_is_measured_anew_and_said(self, tmp_path, models, content):
        (tmp_path / "cache").mkdir()
        (tmp_path / "cache" / FILE_NAME).write_bytes(content)
        damaged = cache(tmp_path)
        assert damaged.find(models[0]) is None
        assert damaged.notes == [f"{tmp_path}/cache/{FILE_NAME} is damaged: measured again"]
        damaged.keep({models[0]: KEPT})
        assert cache(tmp_path).find(models[0]) == (KEPT, 0.0)

    @pytest.mark.parametrize(
        "change",
        [
            {"p50_us": "800"}, {"p99_us": None}, {"p50_us": -1}, {"p99_us": 10**400}, {"unix_s": float("nan")},
            {"p50_us": 1200.0}, None,
        ],
    )  # fmt: skip
    def test_a_damaged_entry_is_measured_anew_and_said(self, tmp_path, models, change):
        cache(tmp_path).keep({models[0]: KEPT, models[1]: KEPT})
        path = tmp_path / "cache" / FILE_NAME
        entries = json.loads(path.read_text())
        key = next(key for key, entry in entries.items() if entry["model"] == "a")
        entries[key] = None if change is None else entries[key] | change
        path.write_text(json.dumps(entries))
        damaged = cache(tmp_path)
        assert damaged.find(models[1]) == (KEPT, 0.0) and damaged.notes == []
        assert damaged.find(models[0]) is None
        # An entry that is null is none, and was never this program's.
        assert damaged.notes == ([] if change is None else [f"{path} is damaged at a: measured again"])

    def test_a_place_that_cannot_be_written_is_said_once(self, tmp_path, models):
        (tmp_path / "cache").write_text("a file where a folder should be")
        kept = cache(tmp_path)
        assert kept.find(models[0]) is None
        kept.keep({models[0]: KEPT})
        assert kept.notes == [f"run times are measured at each start: {tmp_path}/cache/{FILE_NAME}: Not a directory"]

    def test_a_folder_in_its_place_is_said(self, tmp_path, models):
        kept = cache(tmp_path)
        (tmp_path / "cache" / FILE_NAME).mkdir(parents=True)
        kept.keep({models[0]: KEPT})
        assert kept.notes == [f"run times are not kept: {tmp_path}/cache/{FILE_NAME}: Is a directory"]
        assert [path.name for path in (tmp_path / "cache").iterdir()] == [FILE_NAME], "no draft stays"

    def test_where_it_lies(self, monkeypatch, tmp_path, models):
        monkeypatch.setenv("HOME", "/home/robot")
        assert str(cache_path({"XDG_CACHE_HOME": "/var/cache"})) == f"/var/cache/edge-sr/{FILE_NAME}"
        for folder in ({}, {"XDG_CACHE_HOME": ""}, {"XDG_CACHE_HOME": "relative"}):
            assert str(cache_path(folder)) == f"/home/robot/.cache/edge-sr/{FILE_NAME}"
        monkeypatch.setattr("pathlib.Path.home", raise_no_home)
        assert cache_path({}) is None
        homeless = CalibrationCache(None, 100.0)
        homeless.keep({models[0]: KEPT})
        assert homeless.notes == ["there is no home folder to keep run times in: measured at each start"]


def raise_no_home():
    raise RuntimeError("Could not determine home directory.")
