"""Where to touch next: half a pitch from the taps so far, and each proposal is made once."""

import json
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from edge_samples import BASELINE, PERIOD_NS, make_scan
from mcap_samples import arrays_of
from pose_samples import PosedModel, make_posed_contract

from edge.perception.contact_options import RuntimeOptions
from edge.perception.result import NextTap
from edge.perception.runtime import Runtime
from edge.perception.tap_tracker import TapPeak, TapState
from edge.perception.taps import TapAdvice, next_shift_mm
from edge.sinks.json_encoding import record
from edge.sinks.registry import open_sink
from firmware_bridge.pad_geometry import USPA44
from firmware_bridge.poses.pad_pose import PadPose

HALF_MM = USPA44.pitch_mm / 2


REACH_MM = 6.0


def taps(*places):
    return np.array([(x * HALF_MM, y * HALF_MM, 0.0, 0.2, 1.0) for x, y in places])


def test_four_taps_make_a_square_of_half_a_pitch_and_none_is_touched_twice():
    places = np.zeros((1, 2))
    for _ in range(6):
        shift_mm = next_shift_mm(places[::-1] - places[-1], REACH_MM)
        assert shift_mm is not None
        places = np.vstack([places, places[-1] + shift_mm])
    halves = [tuple(row) for row in np.rint(places / HALF_MM).astype(int).tolist()]
    assert len(set(halves)) == 7
    assert {(x % 2, y % 2) for x, y in halves[:4]} == {(0, 0), (0, 1), (1, 0), (1, 1)}
    apart_mm = np.hypot(*(places[:, None] - places).transpose(2, 0, 1))
    assert apart_mm.max() <= REACH_MM


def test_an_earlier_tap_off_the_grid_still_has_its_place():
    shift_mm = next_shift_mm(np.array([[0.0, 0.0], [HALF_MM + 0.3, -0.2]]), REACH_MM)
    assert shift_mm is not None and shift_mm != (HALF_MM, 0.0)


def test_no_tap_is_proposed_from_which_an_earlier_one_is_out_of_reach():
    shift_mm = next_shift_mm(taps((0, 0), (-1, 0))[:, :2], 3.4)
    assert shift_mm is not None and np.hypot(shift_mm[0] + HALF_MM, shift_mm[1]) <= 3.4
    assert next_shift_mm(np.zeros((1, 2)), 2.0) is None


POSE = PadPose(10, 20, 90)


def made(force_counts: float | None = 100.0, pose: PadPose | None = POSE, **changes) -> Any:
    estimate = SimpleNamespace(**{"poses": taps((0, 0)), "trusted": True, "taps_used": 1} | changes)
    return SimpleNamespace(force_counts=force_counts, pose=pose, estimate=estimate)


PEAKS = (TapPeak(0, 0),)
TOUCHING, FREE, FORGOTTEN = (
    TapState(contact, 0, int(contact), np.zeros(0, dtype=np.float32), peaks)
    for contact, peaks in ((True, ()), (False, PEAKS), (False, ()))
)


def after(advice):
    return advice.proposal(FREE)


def proposed_after(advice) -> NextTap:
    proposed = after(advice)
    assert proposed is not None
    return proposed


def test_a_proposal_is_made_when_a_tap_ends_and_kept_until_the_next_one():
    advice = TapAdvice(REACH_MM, taps=7)
    assert after(advice) is None
    advice.see(made(), 0)
    assert advice.proposal(TOUCHING) is None
    proposed = after(advice)
    assert proposed is not None and after(advice) is proposed
    assert advice.proposal(TOUCHING) is None
    assert after(advice) is None, "a tap without a pattern proposes nothing"
    advice.see(made(), 0)
    assert after(advice) is not None
    assert advice.proposal(FORGOTTEN) is None
    assert after(advice) is None, "forgotten taps are no reason to touch again"


def test_the_strongest_pattern_of_a_tap_is_the_one_that_counts():
    advice = TapAdvice(REACH_MM, taps=7)
    for force_counts, x_mm in ((50.0, 1.0), (200.0, 2.0), (80.0, 3.0)):
        advice.see(made(force_counts, pose=PadPose(x_mm, 0)), 0)
    proposed = proposed_after(advice)
    assert proposed.target is not None and proposed.target.x_mm - proposed.dx_mm == pytest.approx(2)
    advice.proposal(TOUCHING)
    advice.see(made(60.0, pose=PadPose(5, 0)), 0)
    proposed = proposed_after(advice)
    assert proposed.target is not None and proposed.target.x_mm - proposed.dx_mm == pytest.approx(5)


