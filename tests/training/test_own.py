"""A model for one sensor: what is known of it, what its network is told, and whether it is handed over."""

from pathlib import Path

import numpy as np
import pytest
from edge_samples import make_contract, write_model
from press_samples import make_press_set

from edge.inference.bundled import find_model
from edge.inference.onnx_session import ModelSession
from firmware_bridge.pad_geometry import CHANNELS
from firmware_bridge.recording.csv_reader import csv_header
from firmware_bridge.scans.mounting import Mounting
from firmware_bridge.scans.pad_constants import Pad
from firmware_bridge.sensor_file.model import SensorEntry, SensorFile
from firmware_bridge.sensor_file.toml_writer import save_sensor_file
from firmware_bridge.zeroing.baseline import Baseline
from train.data.press_batches import OneSensor, PressBatches
from train.data.real_grips import Grip
from train.data.world import World, solve_pad
from train.learning.sensor_knowledge import Knowledge, knowledge_of
from train.own import OWN, REPLACED, TAPPED, UNLIKE, compared, main
from train.physics.pad_draws import KNOWN, RANGES
from train.physics.sensor_noise import NAMES, Nuisances

THICK = Pad(
    thickness_mm=5.0,
    intervals={"thickness_mm": (4.9, 5.1)},
    shear_modulus_mpa=0.12,
    gains=(1.0,) * CHANNELS,
    gain_half_widths=(0.025,) * CHANNELS,
)
FILE = SensorFile(sensors={"4": SensorEntry(pad=THICK, counts_per_newton=1100.0)})
BEYOND = SensorFile(sensors={"4": SensorEntry(pad=Pad(thickness_mm=50.0))})
OTHER_PAD = SensorFile("uSPa46", sensors={"4": SensorEntry(Mounting(taxel_count=24))})
REHEARSED = SensorFile(sensors={"4": SensorEntry(counts_per_newton=1100.0, emulated=frozenset({"force"}))})


def test_pads_are_drawn_as_wide_as_what_is_not_known():
    found = knowledge_of(FILE, None)
    assert found.ranges["thickness_mm"] == (4.9, 5.1), "by its interval"
    assert found.ranges["shear_modulus_mpa"] == pytest.approx((0.114, 0.126)), "a fifth where nobody said how well"
    assert found.ranges["poisson"] == RANGES["poisson"]
    low, high = found.ranges["counts_per_newton"]
    assert low < 1100 < high and high - low == pytest.approx(0.2 * np.ptp(RANGES["counts_per_newton"]))
    pads = solve_pad(World(count=2, per_pad=1, families={"flat": 1.0}, ranges=found.ranges), 0)
    assert abs(4.5 + 0.9 * pads.constants[0, 0] - 5.0) <= 0.1
    wider = found.widened()
    assert wider["thickness_mm"] == pytest.approx((4.9 - 0.36, 5.1 + 0.36))
    assert wider["poisson"][1] < 0.5 and wider["free_sides"][0] == 0
    text = found.told()
    assert "thickness_mm to 11%" in text and "gains to 1.5 %" in text and "not known: poisson, " in text

    weighed = SensorEntry(
        pad=Pad(intervals={"counts_per_newton": (10.0, 20.0)}),  # without a value
        counts_per_newton=1100.0,
        counts_per_newton_interval=(1050.0, 1200.0),
    )
    ranges = knowledge_of(SensorFile(sensors={"4": weighed}), None).ranges
    assert ranges["counts_per_newton"] == (1050, 1200), "by the interval of the weight"


def test_its_network_is_told_of_it_in_most_windows():
    sensor = OneSensor(tuple(np.linspace(0.1, 1, KNOWN).tolist()), 0.2)
    presses = make_press_set(count=64, taps=1)
    presses.counts[:] = 4000
    alone = Nuisances().without(*(name for name in NAMES if name != "gain_spread"))
    batch = PressBatches(presses, (1.0,), 64, seed=1, nuisances=alone, sensor=sensor)(0)
    told = batch.pad.numpy().any(axis=1)
    assert 0.6 < told.mean() < 0.9 and np.allclose(batch.pad[told], sensor.row)
    relative = np.abs(batch.window.numpy()) * np.array([500, 500, 1000])[:, None, None] / 4000
    assert relative.std() == pytest.approx(0.2 * 0.075, rel=0.1)


