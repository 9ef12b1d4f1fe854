"""The ten recipes, run as they are written on the page; for the demo its recording is played, which loses nothing."""

import re
import statistics
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
from edge_samples import ROOT, FakeModel

from edge import api
from edge.pipeline import runtime_setup

load_model = cache(runtime_setup.load_model)

PAGE = (ROOT / "docs" / "recipes.md").read_text()
RECIPES = dict(re.findall(r"^## ([^\n]+)\n(?:(?!^## ).)*?^```python\n(.*?)^```", PAGE, re.M | re.S))
REPLAY = f"replay:{api.demo_recording()}"
OLD = "OLDEST_S = 0.1"
"""Limit of a reading's age, which a busy machine may miss; that it stops is tested with readings of any age."""


@pytest.fixture
def cook(tmp_path, monkeypatch, capsys):
    """Run a recipe in an empty folder; return its names and what it printed."""
    monkeypatch.chdir(tmp_path)
    for module in (api, runtime_setup):  # loaded once: scans that wait for it longer than the source keeps are lost
        monkeypatch.setattr(module, "load_model", load_model)
    open_source = api.open_source

    def cook(title, rate_hz=2000):
        def opened(*texts):
            return open_source(*(re.sub("demo$", REPLAY, text) for text in texts), rate_hz=rate_hz)

        monkeypatch.setattr(api, "open_source", opened)
        names = {"__name__": "recipe"}
        exec(compile(RECIPES[title].replace(OLD, "OLDEST_S = 30"), f"{title}.py", "exec"), names)
        return SimpleNamespace(**names), capsys.readouterr().out.splitlines()

    return cook


def latest(result=None, age_s=0.0, link="up", **content):
    """A newest reading, of a pad at rest if nothing else is said."""
    if result is None:
        free = {"state": "idle", "dead": {}, "trusted": None, "area_mm2": None, "force_counts": 0.0, "note": None}
        result = SimpleNamespace(**(free | {"untrusted_text": "not to be believed"} | content))
    return api.Latest(result, age_s, link, new=True, skipped=0)


def test_there_are_ten_and_each_is_run():
    tests = {name for name in globals() if name.startswith("test_") and name != "test_there_are_ten_and_each_is_run"}
    assert len(RECIPES) == len(tests) == len(re.findall(r"^## ", PAGE, re.M)) == 10


def test_stop_at_an_area(cook):
    recipe, out = cook("Stop at an area", rate_hz=300)
    assert out == ["close", "stop", "area reached"]
    for wrong, why in (
        (latest(link="lost"), "link lost, reading 0.000 s old"),
        (latest(age_s=31), "link up, reading 31.000 s old"),
        (latest(dead={3: "stuck"}), "the sensor is not ready: idle"),
        (latest(state="incomplete", note="taxel 3 was not received"), "not ready: taxel 3 was not received"),
        (latest(trusted=False, state="contact", area_mm2=200.0), "not to be believed"),
        (latest(state="baseline_in_doubt", trusted=False, area_mm2=61.0, note="zero again"), "not ready: zero again"),
        (latest(state="contact", area_mm2=61.0), "a large area, but not checked"),
        (latest(state="contact", area_mm2=61.0, trusted=True), "area reached"),
    ):
        readings, done = iter([latest(), latest(state="contact", area_mm2=5.0), wrong]), []
        stream = SimpleNamespace(latest=readings.__next__)
        assert why in recipe.grip(stream, lambda done=done: done.append(1), lambda done=done: done.append(2))
        assert done == [1, 2] and next(readings, None) is None
    with pytest.raises(StopIteration):  # an error stops, too
        recipe.grip(SimpleNamespace(latest=iter([]).__next__), lambda: None, lambda: done.append(3))
    assert done[-1] == 3


def test_a_force_is_held(cook):
    recipe, out = cook("Hold a force, 30 times a second")
    speeds = [float(line.partition(" ")[0]) for line in out]
    assert len(out) > 1 and all(-1.0 <= speed <= 1.0 for speed in speeds)
    assert recipe.speed_mm_s(latest()) == 1.0 and recipe.speed_mm_s(latest(force_counts=5000)) == -0.5
    for wrong in (
        latest(link="silent"),
        latest(age_s=31),
        latest(force_counts=None),
        latest(dead={1: "stuck"}),
        latest(state="baseline_in_doubt"),
        api.Latest(None, float("inf"), "up", new=False, skipped=0),
    ):
        assert recipe.speed_mm_s(wrong) == 0.0


def test_two_fingers_are_compared(cook):
    _, out = cook("Two fingers", rate_hz=1000)
    apart_ms = [float(re.search(r"([\d.]+) ms apart", line)[1]) for line in out]
    more = [int(re.match(r"left is pressed ([+-]\d+) % more", line)[1]) for line in out]
    assert len(out) > 100 and max(apart_ms) <= 20 and statistics.median(map(abs, more)) <= 3


def test_separate_contacts_begin_and_end(cook):
    _, out = cook("Separate contacts, and slip", rate_hz=500)
    told = [re.fullmatch(r"contact (\d+): (begin|move|slip|end), -?\d+ deg, \d+ x \d+ mm", line) for line in out]
    kinds = [one[2] for one in told if one]
    assert kinds.count("begin") >= kinds.count("end") >= 4
    assert all(told) or {line for line, one in zip(out, told, strict=True) if not one} == {"more than one contact"}


def test_a_log_has_every_scan(cook, tmp_path):
    recipe, out = cook("Log to MCAP")
    scans = recipe.stream.statistics.scans
    assert out == [f"{scans} scans in press.mcap"] and scans > 800
    with api.open_recording(tmp_path / "press.mcap") as source:
        assert sum(1 for _ in api.Stream(source, api.open_runtime(FakeModel(), source))) == scans


def test_a_model_of_ones_own(cook):
    recipe, out = cook("Your own model")
    assert out and all(re.fullmatch(r"squares: [\d.]+ mm, trusted: None", line) for line in out)
    window = np.zeros((1, 3, 4, 4), dtype=np.float32)
    window[0, 2, 1, 2] = 0.5
    pattern = recipe.Squares().run(window)
    assert pattern.shape == (40, 40) and (pattern == 0.5).sum() == 100 and pattern[15, 25] == 0.5


def test_a_sink_of_ones_own(cook):
    recipe, out = cook("Your own sink")
    assert out == [str(recipe.peaks.counts)] and recipe.peaks.counts["4"] > 5000


def test_a_controller_is_tested(cook):
    recipe, out = cook("Test a controller with a recording")
    tests = [test for name, test in vars(recipe).items() if name.startswith("test_")]
    assert len(tests) == 2 and out == []
    whole = recipe.recorded()
    recipe.recorded = recipe.stops.__globals__["recorded"] = lambda: whole  # once is enough here
    for test in tests:
        test()
    recipe.stops.__globals__["stops"] = lambda latest: False
    for test in tests:
        with pytest.raises(AssertionError):
            test()


def test_arrays_alone(cook):
    recipe, out = cook("Numpy in, numpy out")
    assert recipe.patterns.shape[1:] == (40, 40) and recipe.patterns.shape[0] > 50
    assert out[0].startswith(str(recipe.patterns.shape)) and 0.5 < recipe.trusted.mean() < 1


def test_asyncio_runs_beside(cook):
    _, out = cook("asyncio", rate_hz=300)
    assert out.count("beside it") >= 2
    (first,) = [line for line in out if line.startswith("first contact: <Result of scan ")]
    assert "contact" in first and out[-1].endswith(" ms ago")
