"""Camera plugin of LeRobot: in LeRobot where that is installed, else in a stand-in of its published interface."""

import importlib
import importlib.util
import json
import os
import re
import runpy
import shlex
import subprocess
import sys
import time
from dataclasses import replace

import lerobot_stand_in
import numpy as np
import pytest
from edge_samples import ROOT, make_contract, make_wrench_result

from edge.api import demo_recording, load_model

PACKAGE = ROOT / "examples/lerobot_camera_tactile_sr"
REAL = importlib.util.find_spec("lerobot") is not None


@pytest.fixture(scope="module")
def plugin(tmp_path_factory):
    """The plugin as LeRobot's discovery finds it: installed, by its name alone."""
    with pytest.MonkeyPatch.context() as patch:
        if not REAL:
            lerobot_stand_in.install(patch)
        site = tmp_path_factory.mktemp("site")
        installed = site / "lerobot_camera_tactile_sr-0.1.0.dist-info"
        installed.mkdir()
        (installed / "METADATA").write_text("Metadata-Version: 2.1\nName: lerobot_camera_tactile_sr\nVersion: 0.1.0\n")
        patch.syspath_prepend(site)
        patch.syspath_prepend(PACKAGE / "src")
        from lerobot.utils.import_utils import register_third_party_plugins

        assert "lerobot_camera_tactile_sr" not in sys.modules
        register_third_party_plugins()
        yield sys.modules["lerobot_camera_tactile_sr"]
        for name in [name for name in sys.modules if name.startswith("lerobot_camera_tactile_sr")]:
            del sys.modules[name]


def camera_of(plugin, **settings):
    from lerobot.cameras.utils import make_cameras_from_configs

    config = plugin.TactileSrCameraConfig(**settings)
    assert config.type == "tactile_sr"
    return make_cameras_from_configs({"tactile": config})["tactile"]


def test_it_reads_an_emulated_sensor_as_a_robot_reads_a_camera(plugin):
    camera = camera_of(plugin, source="demo:loop", pretend=True, width=80, height=80)
    with pytest.raises(ConnectionError, match=r"is not connected"):
        camera.async_read()
    assert isinstance(camera.find_cameras(), list)
    camera.connect()
    try:
        with pytest.raises(ConnectionError, match=r"connected already"):
            camera.connect()
        end_s, touched = time.monotonic() + 20, False
        while not touched:
            assert time.monotonic() < end_s, "the demo presses within seconds"
            image = camera.async_read(timeout_ms=1000)
            assert image.shape == (camera.height, camera.width, 3) == (80, 80, 3) and image.dtype == np.uint8
            touched = bool(image[..., 0].max() > 50)
        latest, state = camera.read_latest(), camera.read_state()
        assert latest.shape == image.shape and (latest[::2, ::2] == latest[1::2, 1::2]).all()
        assert state.keys() == camera.state_features.keys() and set(camera.state_features.values()) == {float}
        assert np.isfinite(list(state.values())).all() and len(state) in (49, 55)
        assert camera.read().shape == image.shape
        window = camera.read_window()
        assert window.shape == (4, 48) and window.dtype == np.float32 and len(np.unique(window, axis=0)) == 4
        time.sleep(0.05)
        with pytest.raises(TimeoutError, match=r"ms old, expected at most 0 ms"):
            camera.read_latest(max_age_ms=0)
    finally:
        camera.disconnect()
    assert not camera.is_connected
    with pytest.raises(ConnectionError, match=r"is not connected"):
        camera.disconnect()


UNCLOSED = """
import lerobot_stand_in, pytest, threading
if {stand_in}:
    lerobot_stand_in.install(pytest.MonkeyPatch())
from lerobot_camera_tactile_sr import TactileSrCamera, TactileSrCameraConfig
camera = TactileSrCamera(TactileSrCameraConfig(source="demo:loop", pretend=True))
camera.connect()
print(camera.read().shape, flush=True)
raise RuntimeError("of the robot")
"""


def test_a_program_ends_that_never_disconnects():
    folders = [ROOT, ROOT / "tests/support", PACKAGE / "src"]
    where = os.environ | {"PYTHONPATH": os.pathsep.join(map(str, folders))}
    command = [sys.executable, "-c", UNCLOSED.format(stand_in=not REAL)]
    done = subprocess.run(command, env=where, capture_output=True, text=True, timeout=30, check=False)
    assert (done.returncode, done.stdout) == (1, "(40, 40, 3)\n"), done.stderr
    assert done.stderr.endswith("RuntimeError: of the robot\n")


def test_what_is_no_sensor_is_refused_unless_one_pretends(plugin):
    camera = camera_of(plugin, source="demo:loop")
    with pytest.raises(ConnectionError, match=r"is emulated, not a sensor: set pretend"):
        camera.connect()
    assert not camera.is_connected
    with pytest.raises(ConnectionError, match=r"/dev/nothing"):
        camera_of(plugin, source="slcan:/dev/nothing").connect()
    for wrong, told in (
        ({"width": 41}, "image of 41x40, expected a multiple of the pattern's 40x40"),
        ({"window_scans": 0}, "window_scans is 0, expected 1 or more"),
        ({"render": "heatmap"}, "'heatmap', expected one of pattern, vector_rgb"),
        ({"force_max_n": 0}, "0"),
    ):
        with pytest.raises(ValueError, match=told):
            camera_of(plugin, **wrong)


