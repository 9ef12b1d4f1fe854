"""Keys in docs/formats.md are those that exist, and figures of the pages are those of the reports."""

import json
import re
import tomllib
from dataclasses import fields

import field_tables
import numpy as np
import onnx
import pytest
from doctor_samples import healthy_counts
from edge_samples import BASELINE, ROOT

from edge.api import Statistics, open_source
from edge.cli import main as cli
from edge.inference.bundled import demo_recording, find_model
from edge.inference.contract import KEY_PREFIX, Contract
from edge.perception.result import REASON_TEXTS
from edge.sinks.json_records import CHOICES, PROGRESS
from firmware_bridge.pad_geometry import CHANNELS
from firmware_bridge.scans.mounting import Mounting
from firmware_bridge.scans.pad_constants import PAD_RANGES, Pad
from firmware_bridge.sensor_file.model import SensorEntry, SensorFile
from firmware_bridge.sensor_file.toml_writer import save_sensor_file
from firmware_bridge.zeroing.baseline import save_baselines
from train.data import presses

FORMATS = (ROOT / "docs" / "formats.md").read_text()
MEASURED = "reports/bench.md"
FAMILIES = {
    "bilinear": "bilinear",
    "linear map": "linear map",
    "the eight nearest training presses": "nearest 8",
    "the default, nothing known of the pad": "model",
    "the default, pad and gains known": "model, all known",
}
"""Names that the README gives to rows of reports/families.md."""


def told(heading: str, page: str = FORMATS) -> set[str]:
    """Keys of the table under a heading of a page."""
    section = page.split(f"## {heading}\n", 1)[1].split("\n## ", 1)[0]
    first = [re.split(r"(?<!\\)\|", line)[1] for line in section.splitlines() if line.startswith("| `")]
    return {key for cell in first for key in re.findall(r"`([\w.]+)`", cell)}


@pytest.mark.parametrize("page", field_tables.TABLES)
def test_tables_of_fields_are_those_of_the_code(page):
    written = (field_tables.DOCS / page).read_text()
    assert written == field_tables.with_tables(page), "write them: python tests/docs/field_tables.py"


def test_keys_of_a_record(tmp_path):
    path = tmp_path / "records.jsonl"
    sinks = ["--sink", f"jsonl:{path}", "--sink", f"mcap:{tmp_path / 'records.mcap'}"]
    assert cli.main(["replay", str(demo_recording()), *sinks]) == 0
    assert cli.main(["convert", str(tmp_path / "records.mcap"), str(tmp_path / "records.npz")]) == 0
    keys = {key for line in path.read_text().splitlines() for key in json.loads(line)}
    assert keys | {"vendor_force_n", "temperature_k"} == told("Records")
    with np.load(tmp_path / "records.npz") as arrays:
        of_robot = {name for name in arrays.files if name == "pose" or name.startswith("pose_")}  # on the page of poses
        assert set(arrays.files) - of_robot <= told("Records") | told("npz")


def test_fields_take_what_the_pages_say_of_a_record_alone():
    for name in told("Records") | {"contacts"}:
        assert cli.parsed_options("demo", ["--sink", "jsonl:-", "--fields", name]).fields == name
    assert set(CHOICES) == told("Records") | {"contacts"}


def test_each_counter_is_explained_those_of_good_runs_first():
    page = (ROOT / "docs" / "run.md").read_text()
    links = ("slcan:/dev/ttyUSB0", "gs_usb", "can:socketcan:can0", "xela-server:ws://127.0.0.1")
    counters = {name for link in links for name in open_source(link).counters()} | Statistics().counters().keys()
    assert counters == told("When the wire fails", page)
    first = next(line for line in page.splitlines() if line.startswith("| `received_bytes`"))
    assert {*re.findall(r"`(\w+)`", first), "poses"} == PROGRESS


