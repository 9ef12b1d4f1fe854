"""Messages of the vendor's server: what a reading in them is, and what is none."""

import json

import numpy as np
import pytest
from bridge_samples import REST_COUNTS
from hypothesis import given, settings
from hypothesis import strategies as st
from xela_server_emulator import message, sensor_entry

from firmware_bridge.scans.xela_server_messages import ServerDecoder

NAN = float("nan")
VALUES = np.asarray(REST_COUNTS).reshape(3, 16).T.ravel().tolist()


def decoded(text):
    """The message and the counters that are not zero, `messages` left out."""
    decoder = ServerDecoder()
    told = decoder.decode(text)
    counters = decoder.counters()
    assert counters.pop("messages") == 1
    return told, {name: count for name, count in counters.items() if count}


def only_reading(entry):
    told, counters = decoded(message(5, entry))
    (reading,) = told.readings
    return reading, counters


def test_axes_and_places():
    """x, y, z of one taxel side by side; taxels row by row from the top left."""
    entry = sensor_entry(data=list(range(48)), calibrated=[float(value) for value in range(48)])
    reading, _ = only_reading(entry)
    counts = reading.counts.reshape(3, 4, 4)
    assert counts[:, 0, 0].tolist() == [0, 1, 2] and counts[:, 0, 1].tolist() == [3, 4, 5]
    assert counts[:, 1, 0].tolist() == [12, 13, 14] and counts[:, 3, 3].tolist() == [45, 46, 47]
    assert (reading.newtons == counts).all()


@pytest.mark.parametrize(
    "changes",
    [
        {"integer": [7] * 48},
        {"data": VALUES, "integer": None},
        {"data": ",".join(f"{value:x}" for value in VALUES) + ",", "integer": None},
    ],
)
def test_every_form_of_the_counts(changes):
    reading, counters = only_reading(sensor_entry(**changes))
    assert (reading.counts.reshape(3, 4, 4) == REST_COUNTS).all() and counters == {}


@pytest.mark.parametrize(
    "changes",
    [
        *({"data": data} for data in (None, "", "8000," * 47, "8000," * 49, [[0] * 3] * 16, {"0": 1}, 12)),
        *(
            {"data": ",".join(["8000"] * 47 + [last])}
            for last in ("80 0", "-800", "8_00", "0x80", "18000", "\uff18\uff10\uff10\uff10", "")
        ),
        *({"data": [0] * 47 + last} for last in ([], [0, 0], [65536], [-1], [True], [1.0], ["1"], [None])),
        *({"taxels": taxels} for taxels in (None, "16", 16.0, True, -16)),
    ],
    ids=str,
)
def test_counts_and_numbers_of_taxels_that_are_none(changes):
    told, counters = decoded(message(5, sensor_entry(**changes)))
    assert told.readings == () and counters == {"bad_sensor": 1}


def test_other_sensors_are_named_and_left_out():
    decoder = ServerDecoder()
    text = message(5, sensor_entry(), sensor_entry(model="uSPa46", taxels=24), sensor_entry(model=None, taxels=1))
    for _ in range(3):
        assert [reading.sensor for reading in decoder.decode(text).readings] == ["1"]
    assert decoder.foreign == {"2": "'uSPa46' with 24 taxels", "3": "a model without a name with 1 taxels"}
    assert decoder.counters()["foreign_sensor"] == 6
    decoder.decode(message(5, sensor_entry(model="\x1b[2J" + "M" * 1000, taxels=10**30)))
    assert len(decoder.foreign["1"]) < 60 and decoder.foreign["1"].isprintable(), "it is a stranger's text"


@pytest.mark.parametrize(
    ("key", "field", "absent", "bad"),
    [
        ("ups", "ups_hz", [None], ["58", *([1.0] * 15 + end for end in ([], [-1.0], [1e9], [NAN]))]),
        (
            "calibrated",
            "newtons",
            [None],
            [[0.0] * 16, *([0.0] * 47 + [end] for end in (float("inf"), 10**400, 1001, True))],
        ),
        ("temp", "temperature_k", [None, [0.0] * 16], [[25.0] * 16, [300.0] * 17]),
        ("time", "acquired_s", [None], ["now", True, -1, 1e300, NAN]),
    ],
)
def test_what_else_is_wrong_costs_itself_alone(key, field, absent, bad):
    cases = [(sensor_entry() | {key: None}, {})]  # a null is as good as nothing
    cases += [(sensor_entry(**{key: value}), {}) for value in absent]
    cases += [(sensor_entry(**{key: value}), {"bad_values": 1}) for value in bad]
    for entry, counters in cases:
        reading, counted_now = only_reading(entry)
        assert (reading.counts.reshape(3, 4, 4) == REST_COUNTS).all()
        assert getattr(reading, field) is None and counted_now == counters, entry.get(key)


def test_a_taxel_without_thermometer():
    reading, _ = only_reading(sensor_entry(temp=[0.0] + [301.5] * 15))
    assert np.isnan(reading.temperature_k[0, 0]) and np.isnan(reading.temperature_k).sum() == 1


@pytest.mark.parametrize(
    ("counted", "texts"),
    [
        ("welcomes", ['{"message": "Welcome", "version": "1.7.6"}']),
        (
            "without_readings",
            [
                '{"message": 12}',
                '{"message": 12, "sensors": 0, "type": "welcome"}',
                '{"message": 12, "0x1": {}, "-1": {}, "": {}, "1234": {}, "²": {}, "1": []}',
            ],
        ),
        (
            "bad_json",
            [
                *(
                    f'{{"message": {number}}}'
                    for number in ('"welcome"', "true", "1.0", "NaN", "-1", "9" * 20, "9" * 6000)
                ),
                *("{}", "[1]", "null", "", b"\xff\xfe\x00", '{"message": 12, "time": 17', "x" * 50_000),
                *("[" * 100_000, '{"1":' * 40_000),
            ],
        ),
    ],
)
def test_other_messages(counted, texts):
    for text in texts:
        told, counters = decoded(text)
        assert (told.sequence is None) == (counted != "without_readings")
        assert (told.readings, counters) == ((), {counted: 1}), text[:50]


SCRAPS = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_subnormal=False) | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=4), inner, max_size=4),
    max_leaves=8,
)


@settings(max_examples=60, deadline=None)
@given(st.sampled_from(sorted(sensor_entry())), SCRAPS, st.binary(max_size=20), st.integers(0, 2000))
def test_whatever_stands_in_a_key_is_borne(key, scrap, noise, place):
    decoder = ServerDecoder()
    decoder.decode(json.dumps({"message": scrap, "time": scrap, "version": scrap, "1": scrap}))
    text = message(5, sensor_entry(**{key: scrap})).encode()
    for told in (decoder.decode(text), decoder.decode(text[:place] + noise + text[place:])):
        for reading in told.readings:
            assert reading.counts.shape == (3, 16) and 0 <= reading.counts.min() <= reading.counts.max() <= 65535
            assert reading.ups_hz is None or len(reading.ups_hz) == 16
