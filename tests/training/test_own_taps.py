"""Own taps on a known surface: from recordings with poses to a set to learn from, and a model that it judges."""

from dataclasses import replace

import numpy as np
import pytest
import shapely
from bridge_samples import write_npz
from matplotlib.image import imsave
from press_samples import make_press_set
from tapping_robot import Robot, grid_places_mm, plate_mesh

from edge.inference.bundled import find_model
from edge.inference.onnx_session import ModelSession
from firmware_bridge.sensor_file.model import SensorFile, load_sensor_file
from firmware_bridge.sensor_file.toml_writer import save_sensor_file
from train import own, taps
from train.data import recorded_taps
from train.data.press_batches import OneSensor, PressBatches, with_own_taps
from train.data.presses import load_presses
from train.data.recorded_taps import image_surface, load_tap_parts, surface_of
from train.errors import DatasetError
from train.learning.sensor_knowledge import knowledge_of
from train.networks.compact import HeteroscedasticError
from train.own import TAPPED
from train.physics.gripped import FINE_SCALE, GrippedPad
from train.physics.pad_draws import KNOWN, NOMINAL, constants
from train.physics.tpsf import resample
from train.surfaces.depth_image import Pose
from train.surfaces.named_surfaces import figure

FIGURES = ("T", "L", "hollow square")


@pytest.fixture(scope="module")
def tapped(tmp_path_factory):
    """A folder with a recording of three figures at nine places each, its surface, the sensor file, and the truth."""
    folder = tmp_path_factory.mktemp("robot")
    robot = Robot()
    robot.save_sensor_file(folder / "sensor.toml")
    plate_mesh(FIGURES).export(folder / "plate.stl")
    return folder, robot.record_plate(folder / "plate.csv", FIGURES)


@pytest.fixture(autouse=True)
def few(limits):
    """Fewer taps to fit the poses by, and a network of the PSF that is hardly trained."""
    limits(recorded_taps, FIT_FROM=6)
    limits(taps, EPOCHS=1)


def arguments(folder, *more, recording="plate.csv", surface="plate.stl"):
    """Return the command line of this folder."""
    given = [folder / recording, "--surface", folder / surface, "--sensor-file", folder / "sensor.toml"]
    return [str(one) for one in (*given, "--out", folder / "taps.npz", *more)]


def test_taps_become_a_set_with_truth(tapped, capsys):
    folder, truth = tapped
    taps.main(arguments(folder))
    told = capsys.readouterr().out
    assert "27 taps; they fit best with the surface moved by" in told and "LR-HR pairs" in told
    made = load_presses(folder / "taps.npz")
    split = {name: len(numbers) for name, numbers in made.config["split"].items()}
    assert split == {"training": 21, "validation": 3, "test": 3}, "a ninth of the places, twice"
    found = knowledge_of(load_sensor_file(folder / "sensor.toml"), None)
    parts = load_tap_parts(folder / "taps.npz", "4", found.pad, constants(found.middle()))
    assert {name: len(np.unique(part.pad)) for name, part in parts.items()} == split
    last = np.append(np.flatnonzero(np.diff(made.pad)), len(made) - 1)
    assert len(last) == 27 and np.diff(last).max() == 16, "from first touch to full force"
    expected = resample(truth.unit_patterns, FINE_SCALE, 10) * truth.indentation_mm[:, None, None]
    error_mm = np.sqrt(np.square(made.patterns[last] - expected).mean(axis=(1, 2)))
    assert np.median(error_mm) < 0.035, "of presses half a millimetre deep, at poses that were off by 0.4 mm"
    assert (made.touching[last] == (expected > 0.9 * truth.indentation_mm[:, None, None])).mean() > 0.97

    for kind in ("fitted", "psf", "depth"):  # to compare
        taps.main(arguments(folder, "--truth", kind, "--scale", "4"))
        made = load_presses(folder / "taps.npz")
        inside = made.touching
        assert made.config["truth"] == kind and made.patterns.shape[1:] == (16, 16)
        if kind != "psf":  # a plateau
            assert all(np.ptp(one[area].astype(float)) < 1e-3 for one, area in zip(made.patterns, inside, strict=True))
        assert (kind == "depth") == (not made.patterns[~inside].any()), "alone it has no reach"


@pytest.mark.parametrize(
    ("change", "lines", "complaint"),
    [
        (lambda row: row[:-3], None, "has no poses: record with --poses, or add columns pose_x_mm"),
        (
            lambda row: [*row[:-3], f"{-float(row[-3])}", *row[-2:]],
            None,
            "the readings do not fit what lies under the poses: likeness 0.",
        ),
        (lambda row: [*row[:-3], "500", *row[-2:]], None, "the pad never touches the surface at a pose"),
        (list, 900, "places, expected at least 27"),
        (list, 99, "has no tap with a pose"),
        (lambda row: [row[0], *(str(4 * int(n) - 99_000) for n in row[1:-3]), *row[-3:]], None, "is .* mm deep by"),
    ],
)
def test_a_bad_recording_is_one_line(tapped, tmp_path, change, lines, complaint):
    folder, _ = tapped
    header, *rows = [line.split(",") for line in (folder / "plate.csv").read_text().splitlines()[:lines]]
    changed = [change(row) for row in rows]
    (tmp_path / "bad.csv").write_text("".join(f"{','.join(row)}\n" for row in [header[: len(changed[0])], *changed]))
    with pytest.raises(SystemExit, match=rf"^train\.taps: .*{complaint}[^\n]*$"):
        taps.main(arguments(folder, recording=tmp_path / "bad.csv"))


