"""Effects of a sensor file on a run, options that take precedence; and a pad of 4 x 6 taxels, from bytes to pattern."""

import json
from contextlib import suppress
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from bridge_samples import write_recording as write_counts
from cli_samples import write_recording
from edge_samples import BASELINE, REST, FakeModel, make_contract, make_pad_contract, make_scan, write_model
from mcap_samples import arrays_of

from edge import api
from edge.api import USPA46, ModelError, Pad, RecordingError, Runtime, Scan, Source, Stream, UsageError
from edge.doctor.guided_press import Press, corner_taxel, find_axes, find_order, orders
from firmware_bridge.emulation.slcan_emulator import Emulator
from firmware_bridge.errors import SensorFileError
from firmware_bridge.links.registry import open_sources
from firmware_bridge.links.serial_ports import Port
from firmware_bridge.recording.csv_reader import csv_header
from firmware_bridge.recording.formats import load_recording
from firmware_bridge.recording.tracks import Recording, Track
from firmware_bridge.scans.mounting import AS_MAPPED, Mounting
from firmware_bridge.scans.scan import ScanSeries
from firmware_bridge.sensor_file.model import SensorEntry, SensorFile, load_sensor_file
from firmware_bridge.sensor_file.toml_writer import save_sensor_file
from firmware_bridge.zeroing.baseline import Baseline, save_baselines

TURNED = Mounting(tuple(np.rot90(np.arange(16).reshape(4, 4)).ravel().tolist()), True, (1, -1, -1))


@pytest.fixture
def file(tmp_path):
    known = SensorFile("XR1944", "D30BL366", {"4": SensorEntry(TURNED, 1180.0, BASELINE), "6": SensorEntry()})
    save_sensor_file(tmp_path / "s.toml", known)
    return tmp_path / "s.toml"


@pytest.fixture
def pressed(tmp_path):
    """Source that replays a press of 1800 counts, recorded in place."""
    write_recording(tmp_path / "taps.npz", [1800] * 3)
    return f"replay:{tmp_path}/taps.npz"


def first(pressed, sensor=None, id_map=None, **settings):
    with api.open_source(pressed, sensor=sensor, id_map=id_map) as source:
        return next(iter(Stream(source, api.open_runtime(FakeModel(), source, **settings))))


def test_a_file_gives_map_mounting_baseline_force_and_adapter(file, pressed, plugged):
    plugged.append(Port("/dev/ttyUSB5", (0x0403, 0x6015), "D30BL366", "VScom"))
    source = api.open_source(sensor=file)
    assert source.name == "slcan:serial=D30BL366" and source.sensor_file.model_map.name == "XR1944"
    result = first(pressed, file)
    assert result.baseline.id == BASELINE.id and result.zeroed[2].min() == pytest.approx(-1800, abs=5)
    assert result.force_n == pytest.approx(result.force_counts / 1180)


PAD = Pad(thickness_mm=5.0, gains=tuple(np.linspace(0.5, 2, 48).tolist()))


def test_a_pad_goes_from_the_file_into_every_runtime(pressed, tmp_path):
    path = tmp_path / "pad.toml"
    save_sensor_file(path, SensorFile(sensors={"4": SensorEntry(baseline=BASELINE, pad=PAD)}))
    other = Pad(thickness_mm=4.0)
    for opened in (partial(api.open_source, pressed), partial(api.open_recording, pressed.removeprefix("replay:"))):
        for settings, expected in (({}, PAD), ({"pad": other}, other), ({"pad": {}}, None)):
            model = FakeModel(make_pad_contract())
            with opened(sensor=path) as source:
                results = Stream(source, api.open_runtime(model, source, **settings))
                # A replay keeps the recording's time: a scan that waited while the runtime was made may be dropped.
                assert next(result for result in results if result.state != "dropped").state == "contact"
            np.testing.assert_array_equal(model.pads[0], model.contract.pad_row(expected))


def test_options_go_before_the_file_but_for_another_id_map(file, pressed, tmp_path):
    newer = Baseline.of("4", REST + 5, 2000.0, 100, "file")
    save_baselines(tmp_path / "zero.json", [newer], {"4": TURNED.order})
    result = first(pressed, file, "XR1944", baselines=tmp_path / "zero.json", counts_per_newton=900)
    assert result.baseline.id == newer.id and result.force_n == pytest.approx(result.force_counts / 900)
    assert first(pressed, file, baselines={"4": newer}).baseline.id == newer.id
    assert first(pressed, file, baselines={}).state == "zeroing"
    assert api.open_source(pressed, sensor=file).name.endswith("taps.npz")
    with pytest.raises(UsageError, match=r"id map A, but .*s\.toml is of a XR1944"):
        api.open_source(pressed, sensor=file, id_map="A")
    with pytest.raises(UsageError, match=r"id map is 'C', expected one of: uSPa44, "):
        api.open_source(pressed, id_map="C")


