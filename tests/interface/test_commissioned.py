"""Effects of a sensor file on a run, and options that take precedence."""

from functools import partial

import numpy as np
import pytest
from bridge_samples import write_recording as write_counts
from cli_samples import write_recording
from edge_samples import BASELINE, REST, FakeModel, make_pad_contract, make_scan

from edge.api import Pad, RecordingError, Scan, Source, Stream, UsageError, open_recording, open_runtime, open_source
from edge.doctor.command import keep
from firmware_bridge.links.registry import open_sources
from firmware_bridge.links.serial_ports import Port
from firmware_bridge.scans.mounting import AS_MAPPED, Mounting
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
    """The first result of the press."""
    with open_source(pressed, sensor=sensor, id_map=id_map) as source:
        return next(iter(Stream(source, open_runtime(FakeModel(), source, **settings))))


def test_a_file_gives_map_mounting_baseline_force_and_adapter(file, pressed, plugged):
    plugged.append(Port("/dev/ttyUSB5", (0x0403, 0x6015), "D30BL366", "VScom"))
    source = open_source(sensor=file)
    assert source.name == "slcan:serial=D30BL366" and source.sensor_file.model_map.name == "XR1944"
    result = first(pressed, file)
    assert result.baseline.id == BASELINE.id and result.zeroed[2].min() == pytest.approx(-1800, abs=5)
    assert result.force_n == pytest.approx(result.force_counts / 1180)


PAD = Pad(thickness_mm=5.0, gains=tuple(np.linspace(0.5, 2, 48).tolist()))


def test_a_pad_goes_from_the_file_into_every_runtime(pressed, tmp_path):
    path = tmp_path / "pad.toml"
    save_sensor_file(path, SensorFile(sensors={"4": SensorEntry(baseline=BASELINE, pad=PAD)}))
    other = Pad(thickness_mm=4.0)
    for opened in (partial(open_source, pressed), partial(open_recording, pressed.removeprefix("replay:"))):
        for settings, expected in (({}, PAD), ({"pad": other}, other), ({"pad": {}}, None)):
            model = FakeModel(make_pad_contract())
            with opened(sensor=path) as source:
                results = Stream(source, open_runtime(model, source, **settings))
                # A replay keeps the recording's time: a scan that waited while the runtime was made may be dropped.
                assert next(result for result in results if result.state != "dropped").state == "contact"
            np.testing.assert_array_equal(model.pads[0], model.contract.pad_row(expected))


def test_the_doctor_keeps_the_pad_in_the_places_that_it_found(tmp_path):
    keep(tmp_path / "s.toml", SensorFile(sensors={"4": SensorEntry(pad=PAD)}), None, {}, {"4": TURNED}, {})
    kept = load_sensor_file(tmp_path / "s.toml").sensors["4"]
    assert kept.mounting == TURNED and kept.pad == PAD.turned(TURNED) != PAD


def test_a_baseline_of_another_order_is_refused(file, pressed, tmp_path):
    """Each taxel would get another one's rest."""
    save_baselines(tmp_path / "wired.json", [BASELINE])
    with pytest.raises(RecordingError, match=r"wired\.json: the taxels of sensor 4 lay in another order: zero again"):
        first(pressed, file, baselines=tmp_path / "wired.json")
    save_baselines(tmp_path / "placed.json", [BASELINE], {"4": TURNED.order})
    assert first(pressed, file, baselines=tmp_path / "placed.json").baseline
    with pytest.raises(RecordingError, match="another order"):
        first(pressed, baselines=tmp_path / "placed.json")


def test_options_go_before_the_file_but_for_another_id_map(file, pressed, tmp_path):
    newer = Baseline.of("4", REST + 5, 2000.0, 100, "file")
    save_baselines(tmp_path / "zero.json", [newer], {"4": TURNED.order})
    result = first(pressed, file, "XR1944", baselines=tmp_path / "zero.json", counts_per_newton=900)
    assert result.baseline.id == newer.id and result.force_n == pytest.approx(result.force_counts / 900)
    assert first(pressed, file, baselines={"4": newer}).baseline.id == newer.id
    assert first(pressed, file, baselines={}).state == "zeroing"
    assert open_source(pressed, sensor=file).name.endswith("taps.npz")
    with pytest.raises(UsageError, match=r"id map A, but .*s\.toml is of a XR1944"):
        open_source(pressed, sensor=file, id_map="A")
    with pytest.raises(UsageError, match=r"id map is 'C', expected one of: uSPa44, "):
        open_source(pressed, id_map="C")


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
