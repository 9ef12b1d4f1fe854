"""Bytes of ROS messages, held against CycloneDDS's own serializer, which knows nothing of ours."""

import json
import math
import struct
from dataclasses import dataclass

import numpy as np
import pytest
from cyclonedds.idl import IdlStruct, types
from hypothesis import given
from hypothesis import strategies as st
from mcap_samples import make_results, odd_scans

from edge.sinks.json_encoding import record
from edge.sinks.ros2 import cdr_messages as ros_messages
from edge.sinks.ros2 import map_messages, ros_types
from firmware_bridge.errors import CdrError
from firmware_bridge.recording.cdr import MessageType
from firmware_bridge.recording.scan_messages import SCAN, decode_scan, encode_scan
from firmware_bridge.scans.scan import VendorReading


@dataclass
class Time(IdlStruct, typename="builtin_interfaces::msg::dds_::Time_"):
    sec: types.int32
    nanosec: types.uint32


@dataclass
class Header(IdlStruct, typename="std_msgs::msg::dds_::Header_"):
    stamp: Time
    frame_id: str


@dataclass
class Scan(IdlStruct, typename="Scan"):
    header: Header
    sensor: str
    number: types.int64
    time_ns: types.int64
    device_time_ns: types.int64
    fresh: types.uint64
    renewed: types.uint64
    counts: types.array[types.int32, 48]
    vendor_newtons: types.sequence[types.float32]
    vendor_temperature_k: types.sequence[types.float32]
    vendor_ups_hz: types.sequence[types.float32]


UNIX_NS = 1_700_000_000_123_456_789
STAMP = Time(1_700_000_000, 123_456_789)


def test_an_image_of_columns_is_written_row_by_row():
    values = np.arange(12, dtype=np.float32).reshape(3, 4).T
    assert (map_messages.image_map(map_messages.image(values, "4", 0)) == values).all()


def test_another_image_is_not_taken_for_a_map():
    said = ros_types.IMAGE.decode(map_messages.image(np.zeros((2, 2), np.float32), "4", 0))
    with pytest.raises(ValueError, match=r"encoding 'mono8', expected 32FC1"):
        map_messages.image_map(ros_types.IMAGE.encode({**said, "encoding": "mono8"}))


@pytest.mark.parametrize("number", range(4))
def test_a_scan_is_what_cyclonedds_writes_and_comes_back_as_it_was(number):
    for scan in odd_scans(4)[2 * number : 2 * number + 2]:
        fresh, renewed = (sum(1 << i for i, one in enumerate(m.ravel()) if one) for m in (scan.fresh, scan.renewed))
        data = encode_scan(scan, scan.sensor, UNIX_NS, fresh, renewed)
        vendor = scan.vendor or VendorReading()
        lists = [[] if a is None else a.ravel().tolist() for a in (vendor.newtons, vendor.temperature_k, vendor.ups_hz)]
        device_ns = -1 if scan.device_ns is None else scan.device_ns
        expected = Scan(
            Header(STAMP, scan.sensor), scan.sensor, scan.number, scan.time_ns, device_ns, fresh, renewed,
            scan.counts.ravel().tolist(), *lists,
        )  # fmt: skip
        assert data == bytes(expected.serialize())
        got = decode_scan(data)
        assert (got.counts == scan.counts).all() and (got.fresh, got.renewed) == (fresh, renewed)


def test_a_result_says_its_numbers_apart_and_all_of_it_as_json():
    for result in make_results(odd_scans(4)):
        said = ros_messages.RESULT.decode(ros_messages.result_message(result, record(result, {"late": 1}), UNIX_NS))
        told = json.loads(said["record"])
        assert told["counts"][2][1][1] == (result.scan.counts[2, 1, 1] if result.scan.fresh[1, 1] else None)
        assert told["counters"] == {"late": 1} and said["header"]["frame_id"] == result.scan.sensor
        assert said["force_counts"] == result.force_counts or result.force_counts is None
        assert math.isnan(said["run_time_us"]) == (result.run_time_us is None)
        assert said["contact"] == {None: -1, False: 0, True: 1}[result.contact]


NUMBERS = st.lists(st.floats(width=32, allow_nan=False, allow_subnormal=False), max_size=3)
MIXED = MessageType("x/msg/Mixed", "string a\nint8 b\nfloat64[] c\nuint8 d\nfloat64 e\nint64[2] f\nstring g")


@dataclass
class Mixed(IdlStruct, typename="Mixed"):
    a: str
    b: types.int8
    c: types.sequence[types.float64]
    d: types.uint8
    e: types.float64
    f: types.array[types.int64, 2]
    g: str


TEXT = st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0"), max_size=9)


@given(TEXT, NUMBERS, TEXT)
def test_whatever_stands_before_a_number_it_lies_where_cyclonedds_puts_it(a, c, g):
    values = {"a": a, "b": -3, "c": c, "d": 7, "e": 0.1, "f": [1, -2], "g": g}
    data = MIXED.encode(values)
    assert data == bytes(Mixed(**values).serialize())
    got = MIXED.decode(data)
    assert (got["a"], got["g"], got["c"].tolist(), got["f"].tolist()) == (a, g, c, [1, -2])


def test_no_length_is_believed_that_the_bytes_do_not_bear_out():
    data = MIXED.encode({"a": "abc", "b": 0, "c": [1.0], "d": 0, "e": 0.0, "f": [0, 0], "g": "z"})
    for end in range(len(data)):
        with pytest.raises(CdrError):
            MIXED.decode(data[:end])
    for length in (0, 100, 0xFFFFFFFF):  # of a text: none of it, not even its end, and far too much
        with pytest.raises(CdrError, match=r"a has \d+ bytes"):
            MIXED.decode(data[:4] + struct.pack("<I", length) + data[8:])
    with pytest.raises(CdrError, match=r"begins with 00000000"):
        MIXED.decode(bytes(4) + data[4:])
    with pytest.raises(CdrError, match=r"utf-8"):
        MIXED.decode(data[:8] + b"\xff" + data[9:])


def test_a_definition_names_the_messages_in_it():
    text = SCAN.definition
    assert text.count("=" * 80) == 2
    assert text.index("MSG: std_msgs/Header\n") < text.index("MSG: builtin_interfaces/Time\nint32 sec\n")
    assert ros_types.WRENCH_STAMPED.definition.count("MSG: geometry_msgs/Vector3\n") == 1
    for wrong in ("float128 a", "int8 A", "std_msgs/Other a", "string[] a"):
        with pytest.raises(ValueError, match=r"kind|not a field"):
            MessageType("x/msg/X", wrong)
    with pytest.raises(ValueError, match=r"f has 3 numbers, expected 2"):
        MIXED.encode({"a": "", "b": 0, "c": [], "d": 0, "e": 0, "f": [1, 2, 3], "g": ""})
