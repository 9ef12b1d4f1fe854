"""Checks in the runtime, scan by scan: taps that are dropped, patterns that are not believed, models without checks."""

from dataclasses import replace

import numpy as np
import pytest
from edge_samples import PERIOD_NS, REST, FakeModel, make_contract, make_pad_contract, make_scan, write_model
from runtime_samples import PRESS, make_runtime
from trust_samples import FOREIGN_TAXEL, WrongModel, make_trusted_contract

from edge.errors import EdgeError
from edge.inference.onnx_session import ModelSession
from edge.perception.contact_options import RuntimeOptions
from edge.perception.runtime import Runtime
from firmware_bridge.pad_geometry import USPA46
from firmware_bridge.scans.pad_constants import Pad
from firmware_bridge.scans.scan import Scan
from firmware_bridge.zeroing.baseline import Baseline

EVERY = RuntimeOptions(every_scan=True, follow_drift=False)
ELSEWHERE = 10
TAP_SCANS = 3


class Pressed:
    """Runtime with a sensor that is pressed tap by tap; its results are kept."""

    def __init__(self, model=None, options=EVERY):
        self.runtime = make_runtime(model or FakeModel(make_trusted_contract()), options=options)
        self.number = 0
        self.results = []

    def scan(self, press_counts=0.0, taxel=FOREIGN_TAXEL, **more):
        self.results.append(
            self.runtime.push(make_scan(self.number, press_counts=press_counts, taxel=taxel, noise=3, **more))
        )
        self.number += 1
        return self.results[-1]

    def tap(self, taxel=FOREIGN_TAXEL, press_counts=PRESS):
        """Return the result of the first scan of a tap that goes on and ends."""
        first, *_ = (self.scan(press_counts, taxel) for _ in range(TAP_SCANS))
        self.scan()
        return first

    def events(self, kind):
        return [event for result in self.results for event in result.events if event.kind == kind]


class TestTaps:
    def test_taps_of_one_contact_are_kept(self):
        pressed = Pressed()
        used = [pressed.tap().taps_used for _ in range(5)]
        assert used == [1, 2, 3, 4, 4] and not pressed.events("tap_dropped")
        assert pressed.results[-2].tap_mismatch is not None and max(pressed.results[-2].tap_mismatch) < 0.5

    def test_a_foreign_tap_is_dropped_with_those_before_it_and_forgotten(self):
        pressed = Pressed()
        for taxel in (FOREIGN_TAXEL, ELSEWHERE, FOREIGN_TAXEL):
            result = pressed.tap(taxel)
        assert result.taps_used == 1 and result.tap_mismatch is not None and result.tap_mismatch[0] >= 0.5
        assert result.window is not None and len(result.window) == 1
        assert len(pressed.events("tap_dropped")) == 1
        assert "the tap before does not belong" in pressed.events("tap_dropped")[0].detail
        assert pressed.tap().taps_used == 2  # the tap that has dropped the others is the first of the new contact

    def test_an_older_foreign_tap_leaves_the_newer_ones(self):
        pressed = Pressed()
        for _ in range(2):
            pressed.tap()
        # The guard would have dropped an older foreign tap before, so one is put into the memory by hand.
        oldest = sensor_of(pressed)._tracker._window[2]
        oldest[2, 1, 1], oldest[2, 3, 3] = 0, PRESS
        result = pressed.scan(PRESS)
        assert result.taps_used == 2 and result.tap_mismatch is not None
        assert [share >= 0.5 for share in result.tap_mismatch] == [False, True]
        assert result.window is not None and len(result.window) == 2

    def test_the_pattern_of_a_window_with_a_dropped_tap_is_that_of_fewer_taps(self):
        pressed, alone = Pressed(), Pressed()
        pressed.tap(ELSEWHERE)
        while pressed.number > alone.number:
            alone.scan()
        with_drop, without = pressed.scan(PRESS), alone.scan(PRESS)
        assert with_drop.taps_used == without.taps_used == 1
        assert with_drop.pattern is not None and np.array_equal(with_drop.pattern, without.pattern)

    def test_a_lighter_press_drops_a_tap_for_this_scan_only(self):
        pressed = Pressed()
        pressed.tap(ELSEWHERE, press_counts=3 * PRESS)
        light = pressed.scan(PRESS)
        assert light.taps_used == 1 and light.tap_mismatch is not None and len(light.tap_mismatch) == 1
        assert not pressed.events("tap_dropped")
        firm = pressed.scan(3 * PRESS)
        assert firm.taps_used == 1
        pressed.scan()
        assert len(pressed.events("tap_dropped")) == 1

    def test_a_pattern_in_use_names_the_taps_that_it_was_made_from(self):
        pressed = Pressed(options=replace(EVERY, every_scan=False))
        pressed.tap(ELSEWHERE, press_counts=3 * PRESS)
        made = pressed.scan(PRESS)
        again = pressed.scan(PRESS)
        assert again.reused_from == made.scan.number and again.pattern is made.pattern
        assert again.taps_used == made.taps_used == 1
        assert again.window is not None and len(again.window) == 1


def sensor_of(pressed):
    return pressed.runtime._sensors["4"]


