from dataclasses import replace

import numpy as np
import pytest
from bridge_samples import write_npz

from edge.doctor.guided_press import orders
from edge.inference.bundled import example_recording, find_model
from edge.inference.onnx_session import ModelSession
from edge.perception.gain_learning import load_contact_model
from firmware_bridge.recording.csv_reader import csv_header
from firmware_bridge.recording.formats import load_recording
from firmware_bridge.scans.mounting import Mounting
from firmware_bridge.scans.pad_constants import Pad
from firmware_bridge.sensor_file.model import SensorEntry, SensorFile, load_sensor_file
from firmware_bridge.sensor_file.toml_writer import save_sensor_file
from train import identify
from train.data.real_grips import play, recorded_grips
from train.errors import DatasetError
from train.families.catalogue import BARE
from train.learning.contact_mixture import CHANNELS, CONSTANTS, ContactMixture, Z, learned, write_model
from train.physics.gripped import GrippedPad
from train.physics.pad_draws import RANGES
from train.physics.pad_draws import Pad as SimulatedPad

AS_WIRED, TURNED = Mounting(), Mounting(orders()["turned by 90 degrees clockwise"], True, (1, -1, -1))


@pytest.fixture(scope="module")
def mixture():
    """Two kinds of contacts, of which the third constant moves every x."""
    rng = np.random.default_rng(0)
    means = np.zeros((2, 1 + len(CONSTANTS), CHANNELS))
    means[:, 0] = rng.normal(0, 0.5, (2, CHANNELS))
    means[:, 0, Z] = 1 + rng.normal(0, 0.2, (2, 16))
    means[:, 0, Z] /= np.sqrt((means[:, 0, Z] ** 2).mean(axis=1, keepdims=True))
    means[:, 3, :16] = 0.3
    mixing = rng.normal(0, 0.06, (2, CHANNELS, 4))
    covariances = mixing @ mixing.transpose(0, 2, 1) + 4e-4 * np.eye(CHANNELS)
    return ContactMixture(np.array([0.6, 0.4]), means, covariances)


def contacts(mixture, count, gains, constants, seed):
    rng = np.random.default_rng(seed)
    kind = rng.choice(2, count, p=mixture.share)
    centres = np.append(1.0, constants) @ mixture.means
    drawn = np.stack([rng.multivariate_normal(centres[k], mixture.covariances[k]) for k in kind])
    drawn /= np.sqrt((drawn[:, Z] ** 2).mean(axis=1, keepdims=True))
    return (drawn * gains * rng.uniform(400, 700, (count, 1))).reshape(count, 3, 4, 4).astype(np.float32)


def test_what_contacts_show_is_learned_or_else_the_prior_stays(mixture):
    log_gains = np.random.default_rng(1).normal(0, 0.075, (3, 16)).clip(-0.15, 0.15)
    log_gains = (log_gains - log_gains.mean(axis=1, keepdims=True)).ravel()
    constants = np.zeros(len(CONSTANTS))
    constants[2] = 0.5
    found = learned(contacts(mixture, 100, np.exp(log_gains), constants, 3), replace(mixture.model(), widening=1.3))
    off, half = np.abs(np.log(found.gains) - log_gains), found.pad().gain_half_widths
    assert np.sqrt((off**2).mean()) < np.sqrt((log_gains**2).mean()) / 2 and (off <= half).mean() > 0.85
    assert found.constants[2] == pytest.approx(0.5, abs=0.15)
    silent = [0, 1, 3, 4, 5, 6]
    np.testing.assert_allclose(found.constants[silent], 0, atol=1e-9)
    np.testing.assert_allclose(found.constant_deviations[silent], 1 / np.sqrt(3))
    assert found.determined.tolist() == [False, False, True, False, False, False, False]
    pad = found.pad()
    assert list(pad.constants) == list(pad.intervals) == ["in_plane_share"]
    assert "not determined" in identify.table("4", "100 contacts", pad)


