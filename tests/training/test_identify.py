import numpy as np
import pytest

from firmware_bridge.scans.pad_constants import Pad
from firmware_bridge.sensor_file.model import SensorEntry, SensorFile, load_sensor_file
from firmware_bridge.sensor_file.toml_writer import save_sensor_file
from train import identify
from train.data.real_grips import recording_paths, recordings_folder
from train.errors import DatasetError
from train.learning.contact_mixture import CHANNELS, CONSTANTS, ContactMixture, Z, learned

FOLDER = recordings_folder()


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
    found = learned(contacts(mixture, 100, np.exp(log_gains), constants, 3), mixture.model(widening=1.3))
    off, half = np.abs(np.log(found.gains) - log_gains), found.pad().gain_half_widths
    assert np.sqrt((off**2).mean()) < np.sqrt((log_gains**2).mean()) / 2 and (off <= half).mean() > 0.85
    assert found.constants[2] == pytest.approx(0.5, abs=0.15)
    silent = [0, 1, 3, 4, 5, 6]
    np.testing.assert_allclose(found.constants[silent], 0, atol=1e-9)
    np.testing.assert_allclose(found.constant_deviations[silent], 1 / np.sqrt(3))
    assert found.determined.tolist() == [False, False, True, False, False, False, False]
    pad = found.pad()
    assert list(pad.constants) == list(pad.intervals) == ["in_plane_share"]
    assert "not determined" in identify.table("4", found.contacts, pad)


def test_weak_and_clipped_contacts_are_not_used(mixture):
    read = contacts(mixture, 20, np.ones(CHANNELS), np.zeros(len(CONSTANTS)), 6)
    read[:5] *= 0.1
    read[5, 0, 1, 1] = 1400
    assert learned(read, mixture.model(), passes=1).contacts <= 14
    with pytest.raises(DatasetError, match="none of 5 contacts"):
        learned(read[:5], mixture.model())


def test_a_held_grip_is_one_contact(mixture):
    read = contacts(mixture, 2, np.ones(CHANNELS), np.zeros(len(CONSTANTS)), 8)
    read[1] = read[0] * np.linspace(0.5, 1.5, 16).reshape(4, 4)
    held = np.repeat(read, 30, axis=0) * np.linspace(0.8, 1.2, 60, dtype=np.float32)[:, None, None, None]
    assert len(identify.distinct(held)) == 2


def test_the_sensor_file_that_is_there_is_extended(tmp_path):
    path = tmp_path / "sensor.toml"
    save_sensor_file(path, SensorFile(sensors={"4": SensorEntry(counts_per_newton=1100.0), "5": SensorEntry()}))
    pad = Pad(poisson=0.45, intervals={"poisson": (0.43, 0.47)}, gains=tuple([1.1] * CHANNELS))
    save_sensor_file(path, identify.extended(path, {"4": pad}))
    found = load_sensor_file(path)
    assert found.pads == {"4": pad}
    assert set(found.sensors) == {"4", "5"}
    assert found.counts_per_newton == {"4": 1100.0}


def test_a_folder_without_recordings_is_one_line(tmp_path):
    with pytest.raises(SystemExit, match=r"^train\.identify: .* expected a folder of TRIAL/xela_SENSOR.csv$"):
        identify.main([str(tmp_path / "none")])


@pytest.mark.skipif(not recording_paths(FOLDER), reason=f"no real recordings at {FOLDER} (TACTILE_RECORDINGS)")
def test_real_recordings_give_each_sensor_its_gains(tmp_path, capsys):
    out = tmp_path / "sensor.toml"
    identify.main([str(FOLDER), "--out", str(out)])
    pads = load_sensor_file(out).pads
    assert set(pads) == {"sensor1", "sensor2"}
    assert all(pad.gains is not None and max(pad.gains) > 1.02 for pad in pads.values())
    assert "sensor1" in capsys.readouterr().out