class TestVerdict:
    def test_a_pattern_that_is_not_believed_is_marked_and_stays_the_networks(self):
        model = WrongModel(make_trusted_contract(), 3)
        result = Pressed(model).scan(PRESS)
        assert (result.trusted, result.untrusted_reason) == (False, "unexplained")
        window = np.zeros((4, 3, 4, 4), dtype=np.float32)
        assert result.zeroed is not None and result.pattern is not None
        window[0] = result.zeroed / np.array([500, 500, 1000], dtype=np.float32)[:, None, None]
        assert np.allclose(result.pattern, model.run(window, np.zeros(5, dtype=np.float32)))

    @pytest.mark.parametrize(
        ("pad", "outside"),
        [
            (Pad(), False),
            (Pad(thickness_mm=5.2), False),
            (Pad(thickness_mm=5.3), True),
            (Pad(thickness_mm=3.7), True),
            (Pad(thickness_mm=5.3, intervals={"thickness_mm": (5.0, 5.6)}), False),
            (Pad(thickness_mm=7.0, intervals={"thickness_mm": (5.5, 8.5)}), True),
            (Pad(counts_per_newton=2000.0), True),
        ],
    )
    def test_a_pad_far_outside_the_training_is_told(self, pad, outside):
        """The sample was trained on pads of 4.5 mm, half a millimetre either way."""
        pressed = Pressed()
        pressed.runtime = make_runtime(FakeModel(make_trusted_contract()), options=EVERY, pad=pad)
        assert (pressed.scan(PRESS).untrusted_reason == "pad") is outside

    def test_one_that_explains_its_readings_is_believed(self):
        result = Pressed().scan(PRESS)
        assert (result.trusted, result.untrusted_reason) == (True, None)
        assert result.mismatch == pytest.approx(0, abs=0.01)


class TestStuck:
    def stuck_after(self, options, growth):
        pressed = Pressed(options=options)
        taxel, held = 0, None
        for number in range(40):
            scan = make_scan(number, press_counts=PRESS + growth * number, noise=2)
            counts, renewed = scan.counts.copy(), scan.renewed.copy()
            if number >= 10:
                held = counts[:, 0, taxel].copy() if held is None else held
                counts[:, 0, taxel] = held
                renewed[0, taxel] = number == 10
            result = pressed.runtime.push(Scan("4", number, (number + 1) * PERIOD_NS, counts, scan.fresh, renewed))
            if result.trusted is False:
                assert result.untrusted_reason == "stuck"
                return number - 10
        return None

    def test_it_is_told_at_the_fifth_repeat(self):
        assert self.stuck_after(EVERY, 0) == 5

    def test_it_is_told_as_soon_where_the_last_pattern_stays_in_use(self):
        assert self.stuck_after(replace(EVERY, every_scan=False), 0) == 5


class TestSensor:
    def test_a_sensor_that_reads_oddly_is_suspected_and_cleared_with_events(self):
        contract = make_trusted_contract()
        pressed = Pressed(FakeModel(contract))

        def touch(x):
            scan = make_scan(pressed.number, press_counts=PRESS, noise=3)
            counts = scan.counts.copy()
            counts[0, 0, 0] += x
            pressed.results.append(pressed.runtime.push(replace(scan, counts=counts)))
            pressed.number += 1
            last = pressed.results[-1]
            pressed.scan()
            return last

        reasons = [touch(3000).untrusted_reason for _ in range(8)]
        assert set(reasons) == {"unfamiliar"} and len(pressed.events("suspected")) == 1
        assert touch(0).untrusted_reason == "sensor"
        assert [touch(0).trusted for _ in range(60)][-1] is True
        assert len(pressed.events("cleared")) == 1 and len(pressed.events("suspected")) == 1


class TestWithout:
    @pytest.mark.parametrize("contract", [make_contract(), make_pad_contract()])
    def test_a_model_without_checks_says_that_it_does_not_know(self, tmp_path, contract):
        pressed = Pressed(ModelSession(write_model(tmp_path / "plain.onnx", contract)))
        for taxel in (FOREIGN_TAXEL, ELSEWHERE):
            result = pressed.tap(taxel)
            assert result.pattern is not None
            assert (result.trusted, result.untrusted_reason, result.mismatch) == (None, None, None)
            assert result.tap_mismatch is None
        assert result.taps_used == 2

    def test_a_pad_of_4_by_6_works_without_checks(self):
        rest = np.full((3, 4, 6), 20_000, dtype=np.int32)
        baseline = Baseline.of("4", rest.astype(np.float32), created_unix_s=1000.0, scans=100, origin="file")
        contract = make_pad_contract(sensor="uSPa46", cols=6, pitch_mm=7.25, trust={})
        runtime = Runtime(FakeModel(contract), source="device", baselines={"4": baseline}, geometry=USPA46)
        counts = rest.copy()
        counts[2, 1, 4] += PRESS
        everywhere = np.ones((4, 6), dtype=bool)
        result = runtime.push(Scan("4", 0, PERIOD_NS, counts, everywhere, everywhere))
        assert result.pattern is not None and result.pattern.shape == (40, 60)
        assert result.trusted is None


class TestNotFinite:
    @pytest.mark.parametrize("bad", [np.nan, np.inf])
    def test_no_record_of_a_pattern_that_is_not_finite_is_believed(self, bad):
        model = WrongModel(make_trusted_contract(), bad)
        try:
            with np.errstate(all="ignore"):
                result = Pressed(model).scan(PRESS)
        except EdgeError:
            return
        assert result.trusted is not True

    @pytest.mark.parametrize("z", [26_000, 60_000])
    def test_counts_at_the_end_of_their_range_give_no_believed_pattern_that_is_not_finite(self, z):
        pressed = Pressed()
        for number in range(30):
            counts = np.full_like(REST, z + number % 3)
            everywhere = np.ones((4, 4), dtype=bool)
            result = pressed.runtime.push(Scan("4", number, (number + 1) * PERIOD_NS, counts, everywhere, everywhere))
            assert result.trusted is not True or (result.pattern is not None and np.isfinite(result.pattern).all())
