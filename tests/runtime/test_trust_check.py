"""Verdicts on patterns: what is not believed and why, what contacts show of their sensor, and both in the runtime."""

import itertools

import numpy as np
import pytest
from edge_samples import FakeModel, make_contract, make_pad_contract
from runtime_samples import PRESS, Pushed, make_runtime
from trust_samples import FOREIGN_TAXEL, make_trust, make_trusted_contract

from edge.api import Pad
from edge.inference.contract import scheduled_rows
from edge.perception.run_options import RuntimeOptions
from edge.perception.taxel_health import REPEATS
from edge.perception.trust_check import (
    LEAST_COUNTS,
    MOST_MISMATCH,
    PatternCheck,
    SensorPad,
    TrustVerdict,
)
from firmware_bridge.pad_geometry import CHANNELS

CONTRACT = make_trusted_contract()
PAD_ROW = CONTRACT.pad_row(None)


def make_check(contract=CONTRACT, pad=None) -> PatternCheck:
    trust = make_trust()
    return PatternCheck(trust, contract, SensorPad(contract, trust, pad, None))


def make_tap(z=2.0, x=0.0):
    """Return a tap in network units; from x of half of z's amplitude it is unfamiliar."""
    tap = np.zeros((3, 4, 4), dtype=np.float32)
    tap[2] = z
    tap[0, 0, 0] = x * z
    return tap


def judge(check, tap, number=0, repeats=0, factor=1.0, doubt=0.1) -> TrustVerdict:
    """Return the verdict on the pattern that the fake model makes of a tap, times a factor."""
    model = FakeModel(CONTRACT)
    window = np.zeros((4, *tap.shape), dtype=np.float32)
    window[0] = tap
    pattern = np.float32(factor) * model.run(window, PAD_ROW)
    return check.judge(number, tap, pattern, doubt, model.traction, repeats)


LEAST = LEAST_COUNTS / CONTRACT.counts_per_unit[2]


