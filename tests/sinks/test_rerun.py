"""Results in Rerun: what is sent of which pattern, by a stand-in for the package, and by the package where it is."""

import sys
from contextlib import closing
from dataclasses import replace

import pytest
from edge_samples import fake_source
from sink_samples import CONTRACT, EVENTS, make_sure_results

from edge.api import SinkError, open_sink

STAND_IN = """
sent = []
class RecordingStream:
    def __init__(self, name): sent.append(("name", name))
    def save(self, path): open(path, "wb").close()
    def set_time(self, timeline, duration): sent.append((timeline, duration))
    def log(self, place, what): sent.append((place, what))
    def disconnect(self): sent.append(("over", None))
class Entity:
    def __init__(self, value=None, **settings): self.value, self.settings = value, settings
class Scalars(Entity): pass
class TextLog(Entity): pass
class Clear(Entity): pass
class DepthImage(Entity): pass
"""


@pytest.fixture
def stand_in(monkeypatch, tmp_path, request):
    """Interface of the package as far as the sink uses it, of a version."""
    folder, version = tmp_path / "site", getattr(request, "param", "0.26.2")
    (folder / "rerun_sdk-1.dist-info").mkdir(parents=True)
    (folder / "rerun.py").write_text(STAND_IN)
    (folder / "rerun_sdk-1.dist-info" / "METADATA").write_text(f"Name: rerun-sdk\nVersion: {version}\n")
    monkeypatch.syspath_prepend(folder)
    monkeypatch.delitem(sys.modules, "rerun", raising=False)
    yield
    sys.modules.pop("rerun", None)


def opened(target):
    return open_sink(f"rerun:{target}", CONTRACT, fake_source(kind="emulated"))


@pytest.mark.parametrize("stand_in", ["0.23.4"], indirect=True)
def test_an_old_version_is_refused(stand_in, tmp_path):
    with pytest.raises(SinkError, match=r"rerun-sdk is 0\.23\.4, expected 0\.24 or later"):
        opened(tmp_path / "press.rrd")


def test_where_nobody_listens_it_is_an_error(stand_in, tmp_path):
    with pytest.raises(SinkError, match=r"rerun:127\.0\.0\.1:1: .*refused"):
        opened("127.0.0.1:1")
    (tmp_path / "kept.rrd").write_text("mine")
    with pytest.raises(SinkError, match="exists"):
        opened(tmp_path / "kept.rrd")


def test_only_a_believed_pattern_is_shown_as_one(stand_in, tmp_path):
    touched = next(one for one in make_sure_results() if one.pattern is not None)
    course = [
        replace(touched, trusted=True),
        replace(touched, trusted=True, reused_from=touched.scan.number),
        replace(touched, trusted=False),
        replace(touched, trusted=None),
        replace(touched, pattern=None, deviation=None),
    ]
    with closing(opened(tmp_path / "press.rrd")) as sink:
        import rerun

        shown = []
        for result in course:
            rerun.sent.clear()
            sink.write(result, {})
            shown.append({place: type(what).__name__ for place, what in rerun.sent if place.endswith("pattern")})
            assert dict(rerun.sent)["4/force_counts"].value == result.force_counts
        sink.tell(EVENTS[0], {})
        assert rerun.sent[-1][0] == "events" and rerun.sent[-1][1].value == "the cable is out"
    doubted = "4/not_believed/pattern"
    assert shown == [
        {"4/pattern": "DepthImage"},
        {},
        {"4/pattern": "Clear", doubted: "DepthImage"},
        {doubted: "DepthImage"},
        {doubted: "Clear"},
    ]
    assert rerun.sent[-1] == ("over", None)


def test_the_package_itself_takes_it(tmp_path):
    pytest.importorskip("rerun", reason="Rerun, of 100 MB, is not installed")
    file = tmp_path / "press.rrd"
    with closing(opened(file)) as sink:
        for result in make_sure_results():
            sink.write(result, {})
    assert file.read_bytes().startswith(b"RRF") and file.stat().st_size > 10_000
