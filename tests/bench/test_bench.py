"""`edge-sr bench` as a whole, and the errors that it reports."""

import io
import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace

import numpy as np
import pytest
from edge_samples import ROOT, make_contract, write_model

from edge.bench import command, processes
from edge.bench import peer_ratios as against
from edge.bench.accuracy import FORCE_RANGE_N, error_rows, force_error_percent, force_floor_percent
from edge.bench.command import Settings, run
from edge.bench.contenders import Subject, bundled_subjects, classical_subjects
from edge.bench.errors import BenchError
from edge.bench.plot import draw
from edge.bench.provenance import read_provenance, with_head
from edge.cli.main import main
from edge.errors import ModelError
from edge.evaluation.test_set import load_frozen_set
from edge.inference.bundled import BUNDLE_DIR, find_model
from edge.inference.onnx_session import ModelSession

FROZEN = load_frozen_set(BUNDLE_DIR / "frozen.npz")
MTSR2 = Subject("mtsr2", "model", str(find_model("mtsr2")))


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    """One small bench with everything in it, and where it wrote."""
    folder = tmp_path_factory.mktemp("bench")
    mine = folder / "mine"
    mine.mkdir()
    write_model(mine / "tiny.onnx", make_contract(taps=1))
    write_model(mine / "coarse.onnx", make_contract(scale=4))
    (mine / "broken.onnx").write_text("no model")
    peer = write_model(folder / "theirs.onnx", metadata={"tactile.weights": "random, seed 0"})
    settings = Settings(
        out=folder / "out",
        rate_hz=1000.0,
        ticks=30,
        threads=(1,),
        load=True,
        models=mine,
        peers=(peer,) if peer else (),
        earlier=None,
        by_surface=True,
        only=["mine/tiny", "mine/coarse"],
        system=False,
        sensors=None,
        soak_minutes=None,
        command="edge-sr bench",
    )
    out, err = io.StringIO(), io.StringIO()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(processes, "STARTS", 1)
        patch.setattr(against, "ROUNDS", 3)
        assert run(settings, out, err) == 0
    return settings, out.getvalue(), err.getvalue(), json.loads((folder / "out" / "bench.json").read_text())


def test_everyone_is_timed_alone_and_under_load(bench):
    rows = [(row["name"], row["threads"], row["load"]) for row in bench[3]["run_times"]]
    names = ["mine/coarse", "mine/tiny", "peer theirs"]
    assert rows == [(name, 1, load) for load in (False, True) for name in names]
    assert all(row["paced"]["ticks"] == 30 and row["start_up_ms"] > 0 for row in bench[3]["run_times"])
    assert bench[3]["complete"] is True


def test_a_file_that_is_no_model_is_told_and_left_out_and_another_scale_is_run_time_only(bench):
    left_out, run_time_only = bench[2].splitlines()
    assert left_out.startswith("edge-sr: left out: ")
    assert "broken.onnx: not a model that onnxruntime can load" in left_out
    assert "run time only of mine/coarse" in run_time_only
    assert "'scale' is 4, the test set's is 10" in run_time_only
    assert [(row["name"], row["given"]) for row in bench[3]["errors"]] == [("mine/tiny", 1)]


def test_the_page_says_what_the_files_keep(bench):
    settings, out, _, told = bench
    page = (settings.out / "bench.md").read_text()
    made = read_provenance(page)
    assert made is not None and made.command == settings.command and page == with_head(out, made)
    assert (settings.out / "bench.png").read_bytes().startswith(b"\x89PNG")
    assert len((settings.out / "bench.csv").read_text().splitlines()) == 1 + 3 * 2
    assert "peer theirs (run time only, weights random, seed 0)" in out
    assert "Its weights are random, seed 0" in out
    assert [list(ratios) for ratios in told["against"].values()] == [["mine/coarse", "mine/tiny"]]
    assert "| small triangle |" in out
    for row in told["front"]:
        star = "*" if row["on_front"] else ""
        assert f"| {star} | {row['name']} | {row['given']} | {row['rmse_percent']:.2f} |" in out


def test_a_bench_can_be_held_against_itself(bench, capsys, monkeypatch):
    monkeypatch.setattr(processes, "STARTS", 1)
    monkeypatch.setattr(command, "_errors", lambda *_, **__: None)
    earlier = str(bench[0].out / "bench.json")
    arguments = ["bench", "--ticks", "10", "--rate-hz", "1000", "--threads", "1", "--only", "mine/tiny"]
    arguments += ["--models", str(bench[0].models)]
    assert main([*arguments, "--compare", earlier]) == 0
    out = capsys.readouterr().out
    assert "ticks is 10, was 30" in out
    assert "Not in this bench: mine/coarse, 1 thread; " in out
    assert out.splitlines()[-1].startswith("| mine/tiny | 1 | idle |")