def test_weak_clipped_and_held_contacts_are_not_used(mixture):
    read = contacts(mixture, 20, np.ones(CHANNELS), np.zeros(len(CONSTANTS)), 6)
    read[:5] *= 0.1
    read[5, 0, 1, 1] = 1400
    assert learned(read, mixture.model(), passes=1).contacts <= 14
    with pytest.raises(DatasetError, match="none of 5 contacts"):
        learned(read[:5], mixture.model())
    two = np.stack([read[10], read[10] * np.linspace(0.5, 1.5, 16).reshape(4, 4)])
    held = np.repeat(two, 30, axis=0) * np.linspace(0.8, 1.2, 60, dtype=np.float32)[:, None, None, None]
    assert len(identify.distinct(held)) == 2, "a held grip is one contact"


def test_former_contacts_stay_until_new_ones_are_whole(mixture, tmp_path):
    path = tmp_path / "contacts.npz"
    for _ in range(2):
        write_model(path, mixture, mixture.model())
    found = load_contact_model(path)
    assert found.means.shape == mixture.means.shape and (tmp_path / "contacts.npz.bak").exists()


def test_the_sensor_file_that_is_there_is_extended(tmp_path):
    path = tmp_path / "sensor.toml"
    save_sensor_file(path, SensorFile(sensors={"4": SensorEntry(counts_per_newton=1100.0), "5": SensorEntry()}))
    pad = Pad(poisson=0.45, intervals={"poisson": (0.43, 0.47)}, gains=tuple([1.1] * CHANNELS))
    save_sensor_file(path, identify.extended(load_sensor_file(path), {"4": pad}))
    found = load_sensor_file(path)
    assert found.pads == {"4": pad}
    assert set(found.sensors) == {"4", "5"}
    assert found.counts_per_newton == {"4": 1100.0}
    by_hand_and_ball = Pad(poisson=0.42, thickness_mm=4.1, intervals={"thickness_mm": (4.0, 4.2)})
    kept = identify.extended(SensorFile(sensors={"4": SensorEntry(pad=by_hand_and_ball)}), {"4": pad}).pads["4"]
    assert (kept.poisson, kept.thickness_mm, kept.gains) == (0.42, 4.1, pad.gains)


def gripped(folder, mounting=AS_WIRED, *columns):
    """Write the grips of the bundled recording as a sensor reads them that is mounted so, and return the folder."""
    counts = load_recording(example_recording()).tracks[0].counts - 33_000
    wired = (np.array(mounting.signs)[:, None, None] * counts)[:, [1, 0, 2] if mounting.swap_xy else [0, 1, 2]]
    wired = wired.reshape(-1, 3, 16)[:, :, np.argsort(mounting.order)].transpose(0, 2, 1).reshape(-1, 48) + 33_000
    (folder / "trial").mkdir(parents=True)
    rows = [[*csv_header(), *columns], *([*row, *columns] for row in wired.tolist())]
    (folder / "trial/xela_4.csv").write_text("".join(f"{','.join(map(str, row))}\n" for row in rows))
    return folder


def test_patterns_and_gains_belong_to_the_mounting(tmp_path, capsys):
    """Gains stay with their chips: a pad that is turned in the gripper reads the same contacts, elsewhere."""
    model, patterns, pads = ModelSession(find_model("stsr-small-int8")), [], []
    for name, mounting in (("even", AS_WIRED), ("turned", TURNED)):
        out, folder = tmp_path / f"{name}.toml", gripped(tmp_path / name, mounting)
        save_sensor_file(out, SensorFile(sensors={"4": SensorEntry(mounting)}))
        patterns.append(play(recorded_grips(folder, load_sensor_file(out))[0], model).patterns)
        identify.main([str(folder), "--out", str(out)])
        pads.append(load_sensor_file(out).sensors["4"].pad)
    np.testing.assert_allclose(*patterns, atol=1e-5)
    assert pads[0].gains == pytest.approx(pads[1].gains, abs=1e-3) and np.ptp(pads[0].gains) > 0.05
    assert capsys.readouterr().out.endswith("pads of 4\n")
    (tmp_path / "even/trial/xela_4.csv").rename(tmp_path / "even/trial/xela_left.csv")
    identify.main([str(tmp_path / "even"), "--out", str(tmp_path / "even.toml")])
    assert capsys.readouterr().out.endswith("pads of left, which was not in it\n"), "no gains of sensor 4"


