"""Scans of an adapter that loses frames or bytes, or whose clock is bad: none holds two cycles, whatever is lost."""

import pytest
from wire_faults import FAULTS, READERS, STAMPS, Case, play

SLOW_OR_FAST = [name for name in STAMPS if "%" in name]
NO_CLOCK = [name for name in STAMPS if name not in ("good", *SLOW_OR_FAST)]


@pytest.mark.parametrize("reader", READERS)
@pytest.mark.parametrize("lost", FAULTS)
@pytest.mark.parametrize("stamps", [None, *STAMPS], ids=str)
def test_no_scan_is_of_two_cycles(stamps, lost, reader):
    found = play(Case(stamps, lost, reader), 400)
    assert found.mixed == 0 and found.scans == found.whole + found.torn
    assert found.whole > (350 if lost == "nothing" else 250)
    assert found.late <= 1 and found.lag_ms < 60
    if lost == "nothing" and reader != "each 16 ms" and stamps in (None, "good", *SLOW_OR_FAST):
        assert found.missed == 0 and found.torn == 0


@pytest.mark.parametrize("lost", FAULTS)
@pytest.mark.parametrize("stamps", [None, "good"], ids=str)
@pytest.mark.parametrize(("sensors", "rate_hz"), [(2, 100), (4, 100), (1, 10), (1, 400)])
def test_nor_is_one_of_several_sensors_or_of_another_rate(sensors, rate_hz, stamps, lost):
    found = play(Case(stamps, lost, "each ms", sensors, rate_hz), 600 // sensors)
    assert found.mixed == 0 and found.whole > 380
    assert lost != "nothing" or found.missed == found.torn == 0


@pytest.mark.parametrize("stamps", [*SLOW_OR_FAST, *NO_CLOCK])
def test_a_clock_is_followed_or_dropped(stamps):
    found = play(Case(stamps, "nothing"), 1500)
    assert found.late <= 1 and found.missed <= 20
    assert found.lag_ms < 5 or stamps not in SLOW_OR_FAST
