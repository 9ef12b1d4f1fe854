"""Record of a bench, and the comparison of two."""

import csv
import io
import json
from dataclasses import replace

import pytest

from edge.bench.accuracy import ErrorRow
from edge.bench.compare import compared
from edge.bench.errors import BenchError
from edge.bench.machine import this_machine
from edge.bench.record import Facts, Record, RunTimeRow, read_record
from edge.bench.report import about, compare_text, run_time_columns, run_time_line
from edge.bench.timing import Pace, Times


def times(p50_us, runs=3000):
    return Times(runs, p50_us, p50_us + 1, p50_us + 2, p50_us + 3, tuple(p50_us + block % 3 - 1 for block in range(30)))


def run_time(name, paced_us, threads=1, load=False):
    pace = Pace(times(paced_us), 3000, 2, 7.5)
    return RunTimeRow(name, threads, load, times(paced_us / 2), pace, 10.0, 20.0, 300.0, 70.0)


def make_record(*rows, **settings):
    errors = [
        ErrorRow("fast", 1, {"rmse_percent": 5.0, "psnr_db": 27.0}, {}),
        ErrorRow("slow", 1, {"rmse_percent": 4.0, "psnr_db": 28.0}, {}),
        ErrorRow("slow", 4, {"rmse_percent": 2.0, "psnr_db": 35.0}, {}),
    ]
    facts = [
        Facts("fast", "classical", 100),
        Facts("slow", "model", 4_000_000),
        Facts("peer x", "peer", 9, ("LSTM",), "random"),
    ]
    asked = {"rate_hz": 100.0, "ticks": 3000, "threads": [1], "load": "", "seeds": {}}
    record = Record("2026-01-02", "edge-sr bench", this_machine(), asked | settings, complete=True)
    record.peak_gmac_s[1] = 50.0
    record.facts, record.errors = facts, errors
    record.run_times = list(rows or (run_time("slow", 900.0), run_time("fast", 100.0), run_time("peer x", 5000.0)))
    return record


def test_the_front_is_of_the_fewest_threads_alone():
    quicker = [run_time("slow", 10.0, threads=2), run_time("slow", 20.0, load=True)]
    rows = make_record(run_time("slow", 900.0), run_time("fast", 100.0), *quicker).front_rows()
    assert [(row.name, row.given, row.paced_p50_us, row.on_front) for row in rows] == [
        ("fast", 1, 100.0, True),
        ("slow", 1, 900.0, False),
        ("slow", 4, 900.0, True),
    ]
    assert make_record().front_rows()[0].back_to_back_p50_us == 50.0


def test_what_is_written_is_read_again(tmp_path):
    path = tmp_path / "bench.json"
    path.write_text(make_record().to_json())
    told = read_record(path)
    assert told["front"][0]["on_front"] is True
    assert len(told["run_times"][0]["paced"]["times"]["block_p50_us"]) == 30


def test_a_flat_line_for_every_error_and_run_time():
    lines = list(csv.DictReader(io.StringIO(make_record().to_csv())))
    assert [(line["method"], line["taps_given"], line["paced_p50_us"], line["on_front"]) for line in lines] == [
        ("fast", "1", "100.0", "True"),
        ("slow", "1", "900.0", "False"),
        ("slow", "4", "900.0", "True"),
        ("peer x", "", "5000.0", ""),
    ]
    assert (lines[3]["weights"], lines[3]["psnr_db"]) == ("random", "")


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        ("{", "cannot be read"),
        ("[]", "is not a bench"),
        ('{"format": "other"}', "is not a bench"),
        ('{"format": "tactile bench", "version": 9}', "is of version 9, expected 1: run that bench again"),
    ],
)
def test_what_is_no_bench_of_this_version_is_refused(tmp_path, content, complaint):
    path = tmp_path / "old.json"
    path.write_text(content)
    with pytest.raises(BenchError, match=complaint):
        read_record(path)


def test_a_comparison_gives_ratios_and_names_what_is_in_one_alone(tmp_path):
    old = make_record(run_time("slow", 800.0), run_time("gone", 1.0), rate_hz=50.0)
    old.complete, old.machine = False, replace(old.machine, onnxruntime="0.1")
    old.peak_gmac_s[1] = 40.0
    new = make_record(run_time("slow", 400.0), run_time("slow", 5.0, threads=2, load=True))
    found = compared(new, json.loads(old.to_json()), tmp_path)
    (row,) = found.rows
    assert (row.name, row.paced.ratio, row.back_to_back.ratio) == ("slow", 0.5, 0.5)
    assert row.paced.differs
    assert found.only_old == ("gone, 1 thread",)
    assert found.only_new == ("slow, 2 threads, under load",)
    assert found.peak == {1: 1.25}
    assert found.differences[0].endswith("was 0.1")
    assert found.differences[1:] == ("rate_hz is 100.0, was 50.0", "the earlier bench was stopped before its end")
    text = compare_text("old.json", found)
    assert all(part in text for part in ("1.25 on 1", "was 0.1", "gone, 1 thread", "slow, 2 threads, under load"))


def test_a_comparison_with_itself_finds_no_difference(tmp_path):
    found = compared(make_record(), json.loads(make_record().to_json()), tmp_path)
    assert [row.paced.differs or row.back_to_back.differs for row in found.rows] == [False] * 3
    assert (found.only_old, found.only_new, found.differences) == ((), (), ())


def test_a_damaged_bench_is_refused_and_the_key_named(tmp_path):
    old = json.loads(make_record().to_json())
    del old["run_times"][0]["paced"]
    with pytest.raises(BenchError, match=r"damaged .*paced"):
        compared(make_record(), old, tmp_path)


def test_a_peer_is_a_line_with_as_many_cells_that_says_what_it_is():
    row, fact = run_time("peer x", 5000.0), make_record().facts[2]
    cells = run_time_line(row, fact).split("|")
    assert len(cells) == len(run_time_columns(100.0)) + 2
    assert cells[1].strip() == "peer x (run time only, weights random)"
    assert cells[4].strip() == "0.00 without LSTM"


def test_percentiles_of_few_runs_are_not_claimed():
    row = replace(run_time("slow", 10.0), back_to_back=times(5.0, runs=999))
    cells = [cell.strip() for cell in run_time_line(row, make_record().facts[1]).split("|")]
    columns = ["", *run_time_columns(100.0)]
    assert cells[columns.index("back to back p99.9 us")] == "-"
    assert cells[columns.index("100 Hz p99.9 us")] == "12"
    assert "p99.9 and misses mean little" in about(make_record(ticks=2999))
    assert "mean little" not in about(make_record())