def test_named_sources_are_put_in_place_each_by_its_own(tmp_path):
    """Sensor 4 of left and sensor 4 of right may sit in other ways."""
    for folder in ("left", "right"):
        (tmp_path / folder).mkdir()
        write_counts(tmp_path / folder / "4.csv", make_scan().counts[None])
    texts = [f"{name}=replay:{tmp_path}/{name}/4.csv" for name in ("left", "right")]
    found = {}
    with Source(*open_sources(texts, 100.0, mountings={"left/4": TURNED, "4": Mounting(AS_MAPPED[::-1])})) as source:
        while (taken := source.take(0.2)) is not None:
            found |= {one.sensor: one.counts for one in taken if isinstance(one, Scan)}
    turned = REST.reshape(3, 16)[:, list(TURNED.order)].reshape(3, 4, 4)  # where its taxels lie
    assert np.array_equal(found["left/4"], turned) and np.array_equal(found["right/4"], REST)


REST_46 = np.array([16_000, 16_400, 38_600], dtype=np.int32)[:, None, None] + 37 * np.arange(24).reshape(4, 6)
BASELINE_46 = Baseline.of("4", REST_46, 1.7e9, 100, "file")
CONTRACT_46 = make_contract(
    taps=1, sensor="uSPa46", rows=4, cols=6, pitch_mm=7.25, interval_factor=1.6, traction_scale=2
)
PRESSED = 17
REST_SCANS, SCANS = 20, 60