def test_emulated_sensors_and_devices_teach_each_other_nothing(tmp_path, capsys):
    emulated = frozenset({"baseline"})
    for name, entry, columns, told in (
        ("device", SensorEntry(), ("emulated",), "is of an emulated sensor, expected one of a device"),
        ("emulated", SensorEntry(emulated=emulated), (), "is of a device, expected one of an emulated sensor"),
    ):
        out, folder = tmp_path / f"{name}.toml", gripped(tmp_path / name, AS_WIRED, *columns)
        save_sensor_file(out, SensorFile(sensors={"4": entry}))
        before = out.read_bytes()
        for more in ((), ("--ball-mm", "40")):
            path = folder / "trial/xela_4.csv" if more else folder
            with pytest.raises(SystemExit, match=rf"^train\.identify: [^\n]*xela_4.csv {told}[^\n]*doctor --out$"):
                identify.main([str(path), "--out", str(out), *more])
        assert out.read_bytes() == before
    out = tmp_path / "practice.toml"
    save_sensor_file(out, SensorFile(sensors={"4": SensorEntry(emulated=emulated)}))
    identify.main([str(tmp_path / "device"), "--out", str(out)])
    assert "pads of 4\n" in capsys.readouterr().out and load_sensor_file(out).sensors["4"].emulated == emulated


def test_what_is_not_read_of_a_recording_is_told_once(tmp_path, capsys):
    """Also of two fingers, of which the first is free, and the second has no weight."""
    path = gripped(tmp_path) / "trial/xela_4.csv"
    rows = path.read_text().splitlines(keepends=True)
    path.write_text("".join([*rows[:450], "1,2,3\n", *rows[450:]]))
    identify.main([str(tmp_path)])
    expected = f"{path} is damaged, line 451: 3 columns, expected 48: only the 449 scans before that are read\n"
    assert capsys.readouterr().err == expected
    pressed = load_recording(example_recording()).tracks[0].counts
    free = np.random.default_rng(6).integers(29998, 30003, pressed.shape)
    counts = np.stack([free, pressed], axis=1).reshape(-1, 3, 4, 4)
    path, times_ns = tmp_path / "both.npz", np.arange(len(pressed)).repeat(2) * 10_000_000
    write_npz(path, counts, times_ns, ["4", "6"] * len(pressed), origin=np.array(["emulated"] * len(counts)))
    emulated = SensorEntry(emulated=frozenset({"baseline"}))
    save_sensor_file(out := tmp_path / "sensor.toml", SensorFile(sensors={"4": emulated, "6": emulated}))
    with pytest.raises(SystemExit, match="counts per newton of sensor 6 are not in the sensor file"):
        identify.main([str(path), "--ball-mm", "40", "--out", str(out)])
    assert capsys.readouterr().err == f"{path} was recorded from an emulated sensor\n"


def test_grips_that_teach_something_wrong_are_one_line(tmp_path):
    held, out = gripped(tmp_path / "held") / "trial/xela_4.csv", tmp_path / "sensor.toml"
    header, first, *rows = held.read_text().splitlines(keepends=True)
    dead = first.split(",")[15:18]
    stuck = [",".join([*row.split(",")[:15], *dead, *row.split(",")[18:]]) for row in rows]
    for lines, told in (
        (stuck, "taxel 5 .* of xela_4 reads the same in all contacts, .*"),
        (rows[:248], "lower than where .* let go of it"),
        (rows[:98], "nothing presses a pad"),
    ):
        held.write_text("".join([header, first, *lines]))
        with pytest.raises(SystemExit, match=rf"^train\.identify: [^\n]*{told}[^\n]*$"):
            identify.main([str(held.parents[1]), "--out", str(out)])
    with pytest.raises(SystemExit, match=r"^train\.identify: .* expected a folder of TRIAL/xela_SENSOR.csv"):
        identify.main([str(tmp_path / "none"), "--out", str(out)])
    assert not out.exists()
    save_sensor_file(out, SensorFile("uSPa46", sensors={"4": SensorEntry(Mounting(taxel_count=24))}))
    with pytest.raises(SystemExit, match=r"has 16 taxels, and 24 in the sensor file, expected the 16 of a uSPa44"):
        identify.main([str(held.parents[1]), "--out", str(out)])


