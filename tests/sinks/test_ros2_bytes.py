"""Bytes of ROS messages, held against ROS's definitions and Cyclone DDS's own serializer."""

import pytest

pytest.importorskip("cyclonedds", reason="of the extra `ros2`")

import json
import math
import struct
from dataclasses import dataclass, replace

import numpy as np
import ros2_messages
from cyclonedds.idl import IdlStruct, types
from edge_samples import make_scan, make_wrench_result
from hypothesis import given
from hypothesis import strategies as st
from mcap_samples import make_results, odd_scans
from ros2_samples import sink

from edge.perception.event import Event
from edge.sinks.json_encoding import record
from edge.sinks.ros2 import cdr_messages, map_messages, ros_types
from edge.sinks.ros2.dds_domain import TYPE_HASHES, dds_type
from firmware_bridge.errors import CdrError
from firmware_bridge.recording.cdr import MessageType
from firmware_bridge.sensor_file.pad_frame import PadFrame

__all__ = ["sink"]
KINDS = [one for one in ros_types.TYPES.values() if one.name in TYPE_HASHES]


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.name)
def test_types_are_called_described_and_hashed_as_ros_does(kind):
    ours, theirs = dds_type(kind), ros2_messages.dds_type(kind.name)
    assert ours.__idl__.idl_transformed_typename == theirs.__idl__.idl_transformed_typename
    assert ours.__idl__.get_type_info() == theirs.__idl__.get_type_info(), "names and types of all fields"
    assert TYPE_HASHES[kind.name] == ros2_messages.type_hash(kind.name)


def test_every_type_is_ros_own():
    """Also those of recordings, which are not published."""
    assert TYPE_HASHES.keys() == {one.name for one in KINDS}
    for kind in ros_types.TYPES.values():
        assert [(field.name, field.kind) for field in kind.fields] == [
            (name, ros_kind.replace("/msg/", "/")) for name, ros_kind, _ in ros2_messages.fields(kind.name)
        ]


def test_messages_are_the_bytes_that_cyclonedds_makes_of_the_same_values(sink):
    """The types are made of ROS's definitions, so those of the sink have no part in them."""
    sent, result, frames = [], make_wrench_result(), {"a": PadFrame("tool0"), "b/c": PadFrame("base_link")}

    def keep(writer, message):
        package, _, kind = writer.data_type.__idl_typename__.split(".", 2)
        sent.append((f"{package}/msg/{kind.removeprefix('dds_.').removesuffix('_')}", message))

    sink._publish, sink._is_read = keep, lambda writer: True
    event = Event(3, "refused", "4", "not done, ä")
    sink.write(replace(result, deviation=result.pattern / 10, centroid_mm=(1.0, 2.0), events=(event,)), {"dropped": 1})
    sink.close()
    sent += [("tf2_msgs/msg/TFMessage", cdr_messages.transforms(frames, UNIX_NS))]
    assert {name for name, _ in sent} == TYPE_HASHES.keys(), "every type that is published"
    for name, message in sent:
        again = ros2_messages.dds_type(name).deserialize(message).serialize(use_version_2=False)
        assert again[: len(message)] == message and not any(again[len(message) :]), name
        assert len(again) - len(message) < 4


def test_a_taxel_that_gave_no_reading_is_not_a_number_of_counts():
    image = map_messages.image(map_messages.taxels(make_scan(absent=(6,))), "4", UNIX_NS)
    values = np.frombuffer(bytes(ros2_messages.decode("sensor_msgs/msg/Image", image)["data"]), "<f4")
    assert np.isnan(values.reshape(3, 16)[:, 6]).all() and np.isnan(values).sum() == 3


UNIX_NS = 1_700_000_000_123_456_789


def test_another_image_is_not_taken_for_a_map():
    said = ros_types.IMAGE.decode(map_messages.image(np.zeros((2, 2), np.float32), "4", 0))
    with pytest.raises(ValueError, match=r"encoding 'mono8', expected 32FC1"):
        map_messages.image_map(ros_types.IMAGE.encode({**said, "encoding": "mono8"}))


def test_a_result_says_its_numbers_apart_and_all_of_it_as_json():
    for result in make_results(odd_scans(4)):
        said = cdr_messages.RESULT.decode(cdr_messages.result_message(result, record(result, {"late": 1}), UNIX_NS))
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
