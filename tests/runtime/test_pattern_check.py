"""Verdicts on patterns: what is not believed and why, and what contacts show of their sensor."""

import numpy as np
import pytest
from edge_samples import FakeModel
from trust_samples import FOREIGN_TAXEL, make_trust, make_trusted_contract

from edge.perception.pattern_check import LEAST_COUNTS, MOST_MISMATCH, REPEATS, PatternCheck, Verdict, strangers

CONTRACT = make_trusted_contract()
PAD_ROW = CONTRACT.pad_row(None)
_CONTACTS = 60


def make_check(contract=CONTRACT) -> PatternCheck:
    return PatternCheck(make_trust(), contract)


def make_tap(z=2.0, x=0.0):
    """Return a tap in network units; from x of half of z's amplitude it is unfamiliar."""
    tap = np.zeros((3, 4, 4), dtype=np.float32)
    tap[2] = z
    tap[0, 0, 0] = x * z
    return tap


def judge(check, tap, number=0, repeats=0, factor=1.0, doubt=0.1) -> Verdict:
    """Return the verdict on the pattern that the fake model makes of a tap, times a factor."""
    model = FakeModel(CONTRACT)
    window = np.zeros((4, *tap.shape), dtype=np.float32)
    window[0] = tap
    pattern = np.float32(factor) * model.run(window, PAD_ROW)
    deviation = np.full_like(pattern, doubt * np.sqrt(np.mean(pattern**2)))
    return check.judge(number, tap, pattern, deviation, model.traction, repeats)