def test_what_is_worse_is_not_handed_over(tmp_path):
    """In place of an own model: a tiny one that knows nothing, and then the bundled one against itself."""
    sets = {name: solve_pad(World(count=12, per_pad=12, seed=seed), 0) for seed, name in enumerate(("figures", UNLIKE))}
    found = knowledge_of(FILE, "4")
    tiny = ModelSession(write_model(tmp_path / "tiny.onnx", make_contract(scale=10, taps=1, output_full_scale=0.5)))
    table, objection, gains = compared(tiny, found, sets, [])
    rows = [line.strip("| ").split(" | ")[0] for line in table.splitlines()]
    assert rows == ["method", "---", OWN, "stsr-int8", "bilinear", "over stsr-int8", "pads below it"]
    assert gains["figures"] in table
    assert objection is not None and "on figures it is -" in objection and "to stsr-int8" in objection
    losing = "on 100% of the pads that this may be, expected at most 20%: train on taps of the sensor"
    assert f"below stsr-int8 {losing} (train.taps)" in objection
    bundled = ModelSession(find_model("stsr-int8"))
    tapped = compared(tiny, found, sets | {TAPPED: sets["figures"]}, [], {"mine": bundled}).objection
    assert tapped is not None and f"on {TAPPED} it is -" in tapped and "the pads" not in tapped, "of this one alone"
    assert tapped.count("to mine") == 1, "own taps decide between further models"
    _, objection, _ = compared(tiny, Knowledge("any", Pad(), RANGES), sets, [])
    assert "expected at most 20%" in objection and "train.taps" not in objection, "of a model for any sensor"
    rest = Baseline.from_counts("xela_4", np.full((2, 3, 4, 4), 30_000), created_unix_s=0.0)
    free = Grip("untouched", np.full((30, 3, 4, 4), 30_000), rest)
    _, objection, _ = compared(tiny, found, sets, [free])
    assert "in untouched nan% of its patterns have holes" in objection, "no pattern is no proof"
    counts = [np.full((30, 3, 4, 4), 30_000), 30_000 + sets["figures"].counts[:, 0].round().astype(int)]
    held = Grip("held", np.concatenate(counts), rest)
    table, objection, _ = compared(tiny, found, sets, [held])
    assert "hidden taxel [counts]" in table and "of a taxel that is hidden it is " in objection
    _, objection, _ = compared(bundled, found, sets, [held])
    assert objection is not None and not any(word in objection for word in (UNLIKE, "hidden")), "no worse there"
    _, objection, _ = compared(tiny, found, sets, [], {REPLACED: bundled})
    assert objection is not None and objection.count(f"to {REPLACED}") == 1, "the better one stays, by pads like it"
    _, objection, _ = compared(bundled, found, sets, [], {REPLACED: bundled})
    assert f"to {REPLACED}" not in objection, "the same one may be handed over again"


@pytest.mark.parametrize(
    ("held", "options", "told"),
    [
        (None, [], "sensor.toml"),
        (
            SensorFile(sensors={"4": SensorEntry(), "6": SensorEntry()}),
            [],
            "has the sensors 4, 6: name one of them with --sensor",
        ),
        (FILE, ["--sensor", "6"], "has the sensors 4: name one of them with --sensor"),
        (SensorFile(sensors={"4": SensorEntry()}), [], "nothing is known of this sensor, "),
        (REHEARSED, [], "has force of an emulated sensor 4, .*: write one of your sensor with edge-sr doctor --out"),
        (BEYOND, [], "thickness_mm of sensor 4 is 50, expected 3.1 to 7.2 of a pad that can be simulated: measure it"),
        (OTHER_PAD, [], "of a uSPa46, expected a uSPa44"),
        (FILE, [], "nothing to compare it on: .* pass --recordings or --taps, or --without-recordings"),
        (FILE, ["--beside", "x4.onnx"], "x4 is a model of 2 taps at x4, expected one of a single tap, or of several"),
        (FILE, ["--mesh", "none.stl"], "none.stl: cannot be read"),
        (FILE, ["--recordings", "."], "holds no recordings: expected a folder of TRIAL/xela_SENSOR.csv"),
        (FILE, ["--recordings", "free"], "nothing presses the pad in trial of free, expected a grip of a flat face"),
        (FILE, ["--recordings", "played"], "xela_4.csv is of an emulated sensor, expected one of a device"),
    ],
)
def test_bad_input_is_one_line(tmp_path, monkeypatch, held, options, told):
    monkeypatch.chdir(tmp_path)
    write_model(Path("x4.onnx"), make_contract(scale=4, taps=2))
    Path("played/trial").mkdir(parents=True)
    Path("free/trial").mkdir(parents=True)
    Path("free/trial/xela_4.csv").write_text(f"{','.join(csv_header())}\n{'30000,' * 47}30000\n")
    Path("played/trial/xela_4.csv").write_text(f"{','.join(csv_header())},emulated\n{'30000,' * 48}1\n")
    if held is not None:
        save_sensor_file(tmp_path / "sensor.toml", held)
    with pytest.raises(SystemExit, match=rf"^train\.own: [^\n]*{told}[^\n]*$"):
        main(["sensor.toml", "--out", "mine", *options])
