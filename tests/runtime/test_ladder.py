"""`--budget-us` from the files to the records."""

import json
import math
import os
import re
import subprocess
import sys
import threading
from dataclasses import replace

import pytest
from edge_samples import BASELINE, ROOT, ListSink, make_contract, make_scan, write_model

from edge.budgeting.model_choice import Candidate, choose
from edge.budgeting.model_steps import Ladder, ModelSteps, candidate_sessions, open_ladder
from edge.budgeting.run_time_cache import CalibrationCache, cache_path
from edge.budgeting.run_times import ROUND_TICKS, ROUNDS, RunTime
from edge.cli import main as cli
from edge.errors import ModelError
from edge.inference import bundled as bundle
from edge.inference.onnx_session import ModelSession
from edge.perception.options import RuntimeOptions
from edge.perception.runtime import Runtime
from edge.pipeline.run_statistics import Statistics
from edge.sinks.jsonl import JsonLinesSink


def write(path, taps, psnr_db, /, **changes):
    test_error = {"1": {"psnr_db": 20.0}, str(taps): {"psnr_db": psnr_db}}
    arithmetic = "int8" if path.stem.endswith("-int8") else "float32"
    values = {"taps": taps, "arithmetic": arithmetic, "test_error": test_error} | changes
    return write_model(path, make_contract(**values))


def write_bundle(folder):
    folder.mkdir()
    for taps, psnr_db in ((1, 35.27), (2, 35.22), (4, 35.32)):
        name = "stsr" if taps == 1 else f"mtsr{taps}"
        write(folder / f"{name}.onnx", taps, psnr_db)
        write(folder / f"{name}-int8.onnx", taps, psnr_db - 0.1)
    return folder


@pytest.fixture
def bundled(tmp_path, monkeypatch):
    monkeypatch.setattr(bundle, "BUNDLE_DIR", write_bundle(tmp_path / "bundled"))
    return bundle.BUNDLE_DIR


def candidates(model):
    told = []
    sessions = candidate_sessions(model, told.append)
    assert all(session.name == path.stem for path, session in sessions.items())
    return {path.stem for path in sessions}, told


class TestCandidates:
    @pytest.mark.parametrize(
        ("asked", "names"),
        [
            ("stsr", {"stsr", "stsr-int8"}),
            ("mtsr2", {"mtsr2", "mtsr2-int8", "stsr", "stsr-int8"}),
            ("mtsr4", {"mtsr4", "mtsr4-int8", "mtsr2", "mtsr2-int8", "stsr", "stsr-int8"}),
            ("mtsr4-int8", {"mtsr4-int8", "mtsr2-int8", "stsr-int8"}),
            ("stsr-int8", {"stsr-int8"}),
        ],
    )
    def test_of_the_bundled_ones_those_of_no_more_taps(self, bundled, asked, names):
        assert candidates(bundle.find_model(asked)) == (names, [])

    def test_a_file_has_its_own_integers_alone(self, bundled, tmp_path):
        mine = write(tmp_path / "mine.onnx", 1, 33.0)
        assert candidates(mine) == ({"mine"}, [])
        write(tmp_path / "mine-int8.onnx", 1, 32.9)
        assert candidates(mine) == ({"mine", "mine-int8"}, [])
        assert candidates(tmp_path / "mine-int8.onnx") == ({"mine-int8"}, [])

    @pytest.mark.parametrize(
        ("changes", "words"),
        [
            ({"output_full_scale": 0.5}, "contract key 'output_full_scale' is 0.5, that of the model before 2.0"),
            ({"interval_factor": 1.6}, "contract key 'interval_factor'"),
            ({"taps": 2, "test_error": {"2": {"psnr_db": 30.0}}}, "it takes 2 taps, 'mine' only 1"),
            ({"test_set_sha256": "00"}, "its error is of another test set than that of 'mine': export both again"),
            ({"test_error": {}}, "contract key 'test_error' is {}, expected a psnr_db for 1 taps"),
            ({"test_error": {"1": {"psnr_db": "x"}}}, "expected a psnr_db for 1 taps"),
        ],
    )
    def test_integers_that_do_not_fit_are_left_out_and_told(self, tmp_path, changes, words):
        mine = write(tmp_path / "mine.onnx", 1, 33.0)
        write(tmp_path / "mine-int8.onnx", 1, 32.9, **changes)
        names, told = candidates(mine)
        assert names == {"mine"} and len(told) == 1
        assert told[0].startswith(f"{tmp_path}/mine-int8.onnx is left out: ") and words in told[0]

    def test_integers_that_cannot_be_loaded_are_left_out_and_told(self, tmp_path):
        mine = write(tmp_path / "mine.onnx", 1, 33.0)
        (tmp_path / "mine-int8.onnx").write_text("no model")
        names, told = candidates(mine)
        assert names == {"mine"} and "left out" in told[0]

    def test_a_model_whose_error_is_not_known_cannot_be_chosen_by_it(self, tmp_path):
        mine = write(tmp_path / "mine.onnx", 1, 33.0, test_error={"1": {"ssim": 0.9}})
        with pytest.raises(ModelError, match=r"'mine': contract key 'test_error' .* which --budget-us chooses by"):
            candidates(mine)