def test_the_error_is_that_of_the_contract():
    contract = ModelSession(find_model("mtsr2")).contract
    rows = list(error_rows(MTSR2, FROZEN))
    assert [row.given for row in rows] == [1, 2]
    for row in rows:
        expected = contract.test_error[str(row.given)]
        assert {key: row.error[key] for key in expected} == pytest.approx(expected, rel=1e-3, abs=2e-4)
        mean_db = np.mean(list(row.psnr_db_by_surface.values()))
        assert mean_db == pytest.approx(row.error["psnr_db"], abs=1e-3)


def test_force_is_what_patterns_sum_up_to_by_the_true_patterns_own_factor():
    volume = FROZEN.patterns().sum(axis=(1, 2), dtype=np.float64)
    factor = (volume @ FROZEN.force_n) / (volume @ volume)
    floor = 100 * np.sqrt(np.mean((factor * volume - FROZEN.force_n) ** 2)) / FORCE_RANGE_N
    assert force_floor_percent(FROZEN) == pytest.approx(floor, rel=1e-4)
    nothing = 100 * np.sqrt(np.mean(FROZEN.force_n.astype(float) ** 2)) / FORCE_RANGE_N
    assert force_error_percent(0 * FROZEN.patterns(), FROZEN) == pytest.approx(nothing, rel=1e-4)
    assert FROZEN.force_n.max() == pytest.approx(FORCE_RANGE_N)


def test_a_model_of_another_scale_is_refused():
    coarse = replace(FROZEN, unit_patterns=FROZEN.unit_patterns[:, :16, :16])
    with pytest.raises(ModelError, match="'scale' is 10, the test set's is 4"):
        list(error_rows(MTSR2, coarse))


def test_all_that_is_bundled_is_measured():
    assert [subject.name for subject in classical_subjects(10)] == ["bilinear", "linear map", "bicubic"]
    assert {"stsr", "mtsr4", "stsr-int8"} <= {subject.name for subject in bundled_subjects()}


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["--only", "stsr", "nobody"], "--only nobody: not one of bicubic, bilinear, "),
        (["--models", "/nowhere"], "--models /nowhere: not a folder"),
        (["--models", str(ROOT / "docs")], "holds no .onnx file"),
        (["--against", "/nowhere.onnx"], "/nowhere.onnx: cannot be read"),
        (["--compare", "/nowhere.json"], "/nowhere.json cannot be read"),
        (["--out", str(ROOT / "README.md")], "cannot be made"),
    ],
)
def test_what_cannot_be_used_is_said_in_a_line_before_anything_is_measured(arguments, complaint, capsys):
    assert main(["bench", *arguments]) in (2, 4)
    said = capsys.readouterr()
    assert complaint in said.err
    assert said.err.count("\n") == 1
    assert said.out == ""


def test_a_load_needs_a_second_core(monkeypatch, capsys):
    monkeypatch.setattr(processes, "usable_cores", lambda: [0])
    assert main(["bench", "--load"]) == 2
    assert "--load keeps another core busy, but this process may use one" in capsys.readouterr().err


def test_a_child_that_fails_is_named_with_its_reason():
    subject = {"name": "lost", "kind": "model", "path": "/nowhere.onnx"}
    with pytest.raises(BenchError, match=r"first of lost failed: /nowhere.onnx: cannot be read"):
        processes.measured({"do": "first", "subject": subject, "threads": 1, "window": []})


def test_without_matplotlib_the_picture_alone_is_missing(bench, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(BenchError, match=r"pip install '.+\[bench\]'"):
        draw([], tmp_path / "bench.png", "")


def test_ctrl_c_ends_it_in_a_line_and_keeps_what_was_measured(tmp_path):
    arguments = ["bench", "--only", "linear map", "--ticks", "100000", "--threads", "1", "--out", str(tmp_path)]
    with subprocess.Popen(
        [sys.executable, "-m", "edge.cli.main", *arguments],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    ) as process:
        assert process.stdout is not None
        while "| linear map | 1 |" not in process.stdout.readline():
            pass
        time.sleep(0.2)
        process.send_signal(signal.SIGINT)
        _, complaint = process.communicate(timeout=60)
    assert process.returncode == 130
    assert complaint == f"edge-sr: bench stopped before its end: what was measured is in {tmp_path}\n"
    with pytest.raises(ProcessLookupError):  # no process of it is left
        os.killpg(process.pid, 0)
    told = json.loads((tmp_path / "bench.json").read_text())
    assert (told["complete"], len(told["errors"]), told["run_times"]) == (False, 1, [])
