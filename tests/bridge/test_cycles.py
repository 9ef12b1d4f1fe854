"""Cycles of scans: none mixes two, whatever is lost, and a sensor's place is recovered; readings name their cycle."""

import math
import os
import random

import pytest
from wire_faults import FRAME_S, READERS, STAMPS, START_S, bus, doubling, losing, losing_cycles, read, swapping

CYCLES = int(os.environ.get("EDGE_WIRE_CYCLES", "400"))
ORDERS = {
    "downwards": list(range(15, -1, -1)),
    "rows backwards": [4 * (place // 4) + 3 - place % 4 for place in range(16)],
    "begun elsewhere": [*range(5, 16), *range(5)],
    "any": [9, 2, 14, 0, 7, 11, 4, 1, 15, 6, 3, 12, 8, 5, 13, 10],
}
PLAIN, STAMPED, PLAIN_BURSTS = (None, "each ms"), ("good", "each ms"), (None, "each 16 ms")
STAMPED_BURSTS, USB = ("good", "each 16 ms"), (None, "usb")


# Plain bursts of 16 ms end anywhere in a cycle, which looks like a pause of the bus until the period is known. Later,
# cycles that come late wait for others to show that none was lost. What holds for that reader as well is that nothing
# is mixed.
@pytest.mark.parametrize("how", [PLAIN, STAMPED, PLAIN_BURSTS, STAMPED_BURSTS, USB], ids=str)
@pytest.mark.parametrize(
    ("fault", "share", "rates_hz", "fewest", "in_bursts"),
    [
        (losing, 0.05, (100,), 170, 165),
        (losing, 0.002, (100, 103), 760, 730),  # phases that drift
        (doubling, 0.02, (100,), 399, 385),
        (swapping, 0.02, (100,), 370, 360),
    ],
)
def test_no_scan_is_of_two_cycles_on_a_faulty_bus(how, fault, share, rates_hz, fewest, in_bursts):
    found = read(fault(bus(400, rates_hz), share), *how)
    assert found.mixed == 0 and len(found.numbers) == len(rates_hz)
    assert found.whole > (in_bursts if how is PLAIN_BURSTS else fewest)
    assert found.wait_ns < 1_500_000 or how is PLAIN_BURSTS


@pytest.mark.parametrize("how", [PLAIN, STAMPED, STAMPED_BURSTS, USB], ids=str)
@pytest.mark.parametrize("group", [1, 2, 4, 8])
def test_a_sensor_that_sends_its_taxels_in_groups_is_read_whole(how, group):
    frames = [
        (START_S + number // 16 * 0.01 + place // group * 0.009 * group / 16 + place % group * FRAME_S, frame)
        for number, (_, frame) in enumerate(bus(30))
        for place in [number % 16]
    ]
    found = read(frames, *how)
    assert found.mixed == 0 and found.whole >= 29  # the pauses within it are learnt from the first cycle


@pytest.mark.parametrize("again", [False, True], ids=["opened", "opened again"])
@pytest.mark.parametrize("how", [STAMPED, STAMPED_BURSTS, USB], ids=str)
@pytest.mark.parametrize("lost", [0, 1, 3, 5])
def test_a_link_whose_first_cycles_are_lost_mixes_none_later(lost, how, again):
    before, frames = 16 * 20 * again, bus(40)
    del frames[before + 16 * 2 : before + 16 * (2 + lost)]
    del frames[before + 16 * 3 + 8 : before + 16 * 4 + 8]  # as many as make the halves of two cycles fit
    found = read(frames, *how, broken_s=START_S + 0.199 if again else math.inf)
    assert found.mixed == 0 and found.counters["torn_wire"] == 2
    assert found.whole >= 40 - lost - 2 - 2 * again


@pytest.mark.parametrize("how", [PLAIN, STAMPED, USB], ids=str)
@pytest.mark.parametrize(("order", "first_frame"), list(zip(ORDERS, (0, 7, 0, 7), strict=True)))
def test_another_order_is_learnt_and_nothing_mixed_meanwhile(how, order, first_frame):
    found = read(losing(bus(300, order=ORDERS[order])[first_frame:], 0.005), *how)
    # Without stamps a pause counts only once the period is measured: until then the order of the ids is all there is.
    assert found.mixed <= (2 if how is PLAIN and order == "begun elsewhere" else 0) and found.whole > 250
    assert found.numbers["4"][0] < 12 and found.numbers["4"][-1] == 299


SLOW_OR_FAST = [name for name in STAMPS if "%" in name]
NO_CLOCK = [name for name in STAMPS if name not in ("good", *SLOW_OR_FAST)]
OF_EACH_SORT = (None, "good", "jitter of 10 ms", "standing still", "1 % slow")
BY_DAY = [name if name in OF_EACH_SORT else pytest.param(name, marks=pytest.mark.night) for name in (None, *STAMPS)]
FAULTS = ("nothing", "frames", "bytes")


def play(stamps, lost, reader, cycles, rates_hz=(100.0,)):
    frames, sensors = bus(cycles, rates_hz), len(rates_hz)
    if lost == "frames":
        frames = losing_cycles(frames, sensors, random.Random(f"{stamps} {reader}"))
    return read(frames, stamps, reader, bytes_lost=sensors * (lost == "bytes"))


@pytest.mark.parametrize("reader", READERS[:3])
@pytest.mark.parametrize("lost", FAULTS)
@pytest.mark.parametrize("stamps", BY_DAY, ids=str)
def test_no_scan_of_a_faulty_wire_is_of_two_cycles(stamps, lost, reader):
    """EDGE_WIRE_CYCLES is their number: one whole scan of 2.7 million was mixed."""
    found = play(stamps, lost, reader, CYCLES)
    assert found.mixed <= CYCLES // 10_000
    assert found.whole > CYCLES * (0.85 if lost == "nothing" else 0.62)
    assert found.late <= CYCLES // 400 and found.lag_ms < 60
    if lost == "nothing" and reader != "each 16 ms" and stamps in (None, "good", *SLOW_OR_FAST):
        assert found.missed == 0 and found.torn == 0


@pytest.mark.parametrize("lost", FAULTS)
@pytest.mark.parametrize("stamps", [None, "good"], ids=str)
@pytest.mark.parametrize("rates_hz", [(100, 100), (100,) * 4, (10,), (400,)], ids=str)
def test_nor_is_one_of_several_sensors_or_of_another_rate(rates_hz, stamps, lost):
    found = play(stamps, lost, "each ms", 400 // len(rates_hz), rates_hz)
    assert found.mixed == 0 and found.whole > 250
    assert lost != "nothing" or found.missed == found.torn == 0


@pytest.mark.parametrize("stamps", [*SLOW_OR_FAST, *NO_CLOCK])
def test_a_clock_is_followed_or_dropped(stamps):
    found = play(stamps, "nothing", "each ms", 600)
    assert found.late <= 1 and found.missed <= 20
    assert found.lag_ms < 5 or stamps not in SLOW_OR_FAST