class TestReasons:
    @pytest.mark.parametrize(
        ("tap", "how", "trusted", "reason"),
        [
            (make_tap(), {}, True, None),
            (make_tap(0.99 * LEAST, x=3), {"factor": 5}, None, None),  # too light to be checked
            (make_tap(1.01 * LEAST, x=3), {}, False, "unfamiliar"),
            (make_tap(), {"repeats": REPEATS - 1}, True, None),
            (make_tap(), {"repeats": REPEATS}, False, "stuck"),
            (make_tap(0.01), {"repeats": REPEATS}, False, "stuck"),  # in a light contact, too
            *((make_tap(z, x=0.4), {}, True, None) for z in (0.5, 2.0, 3.5)),
            *((make_tap(z, x=0.6), {}, False, "unfamiliar") for z in (0.5, 2.0, 3.5)),  # whatever the force
            (make_tap(), {"factor": 2}, False, "unexplained"),
            # The lighter it is, the sooner it is told that the model is not sure.
            *((make_tap(z), {"doubt": limit - 0.01}, True, None) for z, limit in ((0.2, 0.519), (3.0, 0.681))),
            *((make_tap(z), {"doubt": limit + 0.01}, False, "uncertain") for z, limit in ((0.2, 0.519), (3.0, 0.681))),
        ],
    )
    def test_a_pattern_is_believed_or_not_for_a_reason(self, tap, how, trusted, reason):
        verdict = judge(make_check(), tap, **how)
        assert (verdict.trusted, verdict.reason) == (trusted, reason) and REPEATS == 5
        if trusted:
            assert verdict.mismatch == pytest.approx(0, abs=1e-6)
        if reason == "unexplained":
            assert verdict.mismatch is not None and verdict.mismatch > MOST_MISMATCH

    def test_a_checkerboard_is_of_no_contact(self):
        tap = make_tap()
        tap[2] = np.where(np.indices((4, 4)).sum(axis=0) % 2, 2, 1)
        assert judge(make_check(), tap).reason == "unfamiliar"
        without_traction = make_check().judge(0, tap, np.ones((40, 40), dtype=np.float32), None, None, 0)
        assert (without_traction.mismatch, without_traction.reason) == (None, "unfamiliar")
        for place in (np.s_[1], np.s_[1, 2], np.s_[::2]):
            tap[2] = 1
            tap[2][place] = 2
            assert judge(make_check(), tap).trusted is True

    @pytest.mark.parametrize(
        ("z", "taxels", "full_scale"),
        [((6.27, 6.6), 1, (10, 10)), ((3.5, 3.7), 16, (10, 10)), ((2, 2), 16, (1.9, 1.8))],
    )
    def test_a_press_stronger_or_deeper_than_in_training_is_told(self, z, taxels, full_scale):
        for strength, most_mm, reason in zip(z, full_scale, (None, "beyond"), strict=True):
            tap = make_tap(0)
            tap[2].flat[:taxels] = strength
            assert judge(make_check(make_trusted_contract(output_full_scale=most_mm)), tap).reason == reason

    def test_what_is_not_finite_is_never_believed(self):
        tap, pattern, traction = make_tap(), np.ones((40, 40), dtype=np.float32), np.zeros((3, 8, 8), dtype=np.float32)
        about = np.array([0.1])
        for place, bad in itertools.product((tap, pattern, about, traction), (np.nan, np.inf, -np.inf)):
            kept = place.flat[-1]
            place.flat[-1] = bad
            with np.errstate(all="ignore"):
                verdict = make_check().judge(0, tap, pattern, float(about[0]), traction, 0)
            assert verdict.trusted is not True and (place is not tap or verdict.reason == "unfamiliar")
            place.flat[-1] = kept

    def test_gains_that_are_certain_leave_less_unexplained(self):
        tap = make_tap()
        tap[2, 1, 1] *= 1.2
        exact = Pad(gains=(1.0,) * CHANNELS, gain_half_widths=(0.0,) * CHANNELS)
        certain, unsure = make_check(pad=exact), make_check()
        pattern = np.kron(make_tap()[2], np.ones((10, 10), dtype=np.float32))
        traction = np.zeros((3, 8, 8), dtype=np.float32)
        more, less = (check.judge(0, tap, pattern, None, traction, 0).mismatch for check in (certain, unsure))
        assert more is not None and less is not None and more > less


ODD, GOOD = make_tap(x=2), make_tap()


def suspected_after(taps, check=None, first=0):
    """Return whether the sensor is suspected after each contact, of one scan or of several."""
    check, told = check or make_check(), []
    for number, tap in enumerate(taps, first):
        for scan in tap if isinstance(tap, tuple) else (tap,):
            judge(check, scan, number)
        told.append(check.suspected)
    return told


class TestSensor:
    @pytest.mark.parametrize(
        ("taps", "suspected"),
        [
            ([(make_tap(x=5),) * 500, GOOD], False),  # one odd contact, however long it goes on
            ([ODD if number % 5 == 0 else GOOD for number in range(200)], False),  # odd contacts far between
            ([make_tap(0.05, x=5)] * 50, False),  # light touches
            # A contact counts by its strongest scan.
            ([(make_tap(1, x=2), make_tap(3))] * 8, False),
            ([(make_tap(3), make_tap(1, x=2))] * 8, False),
            ([(make_tap(3, x=2), make_tap(1))] * 8, True),
            ([make_tap(x=np.nan)] * 3 + [ODD] * 6, True),  # what is not finite leaves the evidence as it was
        ],
    )
    def test_it_takes_several_odd_contacts_in_a_row(self, taps, suspected):
        assert any(suspected_after(taps)) == suspected

    def test_an_hour_of_contacts_hides_no_more_than_a_minute(self):
        def contacts_until(suspected, before, count):
            check = make_check()
            suspected_after([before] * count, check)
            after = suspected_after([ODD if suspected else GOOD] * 60, check, first=count)
            return after.index(suspected)

        assert contacts_until(False, ODD, 1000) == contacts_until(False, ODD, 20) >= 8, "no flicker about one level"
        assert contacts_until(True, GOOD, 1000) == contacts_until(True, GOOD, 1)


