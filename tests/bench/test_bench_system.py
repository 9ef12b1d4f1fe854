"""The bench of the whole program: what it measures, what it makes of it, and where it shows it."""

import csv
import time
from dataclasses import replace

import pytest

from edge.bench import system, system_section
from edge.bench.program import Line, Play, edge_sr, plain_loop
from edge.bench.provenance import read_provenance
from edge.bench.system import Losses, StartUp, SystemRow, latencies_ns
from edge.bench.targets import verdicts
from edge.bench.timing import summary
from edge.cli.main import main

HAND = system.hand_names(system.HAND)
QUICK = summary([700_000] * 1000)
ROW = SystemRow(0.2, 1.0, (0.6, 0.4), 70.0, 3, 20.0, 0.5, system.IDLE, 1000)
ROWS = {
    row.name: row
    for row in (
        ROW,
        replace(ROW, name=system.PLAIN, cpu_percent=2.0),
        replace(ROW, name=system.TWO_RECORDED, run_time=QUICK, latency=QUICK, losses=Losses(0, 0, 0, 0)),
        replace(ROW, name=system.MOVING, run_time=QUICK, latency=QUICK, losses=Losses(0, 0, 0, 0)),
        replace(ROW, name=HAND[0], cpu_percent=5.0),
        replace(ROW, name=HAND[1], cpu_percent=20.0),
        replace(ROW, name=HAND[2]),
        replace(ROW, name=HAND[3], run_time=QUICK, latency=QUICK, losses=Losses(0, 0, 0, 0), resident_mb=110.0),
        replace(ROW, name=system.FAST, latency=QUICK, losses=Losses(0, 0, 0, 0)),
    )
}
STARTED = StartUp((0.9, 0.2, 0.3), 75.0)
SLOW = summary([9_000_000] * 1000)


def test_a_run_is_measured_from_the_last_byte_of_each_scan(tmp_path):
    with edge_sr(tmp_path, Play(sensors=2, pressed=500, moving=True), "--every-scan") as program:
        assert 0 < program.first_pattern_s() < 60
        program.lines(60.0, most=100)
        usage, lines = system._Usage(program), program.lines(0.5)
        used = usage.since()
    row = system._recorded("two", lines, used, program.stamps_ns())
    assert row.scans == len(lines) > 10
    assert {line.record["sensor"] for line in lines} == {"4", "6"}
    assert row.run_time is not None and row.latency is not None
    told_us = [line.record["latency_us"] for line in lines if line.record["latency_us"] is not None]
    assert row.latency.max_us >= max(told_us), "the way to the read and that of the record are in it"
    assert row.cpu_percent == pytest.approx(sum(row.thread_percent), abs=0.1) and row.cpu_percent > 0
    assert row.resident_mb > 20


def test_the_plain_loop_reads(tmp_path):
    with plain_loop(tmp_path, Play(rate_hz=1000.0)) as program:
        time.sleep(0.3)
        usage = system._Usage(program)
        time.sleep(0.2)
        assert usage.since().cpu_percent > 0.1


def test_latency_is_taken_scan_by_scan_and_sensor_by_sensor():
    lines = [Line(time_ns, {"sensor": name, "scan": scan}) for time_ns, name, scan in ((50, "4", 1), (70, "6", 0))]
    assert latencies_ns(lines, {"4": [10, 20], "6": [65]}) == [30, 5]


def test_who_lost_scans_has_no_latency():
    counters = dict.fromkeys(("late", "dropped", "overruns", "torn_wire", "missing_taxels", "duplicates"), 0)
    lines = [
        Line(9, {"sensor": "4", "scan": 0, "run_time_us": 5.0, "counters": counters | {"overruns": n}}) for n in (0, 1)
    ]
    used = system.Used(1.0, 1.0, (1.0,), 70.0, 0, 0.0, 0.0)
    row = system._recorded("x", lines, used, {"4": [1]})
    assert row.latency is None and row.losses == Losses(0, 0, 1, 0)
    assert system._recorded("x", lines[:1], used, {"4": [1]}).latency == summary([8])


def test_every_target_is_judged_and_a_missed_one_says_why():
    assert [(verdict.held, verdict.limited_by) for verdict in verdicts(ROWS, STARTED)] == [(True, "")] * 13
    worse = {
        name: replace(
            row,
            cpu_percent=10.0 if name == system.PLAIN else 130.0,
            resident_mb=121.0,
            run_time=row.run_time and SLOW,
            latency=row.latency and SLOW,
            losses=row.losses and Losses(1, 2, 0, 0),
        )
        for name, row in ROWS.items()
    }
    missed = list(verdicts(worse, StartUp((0.8, 0.9, 0.1), 75.0)))
    assert len(missed) == 13 and not any(verdict.held for verdict in missed)
    assert missed[0].limited_by == "the plain loop alone takes 10.0 %; ours, by threads: 0.6 + 0.4 %"
    assert missed[3].limited_by == "inference alone takes 90.0 % at 100 Hz"
    assert list(verdicts({}, None)) == []


def test_the_page_the_json_and_the_table_tell_it(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(system_section, "rows", lambda scans, tell: (r for r in ROWS.values() if r.name not in HAND))
    monkeypatch.setattr(system_section, "hand_rows", lambda sensors, scans, tell: (ROWS[name] for name in HAND))
    monkeypatch.setattr(system_section, "start_up", lambda: STARTED)
    assert main(["bench", "--system", "--out", str(tmp_path)]) == 0
    out = capsys.readouterr().out
    assert out.count("| yes |") == 13 and "0.90, 0.20, 0.30 s" in out
    page = (tmp_path / "bench.md").read_text()
    assert out.split("\n\n", 1)[1].strip() in page and read_provenance(page) is not None
    table = list(csv.DictReader((tmp_path / "bench.csv").open()))
    assert [row["method"] for row in table] == [*(name for name in ROWS if name not in HAND), *HAND]
    assert "latency_p999_us" in table[0]


def test_a_hand_is_measured_alone_and_row_by_row(tmp_path, monkeypatch, capsys):
    """Six sensors on two buses, for a moment each."""
    monkeypatch.setattr(system, "SETTLE_S", 0.5)
    assert main(["bench", "--sensors", "6", "--ticks", "30", "--out", str(tmp_path)]) == 0
    rows = list(csv.DictReader((tmp_path / "bench.csv").open()))
    names = system.hand_names(6)
    assert [row["method"] for row in rows] == list(names)
    out = capsys.readouterr().out
    assert f"| {names[3]} |" in out and "Targets" not in out, "the targets are of one, two and sixteen sensors"
    assert float(rows[3]["run_time_p50_us"]) > 0 and float(rows[3]["resident_mb"]) > 20
