"""Places of taxels: by the ids of each layout, and by the mounting where a sensor differs from them."""

from dataclasses import replace

import numpy as np
import pytest
from edge_samples import make_scan
from hypothesis import given, settings
from hypothesis import strategies as st
from xela_server_emulator import message, sensor_entry

from firmware_bridge.can.slcan import CanFrame
from firmware_bridge.errors import SourceError
from firmware_bridge.links.registry import open_sources
from firmware_bridge.recording.csv_reader import csv_header
from firmware_bridge.scans.can_id_maps import LAYOUT_A_MAP, LAYOUT_B_MAP, USPA44_MAP, XR1944_MAP
from firmware_bridge.scans.mounting import AS_MAPPED, Mounting, placed_map
from firmware_bridge.scans.scan import VendorReading
from firmware_bridge.scans.scan_assembler import ScanAssembler
from firmware_bridge.scans.xela_server_scans import ServerScans

BACKWARDS = [3, 2, 1, 0]


@pytest.mark.parametrize(
    ("can_id", "data", "place", "counts"),
    [  # the first two as a sensor sent them, with what its maker's server read in them
        (0x004, bytes.fromhex("937E317E1593120F"), (0, 3), [32305, 32277, 37650]),
        (0x104, bytes.fromhex("938406805591BB0C"), (1, 3), [33798, 32853, 37307]),
        (0x33F, b"\1" + bytes.fromhex("0000 8000 FFFF") + b"\1", (3, 0), [0, 32768, 65535]),
    ],
)
def test_golden_frames(can_id, data, place, counts):
    assembler, sensor = ScanAssembler(USPA44_MAP), str(can_id & 0xF)
    frames = [CanFrame(one, data if one == can_id else bytes(8)) for one, _ in USPA44_MAP.wire_order(sensor)]
    (scan,) = [scan for frame in frames for scan in assembler.feed_frame(frame, 0)]
    assert scan.sensor == sensor and scan.counts[:, *place].tolist() == counts


@pytest.mark.parametrize(
    ("model", "sensor", "ids"),
    [
        (USPA44_MAP, "4", [row << 8 | col << 4 | 4 for row in range(4) for col in BACKWARDS]),
        (XR1944_MAP, "4", [row // 2 << 8 | row % 2 << 6 | col << 4 | 4 for row in range(4) for col in BACKWARDS]),
        (LAYOUT_A_MAP, "7", range(0x770, 0x780)),
        (LAYOUT_B_MAP, "1a", range(0x100, 0x110)),
        (LAYOUT_B_MAP, "3b", range(0x310, 0x320)),
    ],
)
def test_the_ids_of_each_layout(model, sensor, ids):
    assert [model.taxels[can_id] for can_id in ids] == [(sensor, taxel) for taxel in range(16)]
    assert model.triggered == (model in (LAYOUT_A_MAP, LAYOUT_B_MAP))


mountings = st.builds(
    Mounting,
    order=st.permutations(AS_MAPPED).map(tuple),
    swap_xy=st.booleans(),
    signs=st.tuples(*[st.sampled_from((1, -1))] * 3),
)
TURNED = Mounting(order=tuple(np.rot90(np.arange(16).reshape(4, 4)).ravel().tolist()))


def seen(mounting, wire):
    """Deformation as the pad has it of one as the wire has it, both (3, 4, 4)."""
    placed = wire.reshape(3, 16)[:, list(mounting.order)].reshape(3, 4, 4)
    return mounting.correct(placed)


@settings(max_examples=50, deadline=None)
@given(mountings, mountings, st.integers(0, 99))
def test_one_mounting_after_another_is_one(known, found, seed):
    wire = np.random.default_rng(seed).normal(0, 500, (3, 4, 4)).astype(np.float32)
    assert np.allclose(seen(known.then(found), wire), seen(found, seen(known, wire)))


@settings(max_examples=20, deadline=None)
@given(mountings)
def test_a_map_in_place_and_a_scan_put_in_place_agree(mounting):
    scan = make_scan(3, absent=(5,), stale=(7,), noise=9)
    moved = placed_map(USPA44_MAP, {"4": mounting})
    put = mounting.place(scan)
    for can_id, taxel in USPA44_MAP.wire_order("4"):
        place = moved.taxels[can_id][1]
        assert put.counts[:, place // 4, place % 4].tolist() == scan.counts[:, taxel // 4, taxel % 4].tolist()
        assert put.fresh.flat[place] == scan.fresh.flat[taxel]
        assert put.renewed.flat[place] == scan.renewed.flat[taxel]
    others = {can_id: place for can_id, place in USPA44_MAP.taxels.items() if place[0] != "4"}
    assert {can_id: moved.taxels[can_id] for can_id in others} == others
    assert not put.counts.flags.writeable and put.time_ns == scan.time_ns


@settings(max_examples=20, deadline=None)
@given(mountings)
def test_the_vendors_readings_lie_and_point_as_the_pad_does(mounting):
    newtons = np.random.default_rng(1).normal(0, 1, 48).tolist()
    entry = sensor_entry(calibrated=newtons, temp=[300.0 + n for n in range(16)], ups=[80.0 + n for n in range(16)])
    text = message(1, entry, sensor_entry())
    (wire, other), (put, alike) = (ServerScans(mountings=known).feed(text, 0) for known in ({}, {"1": mounting}))
    assert (put.counts.reshape(3, 16) == wire.counts.reshape(3, 16)[:, list(mounting.order)]).all()
    assert np.array_equal(put.vendor.newtons, seen(mounting, wire.vendor.newtons))
    force_n = np.array(wire.vendor_force_n)[[1, 0, 2] if mounting.swap_xy else [0, 1, 2]] * mounting.signs
    assert put.vendor_force_n == pytest.approx(force_n, abs=1e-5) and alike.vendor_force_n == other.vendor_force_n
    for name in ("temperature_k", "ups_hz"):
        told, was = getattr(put.vendor, name), getattr(wire.vendor, name)
        assert np.array_equal(told.ravel(), was.ravel()[list(mounting.order)])
    for vendor in (VendorReading(), None):
        assert mounting.place(replace(wire, vendor=vendor)).vendor == vendor


def test_what_a_mounting_moves_and_what_costs_nothing():
    """The wire's top right taxel, 3, lies top left: its id, 0x004, now means place 0."""
    assert placed_map(USPA44_MAP, {"4": Mounting(swap_xy=True)}) is USPA44_MAP
    assert not Mounting().turns_axes and not Mounting().moves_taxels
    assert Mounting(signs=(1, 1, -1)).turns_axes and TURNED.moves_taxels and not TURNED.turns_axes
    assert TURNED.order[0] == 3 and placed_map(USPA44_MAP, {"4": TURNED}).taxels[0x004] == ("4", 0)


def test_a_mounting_that_cannot_be_is_refused(tmp_path):
    for order in ((0,) * 16, tuple(range(15))):
        with pytest.raises(ValueError, match=r"each of 0\.\.15 once"):
            Mounting(order)
    with pytest.raises(ValueError, match="three of 1 and -1"):
        Mounting(signs=(1, 0, 1))
    # A CSV is of another pad.
    (tmp_path / "4.csv").write_text("\n".join([",".join(csv_header(24)), ",".join(["1000"] * 3 * 24), ""]))
    with pytest.raises(SourceError, match=r"4\.csv has 24 taxels, .* sensor 4 has 16: leave out"):
        open_sources([f"replay:{tmp_path}/4.csv"], 100.0, mountings={"4": Mounting()})