def test_another_sensor_or_a_bad_surface_is_one_line(tapped, tmp_path):
    path = write_npz(tmp_path / "other.npz", np.full((200, 3, 4, 4), 30_000), sensors=["6"] * 200)
    with pytest.raises(SystemExit, match=r"^train\.taps: .*other.npz has the sensors 6, none of them 4$"):
        taps.main(arguments(tapped[0], recording=path))
    plate_mesh(FIGURES).apply_scale(0.001).export(tmp_path / "metres.stl")
    (tmp_path / "broken.png").write_bytes(b"no picture")
    imsave(tmp_path / "even.png", np.zeros((2, 2)))
    even = (tmp_path / "even.png").read_bytes()
    (tmp_path / "huge.png").write_bytes(even[:16] + 2 * (60_000).to_bytes(4) + even[24:])
    for surface, complaint in (
        ("metres.stl", "pass --unit-mm 1000 if it is in metres"),
        ("none.stl", "cannot be read"),
        ("broken.png", "is no PNG file"),
        ("none.png", "No such file"),
        ("even.png", "even.png: all pixels are alike, expected figures that are brighter"),
        ("huge.png", "3600000000 pixels, at most 50000000 are read"),
    ):
        with pytest.raises(SystemExit, match=rf"^train\.taps: .*{complaint}[^\n]*$"):
            taps.main(arguments(tapped[0], surface=tmp_path / surface))


def test_a_depth_image_lies_as_the_mesh(tapped):
    folder, _ = tapped
    mesh, pad, pose = surface_of(folder / "plate.stl"), GrippedPad(NOMINAL), Pose(-28.0, 31.0, 30.0)
    steps = (np.arange(900) + 0.5) / 10 - 45
    x_mm, y_mm = np.meshgrid(steps, -steps)
    image = np.zeros((900, 900))
    for name, (right, up) in zip(FIGURES, grid_places_mm(), strict=False):
        image[shapely.contains_xy(figure(name), x_mm - right, y_mm - up)] = 1
    drawn, expected = image_surface(image, 0.1)(pose, pad) > -1, mesh(pose, pad) > -1
    assert expected.mean() > 0.05 and (drawn == expected).mean() > 0.99


def published(path, held):
    """Write an object array as the authors do."""
    np.save(path, np.array([[one] for one in held], dtype=object), allow_pickle=True)
    return path


def test_published_taps_are_read(tapped, tmp_path, capsys):
    folder, _ = tapped
    image = np.zeros((100, 100))
    image[20:60, 30:70] = 0.8
    z = np.linspace(0, 400, 40)[:, None, None] * np.ones((40, 16, 3)) * (0.1, 0.1, 1)
    held = [{"sample_idx": number, "depth": image, "LRs": z.reshape(40, 48).tolist()} for number in range(27)]
    path = published(tmp_path / "C.npy", held)
    entry = load_sensor_file(folder / "sensor.toml").sensors["4"]
    found = recorded_taps.recorded_taps(path, entry, "4")
    assert len(found) == 27 and found[0].counts.shape == (16, 3, 4, 4) and found[0].counts[-1, 2].mean() == 400
    command = [str(path), "--sensor-file", str(folder / "sensor.toml"), "--out", str(tmp_path / "taps.npz")]
    taps.main(command)
    made = load_presses(tmp_path / "taps.npz")
    assert made.family[0] == "C" and made.touching.mean() == pytest.approx(0.16, abs=0.02)


class Evil:
    """An object whose pickle would run a command."""

    def __init__(self, *call):
        self._call = call

    def __reduce__(self):
        return self._call[0], self._call[1:]


def test_a_hostile_or_broken_file_is_one_line_and_runs_nothing(tapped, tmp_path, capsys):
    sensor_file = tapped[0] / "sensor.toml"
    for held in (
        Evil(print, "run"),
        {"depth": Evil(eval, "1 + 1"), "LRs": []},
        {"depth": np.ones((2, 2)), "LRs": Evil(np.fromfile, "/etc/hostname")},
        {"depth": np.eye(2), "LRs": [[np.nan] * 48]},
        {"depth": np.eye(2), "LRs": [[1.0] * 47]},
        3,
        Evil(bytearray, 1 << 40),
    ):
        path = published(tmp_path / "C.npy", [held])
        with pytest.raises(SystemExit, match=r"^train\.taps: .* is not a file of published taps"):
            taps.main([str(path), "--sensor-file", str(sensor_file), "--out", str(tmp_path / "t.npz")])
        assert capsys.readouterr() == ("", "")
    whole = published(path, [{"depth": np.eye(4), "LRs": [[1.0] * 48]}]).read_bytes()
    rng = np.random.default_rng(0)
    damaged = [whole[:end] for end in range(0, len(whole), 37)]
    for _ in range(200):
        at, spoilt = int(rng.integers(len(whole))), bytearray(whole)
        spoilt[at] = int(rng.integers(256))
        damaged.append(bytes(spoilt))
    entry = load_sensor_file(sensor_file).sensors["4"]
    for content in damaged:
        (tmp_path / "broken.npy").write_bytes(content)
        try:
            recorded_taps.recorded_taps(tmp_path / "broken.npy", entry, "4")
        except DatasetError as error:
            assert "\n" not in str(error)