class TestOpening:
    def open(self, model, tmp_path, budget_us=1e6, **settings):
        told = []
        settings = {"recalibrate": False, "stop": threading.Event()} | settings
        ladder = open_ladder(
            model, budget_us, rate_hz=2000.0, cache=tmp_path / "cache" / "c.json", tell=told.append, **settings
        )
        return ladder, told

    def test_measured_once_then_kept_until_asked_for_anew(self, bundled, tmp_path, monkeypatch):
        monkeypatch.setattr("edge.budgeting.model_steps.UNEVEN", math.inf)
        model = bundle.find_model("mtsr4")
        first, told = self.open(model, tmp_path)
        assert first is not None and first.model.name == "mtsr4" and first.most_taps == 4
        assert told[0].startswith("calibrating mtsr4, ") and told[0].endswith("patterns each at 2000 Hz")
        assert "ago" not in told[1] and len(told) == 2
        second, told = self.open(model, tmp_path)
        assert second is not None and second.choice == first.choice
        assert len(told) == 1 and re.search(r" \(calibrated \d+ s ago\)$", told[0])
        _, told = self.open(model, tmp_path, recalibrate=True)
        assert told[0].startswith("calibrating mtsr4, ")
        _, told = self.open(bundle.find_model("stsr"), tmp_path)
        assert len(told) == 1, "measured with the others"
        write(bundled / "stsr-int8.onnx", 1, 35.0)
        _, told = self.open(bundle.find_model("stsr"), tmp_path)
        assert told[0].startswith("calibrating stsr-int8: ")

    def test_nothing_fits_is_a_warning(self, bundled, tmp_path):
        ladder, told = self.open(bundle.find_model("stsr"), tmp_path, budget_us=0.001)
        assert ladder is not None and ladder.choice.rung == 0
        assert told[-1].startswith("warning: budget 0.001 us: no model fits, ")

    def test_run_times_of_a_busy_machine_are_told_and_not_kept(self, bundled, tmp_path, monkeypatch):
        def busy(models, rate_hz, stop):
            return [RunTime(800.0, 3000.0 if model.name == "stsr" else 1100.0) for model in models]

        monkeypatch.setattr("edge.budgeting.model_steps.calibrate", busy)
        for calibrated in ("stsr, stsr-int8", "stsr"):
            ladder, told = self.open(bundle.find_model("stsr"), tmp_path, budget_us=2000.0)
            assert ladder is not None
            assert told[0] == f"calibrating {calibrated}: 150 patterns each at 2000 Hz"
            assert told[1] == "run times of stsr are uneven, as on a busy machine, and are not kept"

    def test_stopped_there_is_no_ladder(self, bundled, tmp_path):
        stop = threading.Event()
        stop.set()
        assert self.open(bundle.find_model("stsr"), tmp_path, stop=stop)[0] is None
        assert not (tmp_path / "cache").exists()


class Slow:
    """A real session that takes as long as a clock is told."""

    def __init__(self, session, clock, run_time_us):
        self.name, self.contract = session.name, session.contract
        self._session, self._clock, self._run_time_us = session, clock, run_time_us

    @property
    def deviation(self):
        return self._session.deviation

    @property
    def traction(self):
        return self._session.traction

    def run(self, window, pad=None):
        self._clock.now_ns += round(self._run_time_us * self._clock.load * 1000)
        return self._session.run(window, pad)

    def run_together(self, windows, pads=None):
        self._clock.now_ns += round(self._run_time_us * self._clock.load * 1000)
        return self._session.run_together(windows, pads)