class TestReasons:
    def test_a_pattern_that_explains_familiar_readings_is_believed(self):
        verdict = judge(make_check(), make_tap())
        assert verdict.trusted is True and verdict.reason is None and verdict.checked
        assert verdict.mismatch == pytest.approx(0, abs=1e-6)

    def test_a_contact_that_is_too_light_is_not_checked(self):
        least = LEAST_COUNTS / CONTRACT.counts_per_unit[2]
        light = judge(make_check(), make_tap(0.99 * least, x=3), factor=5)
        assert (light.trusted, light.reason, light.mismatch, light.checked) == (None, None, None, False)
        assert judge(make_check(), make_tap(1.01 * least, x=3)).trusted is False

    def test_a_taxel_is_stuck_from_the_fifth_repeat_on(self):
        assert judge(make_check(), make_tap(), repeats=REPEATS - 1).trusted is True
        stuck = judge(make_check(), make_tap(), repeats=REPEATS)
        assert (stuck.trusted, stuck.reason) == (False, "stuck") and REPEATS == 5

    def test_a_taxel_is_stuck_in_a_light_contact_too(self):
        stuck = judge(make_check(), make_tap(0.01), repeats=REPEATS)
        assert (stuck.trusted, stuck.reason) == (False, "stuck")

    def test_readings_of_no_contact_are_unfamiliar_whatever_the_force(self):
        for z in (0.5, 2.0, 3.5):
            assert judge(make_check(), make_tap(z, x=0.4)).trusted is True
            strange = judge(make_check(), make_tap(z, x=0.6))
            assert (strange.trusted, strange.reason) == (False, "unfamiliar")

    def test_a_pattern_that_does_not_explain_its_readings_is_told(self):
        wrong = judge(make_check(), make_tap(), factor=2)
        assert (wrong.trusted, wrong.reason) == (False, "unexplained")
        assert wrong.mismatch is not None and wrong.mismatch > MOST_MISMATCH

    @pytest.mark.parametrize(("z", "limit"), [(0.2, 0.519), (1.0, 0.61), (3.0, 0.681)])
    def test_a_pattern_that_the_model_is_not_sure_of_is_told_the_sooner_the_lighter_it_is(self, z, limit):
        assert judge(make_check(), make_tap(z), doubt=limit - 0.01).trusted is True
        unsure = judge(make_check(), make_tap(z), doubt=limit + 0.01)
        assert (unsure.trusted, unsure.reason) == (False, "uncertain")

    def test_without_traction_readings_are_still_checked(self):
        check, tap = make_check(), make_tap(x=1)
        pattern = np.ones((40, 40), dtype=np.float32)
        verdict = check.judge(0, tap, pattern, None, None, 0)
        assert (verdict.mismatch, verdict.reason) == (None, "unfamiliar")

    @pytest.mark.parametrize("low", [0.0, 0.5])
    def test_a_checkerboard_is_of_no_contact_and_neither_a_row_nor_a_taxel_is_one(self, low):
        tap = make_tap()
        tap[2] = np.where(np.indices((4, 4)).sum(axis=0) % 2, 2, 2 * low)
        assert judge(make_check(), tap).reason == "unfamiliar"
        for place in (np.s_[1], np.s_[1, 2], np.s_[::2]):
            tap[2] = 2 * low
            tap[2][place] = 2
            assert judge(make_check(), tap).trusted is True

    @pytest.mark.parametrize(("z", "taxels"), [(6.6, 1), (3.7, 16)])
    def test_a_press_stronger_than_in_training_is_told(self, z, taxels):
        for factor, reason in ((1.0, "beyond"), (0.95, None)):
            tap = make_tap()
            tap[2] = 0
            tap[2].flat[:taxels] = factor * z
            assert judge(make_check(make_trusted_contract(output_full_scale=10.0)), tap).reason == reason

    def test_a_pattern_deeper_than_in_training_is_told(self):
        for full_scale, reason in ((1.8, "beyond"), (1.9, None)):
            check = make_check(make_trusted_contract(output_full_scale=full_scale))
            assert judge(check, make_tap(2.0)).reason == reason

    @pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
    def test_what_is_not_finite_is_never_believed(self, bad):
        tap, pattern, traction = make_tap(), np.ones((40, 40), dtype=np.float32), np.zeros((3, 8, 8), dtype=np.float32)
        deviation = 0.1 * pattern
        for place in (tap, pattern, deviation, traction):
            kept = place.flat[-1]
            place.flat[-1] = bad
            with np.errstate(all="ignore"):
                assert make_check().judge(0, tap, pattern, deviation, traction, 0).trusted is not True
            place.flat[-1] = kept

    def test_readings_that_are_not_finite_are_of_no_contact(self):
        tap = make_tap()
        tap[0, 0, 0] = np.nan
        assert make_check().judge(0, tap, np.ones((40, 40), dtype=np.float32), None, None, 0).reason == "unfamiliar"

    @pytest.mark.parametrize("scale", [1e-6, 1e-3, 1e3, 1e6])
    def test_readings_of_any_size_give_a_verdict(self, scale):
        verdict = judge(make_check(), make_tap(2 * scale))
        assert (verdict.trusted, verdict.reason) == ((None, None) if scale < 0.1 else (False, "beyond"))
        assert verdict.mismatch is None or np.isfinite(verdict.mismatch)
        wrong = judge(make_check(), make_tap(2 * scale), factor=3)
        assert wrong.trusted is (None if scale < 0.1 else False)

    def test_gains_that_are_certain_leave_less_unexplained(self):
        tap = make_tap()
        tap[2, 1, 1] *= 1.2
        sure, unsure = make_check(), make_check()
        certain = PatternCheck(make_trust(), CONTRACT)
        certain.use_pad(np.append(PAD_ROW[:-1], np.float32(1)))
        pattern = np.kron(make_tap()[2], np.ones((10, 10), dtype=np.float32))
        traction = np.zeros((3, 8, 8), dtype=np.float32)
        shares = [check.judge(0, tap, pattern, None, traction, 0).mismatch for check in (certain, sure, unsure)]
        assert shares[0] > shares[1] == shares[2]


