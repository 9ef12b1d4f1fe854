"""Map of an object: what perfect patterns of a figure give, which presses count, its files, and its states."""

import resource
import tracemalloc
from dataclasses import replace
from itertools import count

import numpy as np
import pytest
from map_samples import dome, letter, pixels_mm, raster, result_of

from edge.api import Event, PadPose, SinkError, UsageError
from edge.mapping.object_map import STEP_MM, Footprint, MapLayers, ObjectMap
from edge.mapping.sink import SHOW_NS, MapSink

HERE = PadPose(0.0, 0.0, 0.0, 0.0, 0.0)


def fused(height, poses, depths_mm=(0.3,)):
    whole = ObjectMap()
    for number, pose in enumerate(poses):
        whole.add(result_of(height, pose, depths_mm[number % len(depths_mm)]), pose)
        whole.finish()
    return whole


def pressed(*presses, height=letter):
    """Return the map of presses at one place, each of an indentation and changes of its result."""
    whole = ObjectMap()
    for indentation_mm, changes in presses:
        whole.add(result_of(height, HERE, indentation_mm, **changes), HERE)
    whole.finish()
    return whole


@pytest.mark.parametrize("turns", [(0.0,), (90.0,), (0.0, 45.0, -120.0)], ids=["straight", "upright", "mixed"])
def test_perfect_patterns_of_a_letter_give_its_outline(turns):
    touching = [pose for pose in raster(turns) if 0 < (result_of(letter, pose).pattern > 0.15).mean() < 0.9]
    whole = fused(letter, touching)  # without those where it touches the plate beside the figure
    layers = whole.layers()
    x_mm, y_mm = pixels_mm(whole.grid)
    known = np.isfinite(layers.contact)
    here, *near = (letter(x_mm + dx, y_mm + dy) for dx, dy in ((0, 0), (0.3, 0), (-0.3, 0), (0, 0.3), (0, -0.3)))
    sure = known & np.all([one == here for one in near], axis=0)
    assert known.mean() > 0.6 and ((layers.contact > 0.5) == (here == 0))[sure].all()
    area_mm2 = (layers.contact[known] > 0.5).sum() / whole.grid.px_per_mm**2
    edge_mm = 2 * (40 + 30)
    assert abs(area_mm2 - (here[known] == 0).sum() / 16) < 0.1 * edge_mm


def test_heights_of_a_curved_part_agree_between_presses():
    layers = fused(dome, [PadPose(float(x), 0.0, 0.0, 0.0, 0.0) for x in range(-12, 13, 3)], (0.4, 0.25)).layers()
    x_mm, y_mm = pixels_mm(ObjectMap().grid)
    there = np.isfinite(layers.height_mm) & (np.abs(y_mm) < 4) & (np.abs(x_mm) < 15)
    off_mm = (layers.height_mm - dome(x_mm, y_mm))[there]
    assert there.sum() > 1000 and off_mm.std() < 0.002 and np.ptp(dome(x_mm, y_mm)[there]) > 0.15


DOUBTED, LIGHT = {"trusted": False}, {"trusted": None}


@pytest.mark.parametrize(
    ("presses", "fused", "doubted", "light"),
    [
        ([(0.45, DOUBTED)], 0, 1, 0),
        # A believed press takes the place of a stronger one that is not.
        ([(0.45, DOUBTED), (0.3, {}), (0.4, DOUBTED)], 1, 0, 0),
        ([(0.03, {"trusted": True})], 0, 0, 1),  # as drift of a free pad makes
        ([(0.3, LIGHT | {"window": np.full((1, 3, 1, 1), 99, np.float32)})], 0, 0, 1),
        ([(0.3, LIGHT | {"window": np.full((1, 3, 1, 1), 101, np.float32)})], 1, 0, 0),
    ],
)
def test_which_press_of_a_contact_counts(presses, fused, doubted, light):
    whole = pressed(*presses)
    assert tuple(whole.counts.values())[:3] == (fused, doubted, light)
    layers = whole.layers()
    assert (layers.doubted > 0).sum() == pytest.approx(doubted * 18.8**2 * 16, rel=0.03)
    assert layers.coverage.any() == np.isfinite(layers.contact).any() == np.isfinite(layers.height_mm).any() == fused
    beside, unchecked = PadPose(9.0, 0.0), result_of(dome, HERE, trusted=None)
    whole.add(unchecked, beside)  # of a model with checks it is too light to be checked
    whole.finish()
    assert whole.fused - fused == (None in [changes.get("trusted", True) for _, changes in presses])


