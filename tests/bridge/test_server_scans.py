"""Messages of the vendor's server: what a reading in them is, what is none, and the scans that they make."""

import json

import numpy as np
import pytest
from bridge_samples import REST_COUNTS
from hypothesis import given, settings
from hypothesis import strategies as st
from xela_server_emulator import MS, UNIX_S, message, sensor_entry

from firmware_bridge.scans.xela_server_messages import MOST_SENSORS, ServerDecoder
from firmware_bridge.scans.xela_server_scans import MOST_MISSED, ServerScans

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
    reading, _ = only_reading(sensor_entry(data=list(range(48)), calibrated=[float(value) for value in range(48)]))
    expected = np.arange(48).reshape(4, 4, 3).transpose(2, 0, 1)
    assert (reading.counts.reshape(3, 4, 4) == expected).all() and (reading.newtons == expected).all()


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
        *({"data": data} for data in (None, "", "8000," * 47, "8000," * 49, [[0] * 3] * 16)),
        *({"data": ",".join(["8000"] * 47 + [last])} for last in ("-800", "8_00", "18000", "\uff18\uff10")),
        *({"data": [0] * 47 + last} for last in ([], [0, 0], [65536], [-1], [True], [1.0])),
        *({"taxels": taxels} for taxels in (None, "16", -16)),
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
    ("key", "field", "bad"),
    [
        ("ups", "ups_hz", ["58", *([1.0] * 15 + end for end in ([], [-1.0], [1e9], [NAN]))]),
        ("calibrated", "newtons", [[0.0] * 16, *([0.0] * 47 + [end] for end in (float("inf"), 10**400, 1001, True))]),
        ("temp", "temperature_k", [[25.0] * 16, [300.0] * 17]),
        ("time", "acquired_s", ["now", True, -1, 1e300, NAN]),
    ],
)
def test_what_else_is_wrong_costs_itself_alone(key, field, bad):
    cases = [(sensor_entry(**{key: value}), {"bad_values": 1}) for value in bad]
    for entry, counters in [(sensor_entry() | {key: None}, {}), (sensor_entry(**{key: None}), {}), *cases]:
        reading, counted_now = only_reading(entry)
        assert (reading.counts.reshape(3, 4, 4) == REST_COUNTS).all()
        assert getattr(reading, field) is None and counted_now == counters, entry.get(key)


def test_a_taxel_without_thermometer_or_a_sensor():
    reading, _ = only_reading(sensor_entry(temp=[0.0] + [301.5] * 15))
    assert np.isnan(reading.temperature_k[0, 0]) and np.isnan(reading.temperature_k).sum() == 1
    reading, counters = only_reading(sensor_entry(temp=[0.0] * 16))
    assert reading.temperature_k is None and counters == {}


