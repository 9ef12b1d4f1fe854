"""The doctor's sensor file, never less than it held and marked where emulated, and the summary of what was found."""

import io
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from bridge_samples import write_recording
from doctor_samples import as_scans, healthy_counts
from edge_samples import BASELINE, FakeLink
from test_doctor_command import doctor, examined, recording

from edge.api import Baseline, Pad, SensorFileError, Source
from edge.cli.main import main
from edge.doctor.command import keep
from edge.doctor.findings import Finding, summary
from edge.pipeline.gain_keeper import keep_learned
from firmware_bridge.emulation.slcan_emulator import Emulator
from firmware_bridge.scans.mounting import Mounting
from firmware_bridge.sensor_file.model import PadFrame, SensorEntry, SensorFile, load_sensor_file
from firmware_bridge.sensor_file.toml_writer import save_sensor_file

GAINS = tuple(np.linspace(0.9, 1.1, 48).tolist())
TURNED = Mounting(tuple(np.rot90(np.arange(16).reshape(4, 4)).ravel().tolist()), True, (1, -1, -1))
WHOLE = SensorEntry(Mounting(swap_xy=True), 1180.0, BASELINE)
NONE: dict = {}


@pytest.fixture
def good(tmp_path):
    save_sensor_file(tmp_path / "good.toml", SensorFile(adapter="D30BL366", sensors={"4": WHOLE}))
    return tmp_path / "good.toml"


class TestLoss:
    def test_nothing_found_and_nothing_known_writes_nothing(self, tmp_path):
        with pytest.raises(SensorFileError, match=r"s\.toml: not written, because nothing was measured"):
            keep(tmp_path / "s.toml", SensorFile(), None, NONE, NONE, NONE)
        assert list(tmp_path.iterdir()) == []

    def test_what_was_learned_or_is_not_measured_again_is_kept(self, tmp_path):
        path, interval = tmp_path / "s.toml", (1100.0, 1260.0)
        held = replace(WHOLE, pad=Pad(thickness_mm=4.2), frame=PadFrame("tool0"), counts_per_newton_interval=interval)
        save_sensor_file(path, SensorFile(sensors={"4": held}))
        known, learned = load_sensor_file(path), Pad(gains=GAINS, gain_half_widths=(0.05,) * 48)
        for name in ("4", "7"):  # by a run during the visit
            keep_learned(path, name, learned)
        found = {"6": Baseline.of("6", BASELINE.counts, 1.79e9, 100, "start-up")}
        keep(path, known, None, found, NONE, NONE)
        now = load_sensor_file(path).sensors
        assert now.keys() == {"4", "6", "7"} and now["4"].baseline.id == BASELINE.id
        assert replace(now["4"], baseline=BASELINE) == replace(held, learned=learned) and now["7"].learned == learned
        assert load_sensor_file(path.with_name("s.toml.bak")).sensors.keys() == {"4", "7"}

    def test_a_pressed_pad_leaves_the_baseline_of_the_free_pad(self, tmp_path):
        path, free = tmp_path / "s.toml", healthy_counts(200)
        baseline = Baseline.from_counts("4", free, 1.79e9)
        entry = SensorEntry(baseline=baseline, emulated=frozenset({"baseline"}))
        save_sensor_file(path, SensorFile(sensors={"4": entry}))
        pressed = free.copy()
        pressed[:, 2] += 800
        for counts, stored in ((pressed, False), (free, True)):
            with Emulator([recording(counts)], loop=True) as emulator:
                done = doctor(emulator.port, "--no-press", "--sensor", path, "--out", path)
            assert ("this baseline is not stored" in " ".join(done.out.split())) is not stored
            now = load_sensor_file(path).sensors["4"].baseline
            assert (now.id != baseline.id) is stored and np.abs(now.counts - baseline.counts).max() < 10

    def test_an_emulated_sensor_does_not_overwrite_a_devices_file(self, good):
        link = FakeLink([WELL], kind="emulated")
        with pytest.raises(SensorFileError, match="it is of a device, and this one is emulated"):
            told("--sensor", good, "--out", good, link=lambda: link)
        assert link.reads == 0