def test_images_have_a_fixed_range_and_mark_what_is_not_believed(plugin):
    observation = importlib.import_module("lerobot_camera_tactile_sr.observation")
    pressed, free = make_wrench_result(), make_wrench_result(press_counts=0)
    contract = make_contract(traction_scale=2)
    pattern = np.zeros((40, 40), dtype=np.float32)
    pattern[3, 7], pattern[0, 0], pattern[1, 1] = 0.15, -0.1, 9.0
    one = replace(pressed, pattern=pattern, deviation=pattern / 10, trusted=True)
    rendering = observation.Rendering()
    image = rendering.image_of(one, contract)
    assert image[3, 7].tolist() == [128, 13, 255] and image[0, 0, 0] == 0 and image[1, 1, 0] == 255
    for doubt in ({"trusted": False}, {"trusted": None}, {"state": "baseline_in_doubt", "contact": None}):
        assert rendering.image_of(replace(one, **doubt), contract)[..., 2].max() == 0
    assert rendering.image_of(replace(free, pattern=None), contract)[..., 2].min() == 255, "nothing touches"
    nothing = dict.fromkeys(("pattern", "deviation", "contact", "zeroed", "wrench"))
    unknown = replace(one, **nothing, state="zeroing")
    assert not rendering.image_of(unknown, contract).any()
    state = observation.state_of(replace(pressed, trusted=True), contract)
    assert [state[name] for name in observation.WRENCH] == [*pressed.wrench.force_n, *pressed.wrench.torque_n_mm]
    assert state["taxel_z_5"] == pressed.zeroed[2, 1, 1] and state["believed"] == 1
    assert observation.state_of(unknown, contract)["believed"] == 0
    dead = pressed.zeroed.copy()
    dead[:, 0, 0] = np.nan
    state = observation.state_of(replace(pressed, zeroed=dead), contract)
    assert (state["taxel_x_0"], state["believed"]) == (0.0, 0.0)


def test_forces_are_drawn_as_the_paxini_plugin_draws_them(plugin):
    observation = importlib.import_module("lerobot_camera_tactile_sr.observation")
    contract = make_contract(traction_scale=2)
    traction = np.zeros((3, 8, 8), dtype=np.float32)
    traction[:, 2, 5] = np.array([-2.0, 1.0, 7.0]) * 1000 / contract.pitch_mm**2  # N on a taxel's area
    one = replace(make_wrench_result(), traction=traction, trusted=True)
    drawn = observation.Rendering("vector_rgb", force_max_n=5.0)
    image = drawn.image_of(one, contract, zoom=2)
    assert image.shape == (80, 80, 3) and (image[20:30, 50:60] == (77, 153, 255)).all()
    assert (np.delete(image, slice(50, 60), axis=1) == 128).all()
    for doubt in ({"trusted": False}, {"state": "baseline_in_doubt", "contact": None}, {"traction": None}):
        assert (drawn.image_of(replace(one, **doubt), contract) == 128).all()


def test_a_recording_becomes_frames_at_the_dataset_s_rate(plugin):
    to_dataset = importlib.import_module("lerobot_camera_tactile_sr.to_dataset")
    model = load_model("stsr-int8")
    results = to_dataset.results_of(demo_recording(), model)
    scans, rendering = to_dataset.scans_in_frame(results, 10), to_dataset.Rendering()
    frames = list(to_dataset.frames_of(results, 10, model.contract, rendering, scans))
    features = to_dataset.features_of(frames[0][0], model.contract, "image", scans)
    for sensors, frame in frames:
        assert frame.keys() == features.keys() and sensors == frames[0][0]
        for key, values in frame.items():
            assert values.shape == features[key]["shape"], key
    touched = [frame[to_dataset.key_of("images", frames[0][0][0])][..., 0].max() for _, frame in frames]
    assert min(touched) == 0 and max(touched) > 100
    (numbers,) = (key for key in features if key.startswith("observation.tactile."))
    names = features[numbers]["names"]
    assert len(names) == len(set(names)) == frames[0][1][numbers].size
    readings = np.array([result.zeroed.ravel() for result in results if result.zeroed is not None])
    windows = np.stack([frame["observation.tactile_window"] for _, frame in frames])
    assert (windows[0] == windows[0, 0]).all(), "the first reading stands for those before it"
    assert (windows[1:].reshape(-1, 48) == readings[1 : 1 + scans * (len(frames) - 1)]).all(), "each scan, once"


@pytest.mark.skipif(not REAL, reason="LeRobot is not installed: pip install lerobot")
def test_lerobot_loads_the_dataset_that_it_was_given(plugin, tmp_path):
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    to_dataset = importlib.import_module("lerobot_camera_tactile_sr.to_dataset")
    words = [str(demo_recording()), str(demo_recording()), "--repo-id", "me/presses", "--task", "press", "--fps", "10"]
    assert to_dataset.main([*words, "--root", str(tmp_path / "set")]) == 0
    dataset = LeRobotDataset("me/presses", root=tmp_path / "set")
    assert dataset.num_episodes == 2 and dataset.fps == 10
    (key,) = [key for key in dataset.features if key.startswith("observation.images.")]
    images = np.stack([dataset[index][key].numpy() for index in range(dataset.num_frames)])
    assert images.shape[1:] == (3, 40, 40) and images[:, 0].max() > 0.4
    info = json.loads((tmp_path / "set/meta/info.json").read_text())
    assert info["features"]["observation.tactile.4"]["dtype"] == "float32"
    assert dataset[5]["observation.tactile_window"].shape == (10, 48)


def test_the_example_observes_by_the_command_of_the_readme(plugin, argv, capsys):
    (line,) = re.findall(
        r"^ *(python examples/lerobot_camera_tactile_sr/observe\.py .*)$", (ROOT / "README.md").read_text(), re.M
    )
    words = shlex.split(line, comments=True)[1:]
    argv(words)
    runpy.run_path(str(ROOT / words[0]), run_name="__main__")
    image = r"observation\.images\.tactile: \(40, 40, 3\) uint8, .*"
    assert re.match(image + r"\nobservation\.state: \d+ numbers, .*", capsys.readouterr().out)