@pytest.mark.parametrize(
    ("counted", "texts"),
    [
        ("welcomes", ['{"message": "Welcome", "version": "1.7.6"}']),
        ("without_readings", ['{"message": 12, "0x1": {}, "-1": {}, "": {}, "1234": {}, "²": {}, "1": []}']),
        ("bad_json", [f'{{"message": {number}}}' for number in ("true", "1.0", "-1", "9" * 20, "9" * 6000)]),
        ("bad_json", ["{}", "[1]", "", b"\xff\xfe\x00", '{"message": 12, "time": 17', "[" * 100_000, '{"1":' * 40_000]),
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


class Server:
    """Server with messages and times of the test; arrivals are 2 ms after the sending."""

    def __init__(self) -> None:
        self.scans = ServerScans()
        self.sequence = 0
        self.clock_s = UNIX_S

    def say(self, at_ms: float, counts=REST_COUNTS, *, age_ms: float = 0.0, number: int | None = None, **changes):
        """Return the scans that one message about one sensor closes, sent at a time in [ms]."""
        sent_s = self.clock_s + at_ms / 1e3
        entry = sensor_entry(counts, **({"time_s": sent_s - age_ms / 1e3} | changes))
        text = message(self.sequence if number is None else number, entry, time_s=sent_s)
        self.sequence += 1
        return self.scans.feed(text, round((at_ms + 2) * MS))

    def counted(self, *names: str) -> tuple[int, ...]:
        counters = self.scans.counters()
        return tuple(counters[name] for name in names)


def cycle(number: int, taxels=range(16)) -> np.ndarray:
    """Counts in which these taxels are of one cycle, the others at rest."""
    counts = REST_COUNTS.reshape(3, 16).copy()
    counts[:, list(taxels)] += number
    return counts


def test_a_still_pad_gives_repeated_scans():
    server = Server()
    scans = [scan for step in range(600) for scan in server.say(2 * step)]
    assert scans[0].whole and all(scan.repeated for scan in scans[1:])
    assert 72 <= len(scans) <= 81  # 1.2 s of 100 Hz, each due after a period and a half
    assert server.scans.trouble is None, "it is no dead cable"


def test_half_a_cycle_waits_for_the_other_half():
    """A taxel with the same counts as before is taken as repeated: noise does that, and waiting would cost a cycle."""
    server = Server()
    server.say(0)
    assert server.say(4, cycle(1, range(7))) == []
    (scan,) = server.say(10, cycle(1))
    assert scan.whole and (scan.counts.reshape(3, 16) == cycle(1)).all()
    (scan,) = server.say(20, cycle(2, range(15)) + (np.arange(16) == 15))
    assert scan.complete and np.flatnonzero(~scan.renewed).tolist() == [15]
    assert server.counted("torn_source") == (1,)


def test_a_taxel_without_updates_is_absent_unless_it_changes():
    server = Server()
    ups = [100.0] * 15 + [0.0]
    server.say(0)
    for step in range(1, 50):
        (scan,) = server.say(10 * step, cycle(step, range(15)), ups=ups)
        assert np.flatnonzero(scan.fresh).tolist() == list(range(15))
    assert server.counted("torn_wire", "missing_taxels") == (49, 49)
    (scan,) = server.say(500, cycle(50), ups=ups)
    assert scan.whole


@pytest.mark.parametrize("unknown", [{"ups": 0.0}, {"time_s": UNIX_S}, {"ups": 0.0, "time_s": UNIX_S}])
def test_a_server_that_states_nothing_but_changes_is_used(unknown):
    """A third of the taxels in every message: none of the scans is torn for it."""
    server = Server()
    scans = []
    for step in range(600):
        grown = (step + np.arange(16) % 3) // 3
        scans += server.say(10 * step / 3, REST_COUNTS.reshape(3, 16) + grown, **unknown)
    assert 195 <= len(scans) <= 201 and sum(scan.whole for scan in scans) >= 0.98 * len(scans)
    assert server.scans.trouble is None
    if "ups" in unknown:
        assert all(scan.vendor is not None and scan.vendor.ups_hz is None for scan in scans)
    late = [scan for step in range(200, 600) for scan in server.say(10 * step, cycle(900), **unknown)]
    assert [scan for scan in late if scan.time_ns > 3100 * MS] == [] and server.scans.trouble is not None


@pytest.mark.parametrize("dead", [{"ups": 0.0}, {"time_s": UNIX_S}, {"taxels": 15}], ids=str)
def test_a_dead_cable_gives_no_scan_and_is_told_of(dead):
    """However long the server goes on with the last reading."""
    server = Server()
    for step in range(20):
        assert server.say(10 * step, cycle(step))
    scans = [scan for step in range(20, 420) for scan in server.say(10 * step, cycle(19), **dead)]
    assert server.scans.trouble is not None and "nothing arrives from sensor 1: check its cable" in server.scans.trouble
    assert not any(scan.renewed.any() for scan in scans) and len(scans) <= 67  # a second long it may be a still pad
    assert [scan for scan in scans if scan.time_ns > 1400 * MS] == []
    server.scans.begin()  # opening it again brings no scan either
    assert server.say(5000, cycle(19), **dead) == [] and server.scans.trouble is not None
    server.say(5010, cycle(20))
    assert server.say(5020, cycle(21)) and server.scans.trouble is None


@pytest.mark.parametrize("set_by_s", [-3600.0, 3600.0])
def test_a_sensor_that_died_long_ago_stays_dead(set_by_s):
    """The age of its last reading would then be unreliable, or lie in the future."""
    server = Server()
    assert server.say(0, cycle(1))
    server.clock_s += set_by_s
    scans = [scan for step in range(1, 200) for scan in server.say(100 * step, cycle(1), time_s=UNIX_S)]
    assert [scan for scan in scans if scan.time_ns > 1400 * MS] == []
    assert server.scans.trouble is not None and "nothing arrives from sensor 1" in server.scans.trouble
    server.scans.begin()
    assert server.say(20_100, cycle(1), time_s=UNIX_S) == []


def test_a_slow_taxel_does_not_hold_up_the_others():
    server = Server()
    scans = []
    for step in range(100):
        counts = cycle(step, range(15))
        counts[:, 15] += step // 20
        scans += server.say(10 * step, counts, ups=[100.0] * 15 + [5.0])
    assert len(scans) == 100 and 5 <= sum(scan.complete for scan in scans) <= 10
    assert scans[0].vendor.temperature_k.shape == scans[0].vendor.ups_hz.shape == (4, 4)
    # A force is of all taxels, and of one that is old there is none.
    assert {scan.vendor_force_n for scan in scans if scan.complete} == {(2.0, 2.0, 2.0)}
    assert {scan.vendor_force_n for scan in scans if not scan.complete} == {None}


@pytest.mark.parametrize(
    ("numbers", "scans", "counted"),
    [
        ([5, 5, 6, 8, 8, 11], [1, 0, 1, 1, 0, 1], (2, 3, 0)),
        ([5000, 0, 1], [1, 1, 1], (0, 0, 1)),
        ([5000, None, 0], [1, 0, 1], (0, 0, 0)),
        ([1, 1 << 62, 2, 3], [1, 1, 1, 1], (0, 0, 2)),
        ([1, 1 + MOST_MISSED, 2 + 2 * MOST_MISSED], [1, 1, 1], (0, MOST_MISSED - 1, 1)),
    ],
)
def test_messages_are_taken_in_order_and_a_new_count_is_known(numbers, scans, counted):
    """By a new connection, a number out of a hat, or one below the last: a connection keeps the order."""
    server, got = Server(), []
    for step, number in enumerate(numbers):
        got.append(server.scans.begin() or [] if number is None else server.say(10 * step, cycle(step), number=number))
    assert [len(some) for some in got] == scans
    assert [scan.number for some in got for scan in some] == list(range(sum(scans))), "numbering goes on"
    assert server.counted("repeated_messages", "missed_messages", "server_restarts") == counted


def test_memory_is_bounded():
    scans, names = ServerScans(), range(3 * MOST_SENSORS)
    found = [scan for name in names for scan in scans.feed(message(name, **{str(name): sensor_entry()}), name * MS)]
    assert len({scan.sensor for scan in found}) == MOST_SENSORS


@pytest.mark.parametrize("age_ms", [6, 40, -5, 3_600_000])
def test_when_it_was_acquired_unless_that_cannot_be(age_ms):
    server = Server()
    (scan,) = [*server.say(0), *server.say(10, cycle(1), age_ms=age_ms)][1:]
    expected_ns = age_ms * MS if 0 < age_ms < 1000 else None
    assert (scan.device_ns and scan.time_ns - scan.device_ns) == (expected_ns and pytest.approx(expected_ns, abs=2000))
