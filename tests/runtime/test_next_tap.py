"""Where to touch next: half a pitch from the taps so far, and each proposal is made once."""

import numpy as np
import pytest
from edge_samples import REST
from pose_samples import PosedModel, make_posed_contract
from runtime_samples import PRESS, Pushed, make_runtime
from trust_samples import make_checked_contract, make_posed_trust

from edge.api import USPA44, PadPose
from edge.perception.contact_options import RuntimeOptions
from edge.perception.taps import next_shift_mm

HALF_MM = USPA44.pitch_mm / 2
REACH_MM = 6.0


def test_an_earlier_tap_is_not_touched_again_and_in_reach():
    assert next_shift_mm(np.array([[0.0, 0.0], [HALF_MM + 0.3, -0.2]]), REACH_MM) not in (None, (HALF_MM, 0.0))
    shift_mm = next_shift_mm(np.array([[0.0, 0.0], [-HALF_MM, 0.0]]), 3.4)
    assert shift_mm is not None and np.hypot(shift_mm[0] + HALF_MM, shift_mm[1]) <= 3.4
    assert next_shift_mm(np.zeros((1, 2)), 2.0) is None


def make_pad(contract=None, **options):
    model = PosedModel(contract or make_posed_contract(interval_factor=1.6))
    return Pushed(make_runtime(model, options=RuntimeOptions(idle_reset_s=0.2, **options)))


def test_a_robot_that_follows_touches_no_place_twice():
    pad, places = make_pad(), set()
    pose = begun = PadPose(5, -3, 30)
    for _ in range(4):
        assert pad.tap(pose).next_tap is None
        proposed = pad.results[-1].next_tap
        seen = pose.seen_from(begun)
        places.add((round(seen.x_mm / HALF_MM, 6), round(seen.y_mm / HALF_MM, 6)))
        seen = proposed.target.seen_from(pose)
        assert (seen.x_mm, seen.y_mm, seen.turn_deg) == pytest.approx((proposed.dx_mm, proposed.dy_mm, 0), abs=1e-9)
        pose = proposed.target
    assert len(places) == 4 and all(x == round(x) and y == round(y) for x, y in places)


def test_it_stays_until_the_next_tap_or_an_idle_time():
    pad = make_pad()
    pad.tap(PadPose(0, 0))
    proposed = pad.results[-1].next_tap
    assert pad.push().next_tap is proposed is not None
    assert pad.push(PRESS).next_tap is None
    pad.tap(PadPose(1, 0))
    assert pad.push().next_tap is not None
    assert [pad.push().next_tap for _ in range(30)][-1] is None


def test_it_is_from_the_strongest_scan_since_a_reset():
    pad = make_pad()
    for press, x_mm in ((0.6 * PRESS, 1), (PRESS, 2), (0.8 * PRESS, 3)):
        pad.place(PadPose(x_mm, 0))
        pad.push(press)
    proposed = pad.push().next_tap
    assert proposed.target.x_mm - proposed.dx_mm == pytest.approx(2)
    pad.push(PRESS)
    pad.runtime.reset()
    pad.place(PadPose(5, 0))
    assert [pad.push(share * PRESS).taps_used for share in (0.8, 0.7)] == [1, 1]
    proposed = pad.push().next_tap
    assert proposed is not None and proposed.target.x_mm - proposed.dx_mm == pytest.approx(5)


@pytest.mark.parametrize("lacking", ["a pose", "trust", "a further tap"])
def test_nothing_is_proposed_without_what_it_needs(lacking):
    checked = make_checked_contract(make_posed_trust(2.5))
    pad = make_pad(checked if lacking == "trust" else None, taps=1 if lacking == "a further tap" else None)
    if lacking != "a pose":
        pad.place(PadPose(0, 0))
    pressed = REST.copy()
    pressed[2, 1, 1] += PRESS
    pressed[0, 0, 0] += PRESS  # which is unfamiliar to the checks
    for counts in (pressed, pressed, REST):
        scan = pad.scan()
        scan.counts[...] = counts
        result = pad.runtime.push(scan)
    assert result.state == "idle" and result.next_tap is None