class Clock:
    now_ns = 0
    load = 1.0

    def __call__(self):
        return self.now_ns


def test_a_load_changes_the_model_and_its_end_changes_it_back_and_the_records_say_so(tmp_path):
    clock = Clock()
    rungs = (Candidate("stsr-int8", 35.2, 800.0, 1100.0), Candidate("mtsr4", 35.3, 1000.0, 1400.0))
    sessions = [
        ModelSession(write(tmp_path / f"{rung.name}.onnx", taps, rung.psnr_db))
        for rung, taps in zip(rungs, (1, 4), strict=True)
    ]
    models = {rung.name: Slow(session, clock, rung.p50_us) for rung, session in zip(rungs, sessions, strict=True)}
    ladder = Ladder(choose(rungs, 1500.0), 1500.0, models)
    assert ladder.model.name == "mtsr4" and ladder.most_taps == 4
    runtime = Runtime(
        ladder.model,
        source="device",
        baselines={"4": BASELINE},
        # One taxel alone is believed up to 1500 counts.
        options=RuntimeOptions(contact_on_counts=1000, every_scan=True),
        most_taps=ladder.most_taps,
        clock_ns=clock,
    )
    sinks = [JsonLinesSink(str(tmp_path / "records.jsonl")), ModelSteps(ladder, runtime, clock), ListSink()]
    statistics = Statistics()
    for number in range(1200):
        clock.now_ns = number * 10_000_000
        clock.load = 2.0 if 200 <= number < 400 else 1.0
        # Two taps before, so that the number of taps used tells which model it was.
        press = 0 if number < 20 and number % 10 < 5 else 1400
        result = runtime.push(make_scan(number, press_counts=press, noise=3))
        statistics.add(result)
        for sink in sinks:
            sink.write(result, {})
    sinks[0].close()
    records = [json.loads(line) for line in (tmp_path / "records.jsonl").read_text().splitlines()]
    events = {record["scan"]: record["event"] for record in records if record["event"]}
    first, down, up = events
    assert events[first] == ladder.choice.why and first == 0
    assert re.fullmatch(
        r"stepped down from mtsr4 to stsr-int8: budget of 1500 us missed in \d+ of 100 patterns of the last second",
        events[down],
    )
    assert events[up].startswith("stepped up from stsr-int8 to mtsr4: p99 of 1400 us expected, within 1500 us for 5 s")
    assert 250 <= down <= 260 and 895 <= up <= 960
    models_used = [record["model"] for record in records]
    assert models_used == ["mtsr4"] * down + ["stsr-int8"] * (up - down) + ["mtsr4"] * (1200 - up)
    assert {record["taps_used"] for record in records[20:down] + records[up:]} == {2}
    assert {record["taps_used"] for record in records[down:up]} == {1}
    assert all(len(record["pattern"]) == 40 for record in records[20:])
    assert statistics.model_changes == 2
    assert f"model changes: 2 (patterns: mtsr4 {1190 - up + down}, stsr-int8 {up - down})" in statistics.summary(
        source="x"
    )


def test_a_result_of_the_model_before_is_no_evidence(tmp_path):
    clock = Clock()
    rungs = (Candidate("a", 35.2, 800.0, 1100.0), Candidate("b", 35.3, 1000.0, 1400.0))
    models = {name: ModelSession(write(tmp_path / f"{name}.onnx", 1, 35.0)) for name in "ab"}
    runtime = Runtime(models["a"], source="device", baselines={"4": BASELINE}, clock_ns=clock)
    late = runtime.push(make_scan(press_counts=3000))
    assert late.model == "a" and late.run_time_us is not None
    late = replace(late, run_time_us=9000.0)
    steps = ModelSteps(Ladder(choose(rungs, 1500.0), 1500.0, models), runtime, clock)
    for _ in range(1000):
        clock.now_ns += 10_000_000
        steps.write(late, {})
    assert runtime.push(make_scan(1)).model == "b"


@pytest.fixture(scope="module")
def rest(tmp_path_factory):
    """A pad at rest, for a while."""
    path = tmp_path_factory.mktemp("rest") / "rest.csv"
    header = ",".join(f"txl{taxel}_{axis}" for taxel in range(1, 17) for axis in "xyz")
    path.write_text("\n".join([header, *[",".join(["30000.0"] * 48)] * 20, ""]))
    return path


