"""Files of the map of an object, and its states while it grows."""
# pyright: reportArgumentType=false

import errno
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from map_samples import letter, result_of
from matplotlib.image import imread
from PIL import Image

from edge.errors import SinkError
from edge.mapping import map_files
from edge.mapping.object_map import MapLayers, ObjectMap
from edge.mapping.sink import SHOW_NS, MapSink
from edge.perception.event import Event
from firmware_bridge.poses.pad_pose import PadPose

NONE = {"dropped": 0}


def pressed(sink, places=((0.0, 0.0),), *, posed=True, first=0, **changes):
    """Press a letter at places, each for a scan."""
    for number, (x_mm, y_mm) in enumerate(places, first):
        pose = PadPose(x_mm, y_mm)
        sink.write(result_of(letter, pose, number=number, posed=posed, **changes), NONE)


def test_layers_come_back_and_the_picture_shows_them(tmp_path):
    sink = MapSink(ObjectMap(), npz=tmp_path / "m.npz", png=tmp_path / "m.png")
    pressed(sink, ((-12.0, 0.0), (-12.0, 16.0)))
    pressed(sink, ((20.0, -20.0),), first=2, trusted=False)
    sink.close()
    expected = sink.whole.layers()
    with np.load(tmp_path / "m.npz") as data:
        for name in MapLayers.__dataclass_fields__:
            assert np.array_equal(data[name], getattr(expected, name), equal_nan=True)
        assert (str(data["format"]), int(data["version"])) == ("tactile-object-map", 1)
        assert (str(data["model"]), str(data["source"])) == ("perfect", "replay")
        assert (int(data["fused_patterns"]), int(data["doubted_patterns"])) == (2, 1)
        assert float(data["px_per_mm"]) == 4 and data["centre_mm"].tolist() == [0, 0]
    picture = imread(tmp_path / "m.png")
    assert picture.shape == (480, 968, 3)
    known = np.isfinite(expected.contact)
    shown = picture[::2, :480:2]
    assert (shown[~known & (expected.doubted == 0)] == 1).all()
    red = np.round(255 * shown[~known & (expected.doubted > 0)])
    assert len(red) > 1000 and (red == (200, 40, 30)).all()
    light, dark = shown[known & (expected.contact > 0.9)], shown[known & (expected.contact < 0.1)]
    assert light.mean() > dark.mean() + 0.2
    files = f"{tmp_path / 'm.npz'} and {tmp_path / 'm.png'}"
    assert sink.summary() == f"map: 2 patterns fused, 1 not believed; {files} written"


def test_files_of_an_emulated_sensor_say_so_also_in_a_replay(tmp_path):
    for source, origin, marked in (("emulated", None, 1), ("replay", "emulated", 1), ("replay", "device", 0)):
        npz, png_path = tmp_path / f"{source}-{origin}.npz", tmp_path / f"{source}-{origin}.png"
        sink = MapSink(ObjectMap(), npz=npz, png=png_path, origin=origin)
        pressed(sink, source=source)
        sink.close()
        with np.load(npz) as data, Image.open(png_path) as picture:
            assert {str(data["origin"]), picture.info["origin"]} == {"emulated" if marked else "device"}
            assert picture.info["source"] == source
            line = np.asarray(picture)[:-480]
        assert sink.summary().startswith("map (EMULATED): 1 " if marked else "map: 1 ")
        assert (line.shape[0] > 20) == marked and set(np.unique(line)) == ({0, 255} if marked else set())