def test_keys_of_the_contract_and_of_datasets():
    assert {field.name for field in fields(Contract)} == told("The contract in a model")
    assert set(presses._AXES) == told("Datasets")
    stated = {one.key: one.value for one in onnx.load(find_model("stsr")).metadata_props}
    of_one_sensor = {"made_for"}
    assert {f"{KEY_PREFIX}{name}" for name in told("The contract in a model") - of_one_sensor} <= set(stated)


def test_each_reason_and_each_field_of_trust_is_on_its_page():
    page = (ROOT / "docs" / "trust.md").read_text()
    explained = re.findall(r"^\| `(\w+)` \|", page.split("## The reasons", 1)[1].split("##", 1)[0], re.MULTILINE)
    assert sorted(explained) == sorted(REASON_TEXTS)
    for field in ("trusted", "untrusted_reason", "mismatch", "tap_mismatch", "taps_dropped"):
        assert field in told("Records") and f"`{field}`" in page


def test_keys_of_baseline_and_sensor_files(tmp_path):
    baseline = BASELINE.of("4", healthy_counts(1)[0], 1000.0, 100, "file")
    save_baselines(tmp_path / "zero.json", [baseline], {"4": tuple(range(16))})
    document = json.loads((tmp_path / "zero.json").read_text())
    assert set(document) == {"format", "version", "baselines"}
    assert set(document["baselines"][0]) == told("Baseline file")
    constants = {name: low or high for name, (low, high) in PAD_RANGES.items()}
    pad = Pad(
        **constants, intervals={"thickness_mm": (0.1, 5)}, gains=(1.0,) * CHANNELS, gain_half_widths=(0.1,) * CHANNELS
    )
    marks = {"assumed": frozenset({"mounting"}), "emulated": frozenset({"force"})}
    marks |= {"counts_per_newton_interval": (1100.0, 1260.0)}
    sensors = {"4": SensorEntry(Mounting(swap_xy=True), 1180.0, baseline, pad, pad, **marks)}
    save_sensor_file(tmp_path / "sensor.toml", SensorFile(adapter="D30BL366", sensors=sensors))
    document = tomllib.loads((tmp_path / "sensor.toml").read_text())
    entry = document.pop("sensors")["4"]
    assert set(entry.pop("baseline")) == {"id", "created_unix_s", "scans", "x", "y", "z"}
    assert entry["learned"] == entry["pad"]
    assert set(entry.pop("pad")) | set(document) | set(entry) - {"learned"} == told("Sensor file")


def rows(text: str) -> list[list[str]]:
    lines = (line.strip("|").split("|") for line in text.splitlines() if line.startswith("| "))
    return [[cell.strip().removeprefix("* ").strip("*") for cell in cells] for cells in lines]


def test_figures_of_methods_are_those_of_the_report():
    """Each number of a row is in one of the rows that the report has of that method."""
    report = [[cell.removesuffix(" of 3000") for cell in row] for row in rows((ROOT / MEASURED).read_text())]
    names = {row[0] for row in report}
    checked = 0
    for method, *cells in rows((ROOT / "docs" / "models.md").read_text()):
        if method not in names or not any(re.fullmatch(r"[\d.]+", cell) for cell in cells):
            continue
        measured = {cell for row in report if row[0] == method for cell in row[1:]}
        assert set(cells) - measured - {"-", "1", "2", "4", "7"} == set(), method
        checked += 1
    assert checked > 15


def test_figures_of_the_readme_are_those_of_the_families_report():
    """Each number of a row is one of that method's first row in the report, rounded as the README has it."""
    report = {}
    for method, *cells in rows((ROOT / "reports" / "families.md").read_text()):
        report.setdefault(method, [float(number) for cell in cells for number in re.findall(r"\d+(?:\.\d+)?", cell)])
    readme = {method: cells for method, *cells in rows((ROOT / "README.md").read_text())}
    for name, method in FAMILIES.items():
        numbers = [number for cell in readme[name] for number in re.findall(r"\d*\.?\d+", cell)]
        assert len(numbers) == 6
        for number in numbers:
            rounded = {round(value, len(number.partition(".")[2])) for value in report[method]}
            assert float(number) in rounded, (name, number)
