"""`edge-sr bench`, run times on a clock of its own, reports that know their age, and the cost of the program."""

import csv
import os
import re
import signal
import subprocess
import sys
import time
from dataclasses import replace

import program_cost
import pytest
from cli_samples import run
from edge_samples import ROOT, make_contract, wait_for, write_model

from edge.bench import command
from edge.bench import provenance as reports
from edge.bench.provenance import UNKNOWN, file_hash, provenance, read_provenance, with_head
from edge.bench.subjects import Subject, error_rows
from edge.bench.timing import back_to_back, paced
from edge.cli.main import main
from edge.evaluation.test_set import judge_model, load_frozen_set, mean_error
from edge.inference.bundled import BUNDLE_DIR, DEFAULT_MODEL, find_model
from edge.inference.onnx_session import ModelSession


def test_every_model_has_its_error_and_run_time_on_a_page(tmp_path):
    """But for the error of one of another scale; a broken one is left out."""
    mine = tmp_path / "mine"
    mine.mkdir()
    write_model(mine / "tiny.onnx", make_contract(taps=1))
    write_model(mine / "coarse.onnx", make_contract(scale=4))
    (mine / "broken.onnx").write_text("no model")
    arguments = ["--ticks", "30", "--models", str(mine)]
    done = run("bench", *arguments, "--only", "mine/tiny", "mine/coarse", "bilinear", "--out", str(tmp_path / "out"))
    assert done.returncode == 0, done.stderr
    with (tmp_path / "out" / "bench.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["method"] for row in rows if row["psnr_db"]] == ["bilinear", "mine/tiny"]
    timed = {row["method"]: float(row["paced_p50_us"]) for row in rows if row["paced_p50_us"]}
    assert list(timed) == ["bilinear", "mine/coarse", "mine/tiny"] and min(timed.values()) > 0
    left_out, run_time_only = done.stderr.splitlines()
    assert left_out.startswith("edge-sr: left out: ") and "broken.onnx: not a model that onnx" in left_out
    assert "run time only of mine/coarse" in run_time_only and "'scale' is 4, the test set's is 10" in run_time_only
    page = (tmp_path / "out" / "bench.md").read_text()
    made = read_provenance(page)
    assert made is not None and page == with_head(done.stdout, made)
    assert made.command.startswith("edge-sr bench --ticks 30")


def test_the_error_is_that_which_contracts_are_judged_by():
    session, some = ModelSession(find_model("mtsr")), load_frozen_set(BUNDLE_DIR / "frozen.npz").thinned(9)
    rows = list(error_rows(Subject("mtsr", str(find_model("mtsr"))), some))
    assert [row.given for row in rows] == [1, session.contract.taps]
    for row in rows:
        assert row.error == mean_error(judge_model(session, some, row.given))
        assert row.error.keys() == session.contract.test_error[str(row.given)].keys()


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["--models", "/nowhere"], "--models /nowhere: not a folder"),
        (["--models", str(ROOT / "docs")], "holds no .onnx file"),
        (["--out", str(ROOT / "README.md")], "cannot be made"),
    ],
)
def test_unusable_input_is_said_in_a_line_before_measuring(arguments, complaint, capsys):
    assert main(["bench", *arguments]) in (2, 4)
    said = capsys.readouterr()
    assert complaint in said.err and said.err.count("\n") == 1 and said.out == ""


def test_a_child_that_fails_is_named_with_its_reason():
    subject = {"name": "lost", "path": "/nowhere.onnx"}
    with pytest.raises(command.BenchError, match=r"of lost was not measured: /nowhere.onnx: cannot be read"):
        command.measured({"subject": subject, "rate_hz": 100.0, "ticks": 1})


def in_group(group: int) -> bool:
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return False
    return True


def test_ctrl_c_ends_it_in_a_line_and_keeps_what_was_measured(tmp_path):
    arguments = ["bench", "--only", "linear map", "--ticks", "100000", "--out", str(tmp_path)]
    how = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True, "start_new_session": True}
    with subprocess.Popen([sys.executable, "-m", "edge.cli.main", *arguments], cwd=ROOT, **how) as process:
        assert process.stdout is not None
        while "| linear map | 1 |" not in process.stdout.readline():
            pass
        time.sleep(0.2)
        process.send_signal(signal.SIGINT)
        _, complaint = process.communicate(timeout=60)
    assert process.returncode == 130
    assert complaint == f"edge-sr: bench stopped before its end: what was measured is in {tmp_path}\n"
    wait_for(lambda: not in_group(process.pid))  # soon no process of it is left
    with (tmp_path / "bench.csv").open() as file:
        (row,) = csv.DictReader(file)
    assert row["method"] == "linear map" and "paced_p50_us" not in row


SOURCE = "edge/bench/subjects.py"


@pytest.fixture(scope="module")
def made():
    return provenance('python x.py --out "a b"', [ROOT / SOURCE, "edge/bench"], [find_model(DEFAULT_MODEL)], seed=3)