class Ball:
    """A recording of a ball of 40 mm pressed onto a simulated pad, and the pad."""

    def __init__(self, folder, presses):
        rng = np.random.default_rng(5)
        self.pad = SimulatedPad(thickness_mm=4.0, poisson=0.42, in_plane_share=0.3, shear_modulus_mpa=0.13)
        gripped, at = GrippedPad(self.pad), rng.uniform(-4, 4, (2, presses, 1, 1))
        away = np.square(gripped.places_mm[0] - at[0]) + np.square(gripped.places_mm[1] - at[1])
        heights = (np.sqrt(20.0**2 - away) - 20).astype(np.float32)
        course = np.concatenate([np.linspace(0.1, 1, 8), [1, 1], np.linspace(0.9, 0.1, 5)])
        depths = np.multiply.outer(np.linspace(0.38, 0.5, presses), course)
        n, every = depths.size, np.arange(presses).repeat(len(course))
        none = np.zeros(n)
        done = gripped.press(heights[every], depths.ravel(), np.zeros((n, 2)), none, none + 0.5, [BARE] * n)
        free = np.zeros((150, 3, 4, 4))
        scans = np.concatenate([free] + [np.concatenate([one, free]) for one in np.split(done.counts, presses)])
        scans = 30000 + scans + rng.normal(0, 1.5, scans.shape)
        self.path = write_npz(folder / "ball.npz", scans.round().astype(np.uint16))


@pytest.fixture(scope="module")
def ball(tmp_path_factory):
    return Ball(tmp_path_factory.mktemp("ball"), 6)


def weighed(ball, path, pad=None):
    """Write a sensor file with the counts per newton of a ball's pad, within 8 %, and return its path."""
    scale = ball.pad.counts_per_newton
    entry = SensorEntry(counts_per_newton=scale, counts_per_newton_interval=(0.92 * scale, 1.08 * scale), pad=pad)
    save_sensor_file(path, SensorFile(sensors={"4": entry}))
    return path


def test_presses_of_a_ball_give_the_constants(ball, tmp_path, capsys):
    """A constant that a person entered is kept, and what was measured before does not count again."""
    before = Pad(magnet_height_mm=2.5, thickness_mm=5.2, intervals={"thickness_mm": (5.1, 5.3)})
    out = weighed(ball, tmp_path / "sensor.toml", before)
    identify.main([str(ball.path), "--ball-mm", "40", "--out", str(out)])
    pad = load_sensor_file(out).sensors["4"].pad
    assert pad.magnet_height_mm == 2.5 and pad.counts_per_newton is None and "magnet_height_mm" not in pad.intervals
    assert {"thickness_mm", "poisson", "in_plane_share", "pitch_mm", "free_sides"} <= set(pad.intervals)
    for name, (low, high) in pad.intervals.items():
        assert low <= getattr(ball.pad, name) <= high, name
        assert high - low < np.ptp(RANGES[name]), name
    for name in ("thickness_mm", "poisson", "in_plane_share"):
        assert abs(getattr(pad, name) - getattr(ball.pad, name)) < 0.15 * np.ptp(RANGES[name]), name
    shown = capsys.readouterr().out
    assert "4: 6 presses of a ball\n" in shown and "entered by hand" in shown


@pytest.mark.night
def test_a_ball_of_half_the_stated_size_is_refused(ball, tmp_path):
    out = weighed(ball, tmp_path / "sensor.toml")
    before = out.read_bytes()
    with pytest.raises(SystemExit, match=r"a ball of 80 mm and the counts per newton contradict each other"):
        identify.main([str(ball.path), "--ball-mm", "80", "--out", str(out)])
    assert out.read_bytes() == before


def test_a_ball_without_a_weight_or_with_few_presses_is_one_line(tmp_path):
    few = Ball(tmp_path, 5)
    with pytest.raises(SystemExit, match=r"counts per newton of sensor 4 are not in the sensor file, .*: lay a weight"):
        identify.main([str(few.path), "--ball-mm", "40"])
    out = weighed(few, tmp_path / "sensor.toml")
    free = write_npz(tmp_path / "free.npz", np.random.default_rng(6).integers(29998, 30003, (300, 3, 4, 4)))
    with pytest.raises(SystemExit, match=r"0 presses with 0 scans below .* expected 12 or more"):
        identify.main([str(free), "--ball-mm", "40", "--out", str(out)])
    with pytest.raises(SystemExit, match=r"5 presses with 10 scans below .* expected 12 or more"):
        identify.main([str(few.path), "--ball-mm", "40", "--out", str(out)])