class TestMarks:
    def test_a_later_visit_takes_back_what_it_finds(self, tmp_path):
        path = tmp_path / "s.toml"
        known = SensorFile(sensors={"4": SensorEntry(pad=Pad(gains=GAINS), assumed=frozenset({"mounting"}))})
        first = keep(path, known, None, {"4": BASELINE}, {"4": TURNED}, NONE, emulated=True)
        assert first.sensors["4"].mounting == TURNED, "the pad's gains are in the places that were found"
        assert first.pads["4"] == Pad(gains=GAINS).turned(TURNED) != Pad(gains=GAINS)
        assert first.sensors["4"].emulated == {"mounting", "baseline"} and not first.sensors["4"].assumed
        assert "]  # measured on an emulated sensor: not for a device\n" in path.read_text()
        second = keep(path, load_sensor_file(path), None, {"4": BASELINE}, NONE, NONE)
        assert second.sensors["4"].emulated == {"mounting"}
        third = keep(path, load_sensor_file(path), None, NONE, {"4": Mounting()}, NONE)
        assert not third.sensors["4"].emulated and load_sensor_file(path).sensors["4"].emulated == frozenset()


EMULATED = SensorFile(sensors={"4": SensorEntry(baseline=BASELINE, emulated=frozenset({"baseline"}))})


def test_a_device_refuses_an_emulated_sensor():
    words = r"has baseline of an emulated sensor 4, and this is a device: .*edge-sr doctor --out"
    with pytest.raises(SensorFileError, match=words), Source(FakeLink([], kind="device"), sensor_file=EMULATED):
        pass


@pytest.mark.parametrize(
    "command", ["replay FILE", "--source replay:FILE", "doctor --no-press --source replay:FILE",
                "baseline --out zero.json --source replay:FILE"],
)  # fmt: skip
def test_so_does_a_recording_that_is_not_known_to_be_of_one(tmp_path, capsys, monkeypatch, command):
    monkeypatch.chdir(tmp_path)
    save_sensor_file(Path("s.toml"), EMULATED)
    write_recording(Path("rest.csv"), healthy_counts(200))
    arguments = [*command.replace("FILE", "rest.csv").split(), "--rate-hz", "100"]
    assert main([*arguments, "--sensor", "s.toml"]) == 2
    words = "this recording is not known to be of one: write a new one with edge-sr doctor --out, or leave --sensor out"
    assert words in capsys.readouterr().err and not Path("zero.json").exists()
    assert main(arguments) == 0


WELL = as_scans(healthy_counts(200))


def told(*arguments, link=lambda: FakeLink([WELL], kind="replay"), out=None):
    return examined(link, "--no-press", *arguments, out=out)


def test_what_is_not_known_is_not_well():
    for verdicts, words in (
        (["ok", "ok"], "all well"),
        (["ok", "not known", "not known"], "nothing wrong, 2 not known"),
        (["wrong", "look", "not known"], "1 wrong, 1 to look at, 1 not known"),
    ):
        assert summary([Finding("noise", verdict, "") for verdict in verdicts]) == words


@pytest.mark.parametrize("name", ["no/such/s.toml", "", "/proc/s.toml", "good.toml"])
def test_a_file_that_may_not_be_written_is_refused_at_once(tmp_path, good, name):
    """One that holds something is not replaced by less: it has to be the visit's --sensor as well."""
    content, words = good.read_text(), r"cannot be written: .*: pass --out a file"
    words = r"left as it is, because .* would be lost: pass --sensor .*good\.toml" if name == "good.toml" else words
    with pytest.raises(SensorFileError, match=words):
        told("--out", tmp_path / name, link=lambda: pytest.fail("it was opened"))
    assert list(tmp_path.iterdir()) == [good] and good.read_text() == content


def test_findings_are_printed_though_the_file_became_unwritable(tmp_path):
    folder = tmp_path / "stick"
    folder.mkdir()
    out = io.StringIO()

    def open_link():
        folder.rmdir()
        return FakeLink([WELL], kind="replay")

    with pytest.raises(SensorFileError, match=r"s\.toml: cannot be written: No such file"):
        told("--out", folder / "s.toml", link=open_link, out=out)
    assert "noise:" in out.getvalue() and "kept in" not in out.getvalue()