class TestBelonging:
    def test_an_earlier_tap_that_was_elsewhere_does_not_belong(self):
        window = np.zeros((4, 3, 4, 4), dtype=np.float32)
        window[:, 2].reshape(4, -1)[:, FOREIGN_TAXEL] = 3, 3, 0, 3
        window[2, 2, 3, 3] = 3
        check, poses = make_check(), scheduled_rows(4, 5.0)
        shares = check.belonging(window, 4, poses)
        assert [share >= 0.5 for share in shares] == [False, True, False] and all(0 <= one <= 1 for one in shares)
        assert len(check.belonging(window, 3, poses)) == 2 and check.belonging(window, 1, poses) == []
        assert check.belonging(window, 4) == [], "a model that takes no poses has no such check"
        window[1, 0, 0, 0] = np.nan
        assert check.belonging(window, 4, poses)[0] >= 0.5


EVERY = RuntimeOptions(every_scan=True, follow_drift=False)
ELSEWHERE = 10


def make_pad(model=None, options=EVERY, **settings):
    posed = {"takes_poses": True, "reach_mm": 10.0, "unposed_taps": 4}
    model = model or FakeModel(make_trusted_contract(**posed))
    return Pushed(make_runtime(model, options=options, **settings), taxel=FOREIGN_TAXEL, noise=3)


class TestTaps:
    def test_a_foreign_tap_is_dropped_with_those_before_it(self):
        pad = make_pad()
        pad.tap()
        pad.tap(taxel=ELSEWHERE)
        first = pad.push(PRESS)
        assert first.taps_used == 1 and first.tap_mismatch[0] >= 0.5 and len(first.window) == 1
        pad.push(PRESS)
        pad.push()
        (event,) = pad.events
        assert event.kind == "tap_dropped" and "the tap before does not belong" in event.detail
        assert pad.tap().taps_used == 2  # the tap that has dropped the others is the first of the new contact


class TestVerdict:
    @pytest.mark.parametrize(("pad", "outside"), [(None, True), (Pad(thickness_mm=4.5), False), (Pad(), True)])
    def test_a_model_for_one_sensor_is_not_believed_on_another(self, pad, outside):
        """Nor where no sensor file tells whose readings these are."""
        model = FakeModel(make_trusted_contract(made_for={"thickness_mm": [4.4, 4.6]}))
        result = make_pad(model, pad=pad).push(PRESS)
        assert (result.untrusted_reason == "pad") is outside

    def test_an_odd_sensor_is_suspected_and_cleared_with_events(self):
        pad = make_pad()

        def touch(x):
            scan = pad.scan(PRESS)
            scan.counts[0, 0, 0] += x
            pad.results.append(pad.runtime.push(scan))
            pad.push()
            return pad.results[-2]

        assert {touch(3000).untrusted_reason for _ in range(8)} == {"unfamiliar"} and pad.kinds == ["suspected"]
        assert touch(0).untrusted_reason == "sensor"
        assert [touch(0).trusted for _ in range(60)][-1] is True and pad.kinds == ["suspected", "cleared"]


def test_a_model_without_checks_says_that_it_does_not_know():
    for contract in (make_contract(), make_pad_contract()):
        pad = make_pad(FakeModel(contract))
        first, second = (pad.tap(taxel=taxel) for taxel in (FOREIGN_TAXEL, ELSEWHERE))
        assert first.pattern is not None and second.taps_used == 2
        for result in (first, second):
            assert result.trusted is result.untrusted_reason is result.mismatch is result.tap_mismatch is None