class TestCommandLine:
    def run(self, rest, cache, *arguments):
        command = [sys.executable, "-m", "edge.cli.main", "--source", f"replay:{rest}", "--rate-hz", "1000"]
        return subprocess.run(
            [*command, "--sink", "jsonl:-", *arguments],
            cwd=ROOT,
            capture_output=True,
            text=True,
            timeout=60,
            stdin=subprocess.DEVNULL,
            env=os.environ | {"XDG_CACHE_HOME": str(cache)},
        )

    def test_a_budget_chooses_of_the_bundled_ones_and_the_first_record_says_why(self, rest, tmp_path):
        kept = CalibrationCache(cache_path({"XDG_CACHE_HOME": str(tmp_path)}), 1000.0)
        best, small = (bundle.find_model(name) for name in ("stsr-int8", "stsr-small-int8"))
        kept.keep({best: RunTime(800.0, 1100.0), small: RunTime(400.0, 600.0)})
        for budget, model, words in (
            ("1", "stsr-small-int8", "warning: budget 1 us: no model fits, stsr-small-int8 ("),
            ("1000", "stsr-small-int8", "budget 1000 us: stsr-small-int8 ("),
            ("100000", "stsr-int8", "budget 100000 us: stsr-int8 ("),
        ):
            done = self.run(rest, tmp_path, "--budget-us", budget)
            assert done.returncode == 0 and done.stderr.startswith(words), done.stderr
            got = [json.loads(line) for line in done.stdout.splitlines()]
            assert len(got) == 20 and {record["model"] for record in got} == {model}
            assert got[0]["event"].startswith(f"budget {budget} us: ") and done.stderr.count(got[0]["event"]) == 1
            assert {record["event"] for record in got[1:]} == {None}

    def test_what_is_not_known_is_measured_and_a_cache_that_cannot_be_is_one_line(self, rest, tmp_path):
        write(tmp_path / "mine.onnx", 1, 33.0)
        done = self.run(rest, "/dev/null", "--budget-us", "1e6", "--model", str(tmp_path / "mine.onnx"))
        assert done.returncode == 0 and json.loads(done.stdout.splitlines()[0])["model"] == "mine"
        assert f"calibrating mine: {ROUNDS * ROUND_TICKS} patterns each at 1000 Hz" in done.stderr.splitlines()
        assert done.stderr.count("run times are measured at each start: /dev/null/edge-sr/calibration.json: ") == 1

    def test_every_rung_can_take_over_whichever_it_begins_with(self, bundled, rest, tmp_path, monkeypatch):
        def by_taps(models, rate_hz, stop):
            return [RunTime(100.0 * model.contract.taps, 100.0 * model.contract.taps) for model in models]

        class Hurried(ModelSteps):
            def __init__(self, ladder, runtime):
                super().__init__(ladder, runtime)
                assert ladder.model.name == "stsr" and list(ladder.models) == ["mtsr4", "stsr"]
                for name, model in ladder.models.items():
                    runtime.change_model(model, name)

        monkeypatch.setattr("edge.budgeting.model_steps.calibrate", by_taps)
        monkeypatch.setattr("edge.budgeting.model_steps.ModelSteps", Hurried)
        monkeypatch.setattr("sys.stdin", None)
        monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
        budget = ["--model", "mtsr4", "--budget-us", "300"]
        records = tmp_path / "records.jsonl"
        assert cli.main(["--source", f"replay:{rest}", "--rate-hz", "1000", "--sink", f"jsonl:{records}", *budget]) == 0
        assert json.loads(records.read_text().splitlines()[0])["event"].endswith("; mtsr4; stsr")

    def test_stopped_while_it_calibrates_it_ends_at_once(self, tmp_path, monkeypatch, capsys, rest):
        def stopped(*arguments, stop, **settings):
            stop.set()

        monkeypatch.setattr("edge.budgeting.model_steps.calibrate", stopped)
        monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
        assert (
            cli.main(["--source", f"replay:{rest}", "--rate-hz", "100", "--budget-us", "1000", "--sink", "jsonl:-"])
            == 0
        )
        out, err = capsys.readouterr()
        assert out == "" and err.count("\n") == 1