def test_bytes_become_patterns_and_files_of_the_pads_own_shape(tmp_path):
    """Scans at rest, then a press on one taxel of the third row, over a pseudo-terminal, and played again."""
    counts = REST_46 + np.random.default_rng(0).integers(-2, 3, (SCANS, *REST_46.shape)).astype(np.int32)
    for taxel, size in ((PRESSED, 4000), (PRESSED - 1, 400), (PRESSED - 6, 400)):  # a taxel alone would be a fault
        counts[REST_SCANS:, 2].reshape(-1, 24)[:, taxel] += size
    model = write_model(tmp_path / "pad46.onnx", CONTRACT_46)
    recording, results = Recording(tmp_path / "pad.npz", (Track("4", counts, None),), 100.0), []
    with (
        Emulator([recording]) as emulator,
        api.open_source(f"slcan:{emulator.port}", id_map="uSPa46", give_up_s=0) as source,
    ):
        pad = Pad(gains=(1.0,) * 72)
        runtime = api.open_runtime(api.load_model(model), source, baselines={"4": BASELINE_46}, pad=pad)
        sinks = [api.open_sink(f"{form}:{tmp_path}/out.{form}", CONTRACT_46, source) for form in ("jsonl", "mcap")]
        with suppress(api.LinkLostError):
            results.extend(Stream(source, runtime, sinks=sinks))
        for sink in sinks:
            sink.close()
    assert len(results) == SCANS
    assert all(result.scan.counts.shape == (3, 4, 6) and result.scan.complete for result in results)
    states = [result.state for result in results]
    # On a machine that is busy a newer scan may wait already.
    assert set(states[:REST_SCANS]) == {"idle"} and set(states[REST_SCANS:]) <= {"contact", "dropped"}
    pressed = [result for result in results if result.pattern is not None]
    assert pressed
    for result in pressed:
        assert result.pattern.shape == result.deviation.shape == (40, 60) and result.traction.shape == (3, 8, 12)
        row, col = np.unravel_index(result.pattern.argmax(), result.pattern.shape)
        assert 6 * (row // 10) + col // 10 == PRESSED
        assert result.area_mm2 == pytest.approx(7.25**2, rel=0.01)
        assert result.centroid_mm == pytest.approx((2.5 * 7.25, 0.5 * 7.25), abs=0.3)

    record = json.loads((tmp_path / "out.jsonl").read_text().partition("\n")[0])
    assert np.array(record["counts"]).shape == (3, 4, 6) and record["fresh"] == (1 << 24) - 1
    arrays = arrays_of(tmp_path / "out.mcap")
    assert arrays["counts"].shape == (SCANS, 3, 4, 6) and arrays["pattern"].shape == (SCANS, 40, 60)
    (track,) = load_recording(tmp_path / "out.mcap").tracks
    assert track.geometry == USPA46
    assert np.array_equal(track.counts, np.array([result.scan.counts for result in results]))
    with api.open_recording(tmp_path / "out.mcap") as source:
        again = list(Stream(source, api.open_runtime(model, source)))
        assert len(again) == SCANS
        # Of 4: it may be of the scan before.
        np.testing.assert_allclose(again[-1].pattern, results[-1].pattern, atol=0.01)
    with api.open_recording(tmp_path / "out.mcap") as source, pytest.raises(ModelError) as refused:
        api.open_runtime("stsr-small-int8", source)
    line = str(refused.value)
    assert "\n" not in line and "a uSPa44 of 4 x 4 taxels, the sensor is a uSPa46 of 4 x 6" in line


def test_a_pad_of_a_programs_own_is_an_object(tmp_path):
    """Six by six, which no release knows: a geometry, its id map, a model."""
    pad = api.SensorGeometry("mine", rows=6, cols=6, pitch_mm=3.0, width_mm=18.0, height_mm=18.0)
    contract = make_contract(taps=1, scale=4, sensor="mine", rows=6, cols=6, pitch_mm=3.0)
    rest = np.broadcast_to(np.array([16_000, 16_400, 38_600], dtype=np.int32)[:, None, None], (3, 6, 6))
    baseline = Baseline.of("4", rest, 1.7e9, 100, "file")
    source = api.open_source("slcan:/dev/none", id_map=api.layout_c(pad))
    assert source.sensor_file.geometry == pad
    model = api.load_model(write_model(tmp_path / "mine.onnx", contract))
    runtime = Runtime(model, source="device", geometry=source.sensor_file.geometry, baselines={"4": baseline})
    counts = rest.copy()
    counts[2, 5, 0] += 5000
    series = ScanSeries("4", pad)
    pattern = [runtime.push(series.close(counts + number, number * 10_000_000)) for number in range(3)][-1].pattern
    assert pattern is not None and pattern.shape == (24, 24) and pattern[20:, :4].min() > 0 == pattern[:20].max()
    with pytest.raises(SensorFileError, match="id map 'mine'"):
        save_sensor_file(tmp_path / "s.toml", replace(source.sensor_file, sensors={"4": SensorEntry()}))
    with pytest.raises(ValueError, match="at most 8 x 16"):
        api.layout_c(replace(pad, rows=9))
    with pytest.raises(ValueError, match="1 to 64"):
        api.layout_c(replace(pad, rows=8, cols=9))


def test_a_sensor_file_has_the_grid_of_its_model(tmp_path):
    turned = Mounting(tuple(reversed(range(24))), taxel_count=24)
    pad = Pad(thickness_mm=5.0, gains=(1.5,) * 72)
    written = SensorFile("uSPa46", None, {"4": SensorEntry(turned, 1180.0, BASELINE_46, pad)})
    save_sensor_file(tmp_path / "s.toml", written)
    text = (tmp_path / "s.toml").read_text()
    assert "    [23, 22, 21, 20, 19, 18],\n" in text
    read = load_sensor_file(tmp_path / "s.toml")
    assert read.geometry == USPA46 and read.mountings == written.mountings and read.pads == written.pads
    assert read.baselines["4"].id == BASELINE_46.id
    (tmp_path / "s.toml").write_text(text.replace('"uSPa46"', '"uSPa44"'))
    with pytest.raises(SensorFileError, match="expected 4 rows of 4"):
        load_sensor_file(tmp_path / "s.toml")


def test_a_recording_may_name_another_pad_than_its_scans_have(tmp_path):
    row = ",".join(["1000"] * 72)
    (tmp_path / "4.csv").write_text("\n".join([",".join(csv_header(24)), row, row, ""]))
    (track,) = load_recording(tmp_path / "4.csv").tracks
    assert track.geometry == USPA46
    (tmp_path / "4.csv").write_text("\n".join([",".join(csv_header(20)), ""]))
    with pytest.raises(RecordingError, match="60 columns"):
        load_recording(tmp_path / "4.csv")


def test_a_pad_that_is_not_square_can_lie_in_four_ways():
    assert len(orders()) == 8 and len(orders(USPA46)) == 4
    assert USPA46.corners == (0, 5, 23, 18)
    assert all(sorted(order) == list(range(24)) for order in orders(USPA46).values())
    for corner in USPA46.corners:
        z = np.zeros(24)
        z[corner] = 4000
        assert corner_taxel(z.reshape(4, 6)) == corner
    pushes = ((1, 1), (-1, 1), (-1, -1), (1, -1))
    presses = [Press(place, place, 1.0, push) for place, push in zip(USPA46.corners, pushes, strict=True)]
    assert find_order(presses, USPA46) == "as in the id map"
    assert find_axes(presses, USPA46) == (False, (1, 1))
