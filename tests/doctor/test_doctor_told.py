"""Summary of the doctor: an undecided check is not ok, and no finding is lost with a file."""

import io

import pytest
from doctor_samples import as_scans, healthy_counts
from edge_samples import FakeLink

from edge.doctor import command, watch
from edge.doctor.findings import Finding, summary
from edge.doctor.options import doctor_parser
from firmware_bridge.errors import SensorFileError

WELL = as_scans(healthy_counts(200))


def told(*arguments, link=None, out=None):
    """The exit code, and what the doctor printed of a link that is well."""
    options = doctor_parser().parse_args(["--no-press", *map(str, arguments)])
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