class TestSensor:
    def test_it_is_suspected_after_several_odd_contacts_and_cleared_by_good_ones(self):
        check = make_check()
        odd, good = make_tap(x=2), make_tap()
        suspected = []
        for number in range(6):
            judge(check, odd, number)
            suspected.append(check.suspected)
        assert suspected[:3] == [False] * 3 and suspected[-1]
        verdict = judge(check, good, 6)
        assert (verdict.trusted, verdict.reason) == (False, "sensor")
        for number in range(7, 7 + _CONTACTS):
            judge(check, good, number)
        assert not check.suspected and judge(check, good, 99).trusted is True

    def test_one_odd_contact_proves_nothing_however_long_it_goes_on(self):
        check = make_check()
        for _ in range(500):
            judge(check, make_tap(x=5), 0)
        judge(check, make_tap(), 1)
        assert not check.suspected

    def test_odd_contacts_far_between_prove_nothing(self):
        check = make_check()
        for number in range(200):
            judge(check, make_tap(x=2 if number % 5 == 0 else 0), number)
            assert not check.suspected

    def test_a_contact_counts_by_its_strongest_scan(self):
        def suspected(*scans):
            check = make_check()
            for number in range(8):
                for tap in scans:
                    judge(check, tap, number)
            return check.suspected

        assert not suspected(make_tap(1, x=2), make_tap(3))
        assert not suspected(make_tap(3), make_tap(1, x=2))
        assert suspected(make_tap(3, x=2), make_tap(1))

    def test_an_hour_of_odd_contacts_is_forgotten_as_soon_as_a_minute_of_them(self):
        def contacts_until_cleared(odd):
            check = make_check()
            for number in range(odd):
                judge(check, make_tap(x=2), number)
            for number in range(_CONTACTS):
                if not check.suspected:
                    return number
                judge(check, make_tap(), odd + number)
            return None

        assert contacts_until_cleared(3600) == contacts_until_cleared(20) is not None
        assert contacts_until_cleared(20) >= 9  # it does not flicker about one level

    def test_an_hour_of_good_contacts_does_not_hide_a_fault(self):
        def contacts_until_suspected(good):
            check = make_check()
            for number in range(good):
                judge(check, make_tap(), number)
            for number in range(_CONTACTS):
                if check.suspected:
                    return number
                judge(check, make_tap(x=2), good + number)
            return None

        assert contacts_until_suspected(3600) == contacts_until_suspected(1) is not None

    def test_what_is_not_finite_leaves_the_evidence_as_it_was(self):
        check, bad = make_check(), make_tap()
        bad[0, 0, 0] = np.nan
        for number in range(3):
            judge(check, bad, number)
        for number in range(3, 9):
            judge(check, make_tap(x=2), number)
        assert check.suspected

    def test_light_touches_show_nothing(self):
        check = make_check()
        for number in range(50):
            judge(check, make_tap(0.05, x=5), number)
        assert not check.suspected


class TestBelonging:
    def test_an_earlier_tap_that_was_elsewhere_does_not_belong(self):
        window = np.zeros((4, 3, 4, 4), dtype=np.float32)
        window[:, 2].reshape(4, -1)[:, FOREIGN_TAXEL] = 3, 3, 0, 3
        window[2, 2, 3, 3] = 3
        shares = make_check().belonging(window, 4)
        assert [share >= 0.5 for share in shares] == [False, True, False]
        assert strangers(shares, posed=True) == [2], "a tap with a pose of its own goes alone"
        assert strangers(shares, posed=False) == [2, 3]
        assert all(0 <= share <= 1 for share in shares)

    def test_only_taps_that_are_there_are_asked_for(self):
        window = np.ones((4, 3, 4, 4), dtype=np.float32)
        assert len(make_check().belonging(window, 3)) == 2 and make_check().belonging(window, 1) == []
        for posed in (False, True):
            assert strangers([], posed=posed) == strangers([0.1, 0.49], posed=posed) == []
            assert strangers([0.5], posed=posed) == [1]

    def test_a_tap_that_is_not_finite_does_not_belong(self):
        window = np.ones((4, 3, 4, 4), dtype=np.float32)
        window[1, 0, 0, 0] = np.nan
        assert strangers(make_check().belonging(window, 4), posed=True)[0] == 1