def test_the_target_is_the_proposal_in_the_objects_plane():
    advice = TapAdvice(REACH_MM, taps=7)
    advice.see(made(), 0)
    proposed = proposed_after(advice)
    target = proposed.target
    assert target is not None
    seen = target.seen_from(PadPose(10, 20, 90))
    assert (seen.x_mm, seen.y_mm, seen.turn_deg) == pytest.approx((proposed.dx_mm, proposed.dy_mm, 0), abs=1e-9)
    assert (target.x_mm, target.y_mm) == pytest.approx((10 - proposed.dy_mm, 20 + proposed.dx_mm))


@pytest.mark.parametrize("changes", [{"pose": None}, {"poses": None}, {"trusted": False}, {"taps_used": 7}])
def test_nothing_is_proposed_without_what_it_needs(changes):
    advice = TapAdvice(REACH_MM, taps=7)
    advice.see(made(**changes), 0)
    assert after(advice) is None


class TestRuntime:
    PRESS = 3000

    def make(self):
        contract = make_posed_contract(interval_factor=1.6)
        self.number = 0
        self.runtime = Runtime(
            PosedModel(contract),
            source="emulated",
            baselines={"4": BASELINE},
            options=RuntimeOptions(idle_reset_s=0.2),
        )

    def push(self, press=0.0):
        result = self.runtime.push(make_scan(self.number, press_counts=press))
        self.number += 1
        return result

    def tap(self, pose=None):
        """Press and release at a pose; return the results in contact, and the first one after it."""
        if pose is not None:
            self.runtime.pose(pose, (self.number + 1) * PERIOD_NS - 1000, holds=True)
        pressed = [self.push(self.PRESS / 2), self.push(self.PRESS), self.push(self.PRESS / 2)]
        return pressed, self.push()

    def test_a_robot_that_follows_the_proposals_touches_no_place_twice(self, tmp_path):
        self.make()
        pose, places = PadPose(5, -3, 30), set()
        for _ in range(4):
            pressed, released = self.tap(pose)
            assert all(result.next_tap is None for result in pressed)
            proposed = released.next_tap
            assert proposed is not None and proposed.target is not None
            seen = pose.seen_from(PadPose(5, -3, 30))
            places.add((round(seen.x_mm / HALF_MM, 6), round(seen.y_mm / HALF_MM, 6)))
            pose = proposed.target
        assert len(places) == 4 and all(x == round(x) and y == round(y) for x, y in places)

    def test_it_stays_until_the_next_tap_or_until_the_taps_are_forgotten(self, tmp_path):
        self.make()
        _, released = self.tap(PadPose(0, 0))
        assert self.push().next_tap is released.next_tap is not None
        assert self.push(self.PRESS).next_tap is None
        self.tap(PadPose(1, 0))
        assert self.push().next_tap is not None
        later = [self.push() for _ in range(30)]
        assert later[-1].next_tap is None

    def test_a_reset_within_a_tap_leaves_nothing_of_the_object_before(self, tmp_path):
        self.make()
        self.tap(PadPose(0, 0))
        self.runtime.pose(PadPose(1, 0), (self.number + 1) * PERIOD_NS - 1000, holds=True)
        self.push(self.PRESS)
        self.runtime.reset()
        self.runtime.pose(PadPose(3, 0), (self.number + 1) * PERIOD_NS - 1000, holds=True)
        later = [self.push(press) for press in (0.8 * self.PRESS, 0.7 * self.PRESS)]
        proposed, alone = self.push().next_tap, TapAdvice(REACH_MM, 7)
        first = later[0]
        alone.see(made(first.force_counts, first.pose, poses=first.poses, trusted=first.trusted), 0)
        expected = alone.proposal(FREE)
        assert later[0].taps_used == 1 and proposed is not None and expected is not None
        assert proposed.target == expected.target

    def test_without_poses_nothing_is_proposed(self, tmp_path):
        self.make()
        assert self.tap()[1].next_tap is None

    def test_every_output_holds_it(self, tmp_path):
        self.make()
        pressed, released = self.tap(PadPose(5, -3, 90))
        proposed = released.next_tap
        assert proposed is not None
        in_record = record(released, {})["next_tap"]
        assert in_record["dx_mm"] == pytest.approx(proposed.dx_mm) and in_record["turn_deg"] == 0
        assert in_record["target"]["x_mm"] == pytest.approx(5 - proposed.dy_mm, abs=1e-3)
        assert record(pressed[1], {})["next_tap"] is None
        contract = self.runtime._model.contract
        sink = open_sink(f"mcap:{tmp_path / 'out.mcap'}", contract=contract)
        for result in (pressed[1], released):
            sink.write(result, {})
        sink.close()
        held = arrays_of(tmp_path / "out.mcap")["next_tap"]
        assert np.isnan(held[0]).all()
        assert held[1] == pytest.approx(proposed[:3], abs=1e-3)
        sink = open_sink(f"jsonl:{tmp_path / 'out.jsonl'}", contract=contract)
        sink.write(released, {})
        sink.close()
        assert json.loads((tmp_path / "out.jsonl").read_text())["next_tap"] == in_record
