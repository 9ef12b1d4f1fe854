import errno
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from map_samples import letter, raster, result_of
from matplotlib.image import imread

from edge.errors import SinkError
from edge.mapping import map_files
from edge.mapping.live_map import STATES, Box, LiveMap
from edge.mapping.map_files import png
from edge.mapping.object_map import MapLayers, ObjectMap
from edge.mapping.sink import SHOW_NS, MapSink
from firmware_bridge.poses.pad_pose import PadPose
from firmware_bridge.poses.timed_pose import TimedPose

NONE = {"dropped": 0}


class Clock:
    now_ns = 10**12

    def __call__(self):
        return self.now_ns


def pressed(sink, places=((0.0, 0.0),), *, posed=True, first=0, **changes):
    """Press a letter at places, each for a scan."""
    for number, (x_mm, y_mm) in enumerate(places, first):
        result = result_of(letter, PadPose(x_mm, y_mm), number=number, **changes)
        if posed:
            sink.pose([TimedPose(PadPose(x_mm, y_mm), result.scan.time_ns)])
        sink.write(result, NONE)


def test_layers_come_back_from_the_npz_and_the_picture_shows_them(tmp_path):
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


def test_a_png_holds_every_pixel():
    pixels = np.random.default_rng(1).integers(0, 256, (7, 13, 3)).astype(np.uint8)
    assert np.array_equal(np.round(255 * imread(BytesIO(png(pixels)))), pixels)


def test_a_file_that_exists_is_left_alone_and_an_empty_map_writes_none(tmp_path):
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


def test_a_sensor_has_poses_of_its_own_or_those_of_all_between_two_of_them():
    sink = MapSink(ObjectMap())
    for time_ns, x_mm in ((10**7, -1.0), (5 * 10**7, 3.0)):
        sink.pose([TimedPose(PadPose(x_mm, 0.0), time_ns), TimedPose(PadPose(90.0, 0.0), time_ns, "7")])
    shown = []
    sink.show = shown.append
    sink.write(result_of(letter, PadPose(0.0, 0.0), number=3), NONE)
    ((sensor, pose),) = shown[-1].pads.items()
    assert sensor == "4" and pose.x_mm == pytest.approx(-1 + (shown_time(3) - 10**7) / 1e7)
    sink.close()
    assert sink.whole.fused == 1


def shown_time(number):
    return result_of(letter, PadPose(0.0, 0.0), number=number).scan.time_ns


def test_states_are_shown_a_few_times_a_second_and_at_the_end():
    shown, clock = [], Clock()
    sink = MapSink(ObjectMap(), show=shown.append, clock_ns=clock)
    for number in range(100):
        pressed(sink, ((number * 0.1 - 5, 0.0),), first=number)
        clock.now_ns += SHOW_NS // 25
    assert len(shown) == 4
    sink.wait()
    sink.close()
    assert shown[-1].number == len(shown) and shown[-1].counts["fused"] == sink.whole.fused


def test_a_state_holds_what_has_changed_since_an_earlier_one():
    whole = ObjectMap()
    live = LiveMap(whole.grid)
    states = []
    for pose in [*raster()[:6], None, *raster()[6 : STATES + 6]]:
        if pose is not None:
            whole.add(result_of(letter, pose), pose)
        states.append(live.next(*whole.contact(), {}, {}))
    assert states[6].since(6) is None and states[6].since(7) is None
    for state, number in ((states[5], 2), (states[7], 4), (states[-1], STATES), (states[3], 0)):
        box = state.since(number)
        assert box is not None and box != Box(0, 0, 240, 240)
        before = states[number - 1].contact if number else np.full_like(state.contact, np.nan)
        patched = before.copy()
        part = np.s_[box.top : box.bottom, box.left : box.right]
        patched[part] = state.contact[part]
        assert np.array_equal(patched, state.contact, equal_nan=True)
    assert states[-1].since(2) == Box(0, 0, 240, 240), "an old page gets it all"