def test_a_third_of_a_batch_are_own_taps_as_they_are():
    sensor = OneSensor((0.5,) * KNOWN, 0.0)
    world, mine = make_press_set(count=64, taps=1), make_press_set(count=12, taps=1, seed=1)
    mine.traction_kpa[:] = np.nan
    mine.counts[:] = np.arange(48, dtype=np.float32).reshape(3, 4, 4) * 50
    batch = with_own_taps(PressBatches(world, (1.0,), 24, seed=1, sensor=sensor), mine, sensor, seed=2)(0)
    own_rows = batch.traction.isnan().flatten(1).all(dim=1).numpy()
    assert own_rows.sum() == 12 and len(own_rows) == 36 and not batch.traction[~own_rows].isnan().any()
    read = batch.window[own_rows].numpy() * np.array([500, 500, 1000])[:, None, None]
    assert np.abs(read - mine.counts[0, 0]).mean() < 60, "drift and the earth's field alone, and no mirror image"

    def net(window, pad):
        pattern = batch.pattern.clone().requires_grad_()
        return pattern, batch.pattern + 1, batch.traction.nan_to_num(0)

    assert np.isfinite(HeteroscedasticError().loss(net, batch).item())


def test_taps_of_another_sensor_or_of_none_are_refused(tapped, tmp_path):
    folder, _ = tapped
    found = knowledge_of(load_sensor_file(folder / "sensor.toml"), None)
    make_press_set().save(tmp_path / "presses.npz")
    with pytest.raises(DatasetError, match="has no poses that are held out"):
        load_tap_parts(tmp_path / "presses.npz", "4", found.pad, constants(found.middle()))
    for config, complaint in (({"sensor": "6"}, "has taps of sensor 6, expected 4"), ({"sensor": "4"}, "at x2")):
        made = make_press_set()
        maps = {name: getattr(made, name)[:, ::5, ::5] for name in ("patterns", "touching")}
        replace(made, config=config | {"split": {}}, **maps).save(tmp_path / "presses.npz")
        with pytest.raises(DatasetError, match=complaint):
            load_tap_parts(tmp_path / "presses.npz", "4", found.pad, constants(found.middle()))
    taps.main(arguments(folder))
    entry = load_sensor_file(folder / "sensor.toml").sensors["4"]
    corrected = replace(entry, pad=replace(entry.pad, thickness_mm=5.0, intervals={}))
    save_sensor_file(tmp_path / "corrected.toml", SensorFile(sensors={"4": corrected}))
    with pytest.raises(SystemExit, match=r"has other constants of the pad than the sensor file: make it again"):
        own.main([str(tmp_path / "corrected.toml"), "--taps", str(folder / "taps.npz"), "--out", str(tmp_path)])


@pytest.mark.night
def test_from_taps_to_a_model_that_bears_its_sensor(tapped, tmp_path, capsys, limits):
    """In miniature it is chance whether it is handed over, but not what follows; continued, it is judged again."""
    limits(own, TRIED=48, COMPARED=24)
    plate, surface = tapped[0] / "plate.csv", tapped[0] / "plate.stl"
    file, handed = tapped[0] / "sensor.toml", tmp_path / "mine/mine.onnx"
    made = ["--sensor-file", str(file), "--out", str(tmp_path / "taps.npz")]
    taps.main([str(plate), str(plate), "--surface", str(surface), str(surface), *made])
    options = ["--taps", made[-1], "--minutes", "0.01", "--out", str(tmp_path / "mine")]
    for _ in range(2):
        try:
            own.main([str(file), *options, "--beside", str(find_model("stsr"))])
            failed = False
        except SystemExit as ended:
            failed = ended.code == 1
        said = capsys.readouterr().out
        assert f"{TAPPED} [dB]" in said and ("not handed over: " in said) == failed and handed.exists() != failed
    contract = ModelSession(tmp_path / "mine/work/mine-int8.onnx").contract
    known = knowledge_of(load_sensor_file(file), None).ranges["thickness_mm"]
    assert contract.read_trust() is not None and contract.made_for["thickness_mm"] == list(known)
    assert contract.is_outside(None) and not contract.is_outside(load_sensor_file(file).sensors["4"].used_pad)