def test_a_held_press_counts_once_and_a_slide_by_its_way():
    held, tapped = ObjectMap(), pressed((0.1 + 49 / 200, {}))
    for number in range(100):
        held.add(result_of(letter, HERE, 0.1 + number % 50 / 200, number=number), HERE)
    for fused in (0, 1):  # a press that lasts is shown, and left open
        assert np.array_equal(held.layers().contact, tapped.layers().contact, equal_nan=True)
        assert held.layers().coverage.max() == 1 and held.fused == fused
        held.add(result_of(letter, HERE), None)  # without a pose it is over

    def slid(scans):
        whole = ObjectMap()
        for x_mm in np.linspace(0, 47, scans):
            pose = PadPose(float(x_mm) - 23, 0.0, 0.0, 0.0, 0.0)
            whole.add(result_of(letter, pose), pose)
        whole.finish()
        return whole.layers().coverage.max()

    slow, fast = slid(300), slid(100)
    assert slow == pytest.approx(fast, rel=0.15) and 3 < slow < 6, "18.8 mm of pad, a tap in 4.7 mm"
    whole = ObjectMap()
    for x_mm in (0.0, 0.4 * STEP_MM, 0.8 * STEP_MM, 1.2 * STEP_MM):
        whole.add(result_of(dome, HERE), PadPose(x_mm, 0.0))
    whole.finish()
    assert whole.fused == 2, "neighbours of a step are one"


def test_an_uncertain_pose_makes_edges_unsure_and_not_the_middle():
    sure, unsure = (fused(letter, [PadPose(-12.0, 0.0, 0.0, error, 3 * error)]).layers() for error in (0.0, 1.0))
    x_mm, y_mm = pixels_mm(ObjectMap().grid)
    edge = (np.abs(np.abs(x_mm + 12) - 4) < 0.5) & (np.abs(y_mm) < 8)
    middle = (np.abs(x_mm + 12) < 2) & (np.abs(y_mm) < 8)
    doubt = [np.abs(one.contact - 0.5) for one in (sure, unsure)]
    assert doubt[1][edge].mean() < 0.7 * doubt[0][edge].mean()
    assert np.allclose(doubt[0][middle], doubt[1][middle])
    assert unsure.deviation_mm[edge & np.isfinite(unsure.deviation_mm)].mean() > 2 * sure.deviation_mm[middle].mean()


def test_memory_does_not_grow_with_the_run():
    poses = raster(step_mm=8.0)
    results = [result_of(letter, pose) for pose in poses]
    whole, sizes = ObjectMap(), []
    tracemalloc.start()
    for _ in range(4):
        for result, pose in zip(results, poses, strict=True):
            whole.add(result, pose)
        sizes.append(tracemalloc.get_traced_memory()[0])
    tracemalloc.stop()
    assert whole.fused > 150 and abs(sizes[-1] - sizes[1]) < 20_000
    assert np.isfinite(whole.layers().contact).any()


def test_what_lies_outside_the_map_is_left_out():
    whole = ObjectMap(20.0, 4.0, centre_mm=(100.0, 0.0))
    for x_mm in (0.0, 1e6, 95.0):
        whole.add(result_of(dome, HERE), PadPose(x_mm, 0.0))
    whole.finish()
    assert (whole.counts["outside"], whole.fused) == (2, 1) and whole.layers().coverage[40, 0] == 1


def test_a_pattern_is_read_between_its_rows_and_columns():
    layer = (np.arange(4)[:, None] + 10 * np.arange(5)).astype(np.float32)[..., None]
    read = Footprint(np.arange(3), np.array([1.25, 0.0, 3.9]), np.array([0.75, 9.0, 2.0])).read(layer)
    assert read[:, 0] == pytest.approx([8.75, 40, 23]), "beyond the outermost, theirs"


def test_a_size_out_of_range_and_another_unit_are_refused():
    for size in ((0, 4), (-60, 4), (600, 4), (0.1, 4), (float("nan"), 4), (60, float("inf"))):
        with pytest.raises(UsageError, match="expected 1 to 2000 pixels"):
            ObjectMap(*size)
    with pytest.raises(UsageError, match="expected mm"):
        ObjectMap().add(result_of(dome, HERE, pattern_unit="counts"), HERE)


def touched(sink, places=((0.0, 0.0),), *, posed=True, first=0, **changes):
    """Press a letter at places, each for a scan."""
    for number, (x_mm, y_mm) in enumerate(places, first):
        pose = PadPose(x_mm, y_mm)
        sink.write(result_of(letter, pose, number=number, posed=posed, **changes), {})


