"""Summary of the doctor: an undecided check is not ok, and no finding is lost with a file."""

import io
import json
import re

import pytest
from doctor_samples import as_scans, healthy_counts
from edge_samples import FakeLink

from edge.cli.run_options import parser
from edge.doctor import command, watch
from edge.doctor.findings import Finding, summary
from firmware_bridge.errors import SensorFileError
from firmware_bridge.scans.mounting import Mounting
from firmware_bridge.sensor_file.model import SensorEntry, SensorFile, load_sensor_file
from firmware_bridge.sensor_file.toml_writer import save_sensor_file

WELL = as_scans(healthy_counts(200))


def told(*arguments, link=None, out=None):
    """The exit code, and what the doctor printed of a link that is well."""
    options = parser("doctor").parse_args(["--no-press", *map(str, arguments)])
    out = io.StringIO() if out is None else out
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(watch, "links_to", lambda *_, **__: [FakeLink([WELL], kind="replay") if link is None else link()])
        return command.run(options, out, io.StringIO()), out.getvalue()


@pytest.mark.parametrize(
    ("verdicts", "words"),
    [
        (["ok", "ok"], "all well"),
        (["ok", "not known", "not known"], "nothing wrong, 2 not known"),
        (["look", "ok"], "0 wrong, 1 to look at"),
        (["wrong", "look", "not known"], "1 wrong, 1 to look at, 1 not known"),
    ],
)
def test_what_is_not_known_is_not_well(verdicts, words):
    assert summary([Finding("noise", verdict, "") for verdict in verdicts]) == words


def test_the_last_line_says_it():
    code, page = told()
    findings = [line for line in page.splitlines() if line.startswith("  ?")]
    assert code == 0 and page.splitlines()[-1] == f"nothing wrong, {len(findings)} not known" and len(findings) == 2


class StoppedLink(FakeLink):
    """Ctrl-C comes with its first scans."""

    def __init__(self, stop) -> None:
        super().__init__([WELL], kind="replay", endless=True)
        self._stop = stop

    def read(self, timeout_s):
        self._stop.set()
        return super().read(timeout_s)


@pytest.fixture
def stopping(monkeypatch):
    """Opens a link that is stopped at its first read."""
    stops = []
    true = command.stop_on_signals

    class Kept:
        def __enter__(self):
            self._context = true()
            stops.append(self._context.__enter__())
            return stops[-1]

        def __exit__(self, *exc_info):
            return self._context.__exit__(*exc_info)

    monkeypatch.setattr(command, "stop_on_signals", Kept)
    return lambda: StoppedLink(stops[-1])


def test_a_stopped_look_says_so(stopping):
    code, page = told(link=stopping)
    assert code == 130 and re.fullmatch(r"stopped after \d+ s: nothing wrong, 1 not known", page.splitlines()[-1])
    code, page = told("--json", link=stopping)
    assert code == 130 and json.loads(page)["stopped"] is True
    assert json.loads(told("--json")[1])["stopped"] is False


@pytest.mark.parametrize("name", ["no/such/s.toml", "", "/proc/s.toml"])
def test_a_file_that_cannot_be_written_is_refused_before_anything_is_opened(tmp_path, name):
    def open_link():
        raise AssertionError("opened")

    with pytest.raises(SensorFileError, match=r"cannot be written: .*: pass --out a file"):
        told("--out", tmp_path / name, link=open_link)
    assert list(tmp_path.iterdir()) == []


def test_what_was_found_is_told_though_the_file_cannot_be_written_any_more(tmp_path):
    folder = tmp_path / "stick"
    folder.mkdir()
    out = io.StringIO()

    def open_link():
        folder.rmdir()
        return FakeLink([WELL], kind="replay")

    with pytest.raises(SensorFileError, match=r"s\.toml: cannot be written: No such file"):
        told("--out", folder / "s.toml", link=open_link, out=out)
    assert "noise:" in out.getvalue() and "kept in" not in out.getvalue()


def test_a_load_is_told_by_the_z_of_the_sensor_file(tmp_path):
    """A reading below its baseline is a press where z is reversed."""
    path = tmp_path / "s.toml"
    told("--out", path)
    pressed = healthy_counts(200)
    pressed[:, 2, 1, 1] -= 800
    baseline = load_sensor_file(path).sensors["4"].baseline
    for sign, remedy in ((1, "the baseline was taken of a loaded pad"), (-1, "something presses: free the pad")):
        sensors = {"4": SensorEntry(Mounting(signs=(1, 1, sign)), None, baseline)}
        save_sensor_file(path, SensorFile("uSPa44", sensors=sensors))
        _, document = told("--json", "--sensor", path, link=lambda: FakeLink([as_scans(pressed)], kind="replay"))
        load = next(one for one in json.loads(document)["findings"] if one["name"] == "load")
        assert load["verdict"] == "wrong" and load["remedy"].startswith(remedy)