def test_a_reset_ends_a_map_and_begins_the_next(tmp_path):
    reset = (Event(0, "reset", None, ""),)
    sink = MapSink(ObjectMap(40.0, 2.0, centre_mm=(5.0, 0.0)), npz=tmp_path / "m.npz")
    pressed(sink, events=reset)
    (tmp_path / "m-2.npz").write_text("a good one")
    pressed(sink, ((10.0, 0.0), (-10.0, 0.0)), first=1)
    sink.write(result_of(letter, PadPose(0.0, 0.0), number=3, events=reset, trusted=False), NONE)
    assert np.load(tmp_path / "m.npz")["fused_patterns"] == 3, "the press that lasted belongs to the object before"
    pressed(sink, ((-8.0, 0.0), (8.0, 0.0)), first=4)
    sink.close()
    with np.load(tmp_path / "m-3.npz") as data:
        assert (int(data["fused_patterns"]), int(data["doubted_patterns"])) == (2, 1)
        assert data["contact"].shape == (80, 80) and data["centre_mm"].tolist() == [5, 0]
    assert (tmp_path / "m-2.npz").read_text() == "a good one"
    files = f"{tmp_path / 'm.npz'} and {tmp_path / 'm-3.npz'}"
    assert sink.summary() == f"map: 5 patterns fused, 1 not believed; {files} written" and sink.fused == 5


def test_two_pads_at_one_place_are_not_fused():
    shared, apart, shown = MapSink(ObjectMap()), MapSink(ObjectMap()), []
    apart.show, apart._pause_ns = shown.append, 0
    for number in range(6):
        for sensor, x_mm in (("4", 0.0), ("6", 20.0)):
            pressing = number > 0  # both are free at first
            for sink, place_mm in ((shared, number + x_mm / 20), (apart, number + x_mm)):
                pose = PadPose(place_mm, 0.0)
                result = result_of(letter, pose, number=number, sensor=sensor)
                sink.write(result if pressing else replace(result, pattern=None, contact=False), NONE)
    assert set(shown[-1].pads) == {"4", "6"}
    pressed(apart, ((9.0, 0.0),), first=200)  # as after another link was lost
    for sink in (shared, apart):
        sink.close()
    assert set(shown[-1].pads) == {"4"}, "no pad is drawn where it was long ago"
    assert shared.fused == 0 and apart.fused == 11 and apart.trouble is None
    assert "10 patterns of two pads at one place are left out" in (shared.trouble or "")
    assert shared.summary() == "map: 0 patterns fused, 10 of two pads at one place; no file written"


def test_a_file_is_left_alone_and_an_empty_map_writes_none(tmp_path):
    there = tmp_path / "there.npz"
    there.write_text("a good one")
    with pytest.raises(SinkError, match=r"there\.npz exists: give another name"):
        MapSink(ObjectMap(), npz=there)
    with pytest.raises(SinkError, match="cannot write"):
        MapSink(ObjectMap(), png=tmp_path / "absent" / "m.png")
    sink = MapSink(ObjectMap(), npz=tmp_path / "m.npz")
    pressed(sink, posed=False)
    assert "came without a pose" in (sink.trouble or "")
    sink.close()
    assert there.read_text() == "a good one" and sorted(tmp_path.iterdir()) == [there]
    assert sink.summary() == "map: 0 patterns fused, 1 without a pose; no file written"


def test_a_disk_that_is_full_leaves_no_half_of_a_file(tmp_path, monkeypatch):
    sink = MapSink(ObjectMap(), npz=tmp_path / "m.npz", png=tmp_path / "m.png")
    pressed(sink)

    def full(path, **arrays):
        Path(path).write_bytes(b"half")
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(map_files.np, "savez_compressed", full)
    with pytest.raises(SinkError, match="No space left"):
        sink.close()
    assert list(tmp_path.iterdir()) == []


def test_states_are_shown_a_few_times_a_second_and_at_the_end():
    shown, now_ns = [], [10**12]
    sink = MapSink(ObjectMap(), show=shown.append, clock_ns=lambda: now_ns[0])
    for number in range(40):
        pressed(sink, ((number * 0.1 - 5, 0.0),), first=number)
        now_ns[0] += SHOW_NS // 10
    assert len(shown) == 4
    sink.wait()
    sink.close()
    assert shown[-1].number == len(shown) and shown[-1].counts["fused"] == sink.whole.fused