def test_layers_come_back_from_their_file(tmp_path):
    sink = MapSink(ObjectMap(), npz=tmp_path / "m.npz")
    touched(sink, ((-12.0, 0.0), (-12.0, 16.0)))
    touched(sink, ((20.0, -20.0),), first=2, trusted=False)
    sink.close()
    expected = sink.whole.layers()
    with np.load(tmp_path / "m.npz") as data:
        for name in MapLayers.__dataclass_fields__:
            assert np.array_equal(data[name], getattr(expected, name), equal_nan=True)
        assert (str(data["format"]), int(data["version"])) == ("tactile-object-map", 1)
        assert (str(data["model"]), str(data["source"])) == ("perfect", "replay")
        assert (int(data["fused_patterns"]), int(data["doubted_patterns"])) == (2, 1)
        assert float(data["px_per_mm"]) == 4 and data["centre_mm"].tolist() == [0, 0]
    assert sink.summary() == f"map: 2 patterns fused, 1 not believed; {tmp_path / 'm.npz'} written"


def test_a_file_of_an_emulated_sensor_says_so_also_in_a_replay(tmp_path):
    for source, origin, marked in (("emulated", None, 1), ("replay", "emulated", 1), ("replay", "device", 0)):
        npz = tmp_path / f"{source}-{origin}.npz"
        sink = MapSink(ObjectMap(), npz=npz, origin=origin)
        touched(sink, source=source)
        sink.close()
        with np.load(npz) as data:
            assert (str(data["origin"]), str(data["source"])) == ("emulated" if marked else "device", source)
        assert sink.summary().startswith("map (EMULATED): 1 " if marked else "map: 1 ")


def test_a_reset_ends_a_map_and_begins_the_next(tmp_path):
    reset = (Event(0, "reset", None, ""),)
    sink = MapSink(ObjectMap(40.0, 2.0, centre_mm=(5.0, 0.0)), npz=tmp_path / "m.npz")
    touched(sink, events=reset)
    (tmp_path / "m-2.npz").write_text("a good one")
    touched(sink, ((10.0, 0.0), (-10.0, 0.0)), first=1)
    sink.write(result_of(letter, PadPose(0.0, 0.0), number=3, events=reset, trusted=False), {})
    assert np.load(tmp_path / "m.npz")["fused_patterns"] == 3, "the press that lasted belongs to the object before"
    touched(sink, ((-8.0, 0.0), (8.0, 0.0)), first=4)
    sink.close()
    with np.load(tmp_path / "m-3.npz") as data:
        assert (int(data["fused_patterns"]), int(data["doubted_patterns"])) == (2, 1)
        assert data["contact"].shape == (80, 80) and data["centre_mm"].tolist() == [5, 0]
    assert (tmp_path / "m-2.npz").read_text() == "a good one"
    files = f"{tmp_path / 'm.npz'} and {tmp_path / 'm-3.npz'}"
    assert sink.summary() == f"map: 5 patterns fused, 1 not believed; {files} written" and sink.fused == 5


def test_two_pads_at_one_place_are_not_fused():
    shared, shown = MapSink(ObjectMap()), []
    apart = MapSink(ObjectMap(), show=shown.append, clock_ns=count(10**12, SHOW_NS).__next__)
    for number in range(6):
        for sensor, x_mm in (("4", 0.0), ("6", 20.0)):
            pressing = number > 0  # both are free at first
            for sink, place_mm in ((shared, number + x_mm / 20), (apart, number + x_mm)):
                pose = PadPose(place_mm, 0.0)
                result = result_of(letter, pose, number=number, sensor=sensor)
                sink.write(result if pressing else replace(result, pattern=None, contact=False), {})
    assert set(shown[-1].pads) == {"4", "6"}
    touched(apart, ((9.0, 0.0),), first=200)  # as after another link was lost
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
        MapSink(ObjectMap(), npz=tmp_path / "absent" / "m.npz")
    sink = MapSink(ObjectMap(), npz=tmp_path / "m.npz")
    touched(sink, posed=False)
    assert "came without a pose" in (sink.trouble or "")
    sink.close()
    assert there.read_text() == "a good one" and sorted(tmp_path.iterdir()) == [there]
    assert sink.summary() == "map: 0 patterns fused, 1 without a pose; no file written"


def test_a_disk_that_is_full_leaves_no_half_of_a_file(tmp_path):
    sink = MapSink(ObjectMap(), npz=tmp_path / "m.npz")
    touched(sink)
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, before[1]))
    try:
        with pytest.raises(SinkError, match=r"cannot write .*m\.npz: File too large$"):
            sink.close()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert list(tmp_path.iterdir()) == []


def test_states_are_shown_a_few_times_a_second_and_at_the_end():
    shown, now_ns = [], [10**12]
    sink = MapSink(ObjectMap(), show=shown.append, clock_ns=lambda: now_ns[0])
    for number in range(40):
        touched(sink, ((number * 0.1 - 5, 0.0),), first=number)
        now_ns[0] += SHOW_NS // 10
    assert len(shown) == 4
    sink.wait()
    sink.close()
    assert shown[-1].counts["fused"] == sink.whole.fused