def test_a_head_is_read_as_written_with_the_hashes_of_its_inputs(made):
    page = with_head("# mine\n\nText.\n", made)
    assert page.startswith("# mine\n\n```toml\ncommand = ") and page.endswith("```\n\nText.\n")
    assert read_provenance(page) == made
    bare = replace(made, seed=None, models={})
    assert read_provenance(with_head("# b\n", bare)) == bare
    assert made.sources == {name: file_hash(ROOT / name) for name in (SOURCE, "edge/bench")} and made.seed == 3
    assert made.models == {f"edge/models/{DEFAULT_MODEL}.onnx": file_hash(find_model(DEFAULT_MODEL))}
    for head in ("", "```toml\ncommand = \n```\n", '```toml\ncommand = "x"\n```\n'):
        assert read_provenance(f"# none, or damaged\n\n{head}") is None
    assert made.tree in {"clean", "changed", UNKNOWN} and len(set(made.sources.values())) == 2


def test_a_source_has_changed_where_its_code_has(tmp_path):
    (path := tmp_path / "a.py").write_text('"""A."""\nimport a\n\n\ndef f():\n    """Return 1."""\n    return 1\n')
    before = file_hash(path)
    path.write_text('"""Other."""\nimport b\n\n\ndef f():  # why\n    return 1\n')
    assert file_hash(path) == before
    path.write_text('"""A."""\nimport a\n\n\ndef f():\n    """Return 1."""\n    return 2\n')
    assert file_hash(path) != before


def test_a_report_is_stale_and_the_line_says_why(made, tmp_path, capsys):
    (tmp_path / "load").mkdir()
    for change, why in (
        ({"models": {"gone.onnx": "0" * 12}}, "gone.onnx is not here"),
        ({"sources": {SOURCE: "0" * 12}}, f"{SOURCE} has changed"),
    ):
        (tmp_path / "load/mine.md").write_text(with_head("# mine\n", replace(made, **change)))
        reports.main([str(tmp_path)])
        assert capsys.readouterr().out == f"load/mine.md: stale, of {made.date[:10]} ({made.commit}): {why}\n"


def test_every_report_has_a_head():
    pages = sorted((ROOT / "reports").rglob("*.md"))
    assert [page.name for page in pages if read_provenance(page.read_text()) is None] == []
    assert len(pages) > 5


class Clock:
    """Goes on when someone sleeps or works."""

    now_ns = 1_000_000

    def __call__(self):
        return self.now_ns

    def sleep(self, time_s):
        self.now_ns += round(time_s * 1e9)

    def work(self, *took_ms):
        """Return a run that takes these times in turn, then always the last one, and the list of its numbers."""
        numbers = []

        def run(number):
            numbers.append(number)
            self.now_ns += round(1e6 * took_ms[min(len(numbers), len(took_ms)) - 1])

        return run, numbers


@pytest.mark.parametrize(
    ("took_ms", "ticks", "done", "missed"),
    [
        ((2,), 20, range(1, 21), 0),
        ((2, 12, 2), 10, range(1, 11), 1),  # not done when the next is due
        ((2, 35, 2), 10, [1, 2, 5, 6, 7, 8, 9, 10], 3),  # due at 20 ms, done at 55: 3 and 4 have passed, 5 begins late
        ((60,), 30, [1, 7, 13, 19, 25], 30),
    ],
)
def test_ticks_whose_run_is_not_done_in_time_are_missed(took_ms, ticks, done, missed):
    clock = Clock()
    run, numbers = clock.work(*took_ms)
    found = paced(run, 100.0, ticks, clock, clock.sleep, cpu_clock=lambda: clock.now_ns // 4)
    assert (numbers, found.missed, found.ticks, found.times.runs) == ([*done], missed, ticks, len(numbers))
    assert found.cpu_percent == pytest.approx(25) and found.times.max_us == 1e3 * max(took_ms)


def test_back_to_back_is_as_many_runs_as_fit():
    for took_ms, most, runs in ((1, 3000, 2000), (0.1, 3000, 3000), (200, 3000, 90)):
        run, _ = (clock := Clock()).work(took_ms)
        found = back_to_back(run, most, clock)
        assert (found.runs, found.p50_us) == (runs, took_ms * 1000)


def test_the_programs_cost_is_a_line_for_rest_and_for_contact(limits, capsys):
    limits(program_cost, SETTLE_S=0.5, ROUNDS=1)
    assert program_cost.main(["--round-s", "0.5"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.partition(":")[0] for line in lines] == ["at rest, 1 sensors, now", "in contact, 1 sensors, now"]
    assert all(float(re.search(r"cpu_percent ([\d.]+)", line)[1]) > 0 for line in lines)
    p50_us = re.search(r"p50_us ([\d.e+]+)", lines[1])  # none where a busy machine lost frames
    assert p50_us is None or float(p50_us[1]) > 50
