"""Checks in the runtime, scan by scan: taps that are dropped, patterns that are not believed, models without checks."""
# pyright: reportCallIssue=false, reportPossiblyUnboundVariable=false

from dataclasses import replace

import numpy as np
import pytest
from edge_samples import FakeModel, make_contract, make_pad_contract, write_model
from runtime_samples import PRESS, Pushed, make_runtime
from trust_samples import FOREIGN_TAXEL, WrongModel, make_trusted_contract

from edge.inference.onnx_session import ModelSession
from edge.perception.contact_options import RuntimeOptions
from firmware_bridge.pad_geometry import USPA44
from firmware_bridge.scans.pad_constants import Pad
from firmware_bridge.scans.scan import ScanSeries

EVERY = RuntimeOptions(every_scan=True, follow_drift=False)
ELSEWHERE = 10


def make_pad(model=None, options=EVERY, **settings):
    model = model or FakeModel(make_trusted_contract())
    return Pushed(make_runtime(model, options=options, **settings), taxel=FOREIGN_TAXEL, noise=3)


def counted(pad, counts):
    """Return the result of a scan with these counts."""
    scan = pad.scan()
    return pad.runtime.push(replace(scan, counts=counts))


class TestTaps:
    def test_taps_of_one_contact_are_kept(self):
        pad = make_pad()
        taps = [pad.tap() for _ in range(5)]
        assert [one.taps_used for one in taps] == [1, 2, 3, 4, 4] and pad.kinds == []
        assert max(taps[-1].tap_mismatch) < 0.5

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

    def test_an_older_foreign_tap_leaves_the_newer_ones(self):
        pad = make_pad()
        pad.tap(taxel=ELSEWHERE, press=4 * PRESS)
        pad.tap()  # too light a press to settle that the one before is foreign
        result = pad.push(PRESS)
        assert [share >= 0.5 for share in result.tap_mismatch] == [False, True]
        assert result.taps_used == len(result.window) == 2 and pad.kinds == []

    def test_a_lighter_press_drops_a_tap_for_this_scan_only(self):
        pad = make_pad(options=replace(EVERY, every_scan=False))
        pad.tap(taxel=ELSEWHERE, press=3 * PRESS)
        light, again = pad.push(PRESS), pad.push(PRESS)
        assert light.taps_used == 1 and len(light.tap_mismatch) == 1 and pad.kinds == []
        assert again.reused_from == light.scan.number and again.pattern is light.pattern
        assert again.taps_used == len(again.window) == 1, "the pattern names the taps that it was made from"
        assert pad.push(3 * PRESS).taps_used == 1
        pad.push()
        assert pad.kinds == ["tap_dropped"]


class TestVerdict:
    def test_a_pattern_is_believed_or_marked_and_stays_the_networks(self):
        right = make_pad().push(PRESS)
        assert (right.trusted, right.untrusted_reason) == (True, None)
        assert right.mismatch == pytest.approx(0, abs=0.01)
        wrong = make_pad(WrongModel(make_trusted_contract(), 3)).push(PRESS)
        assert (wrong.trusted, wrong.untrusted_reason) == (False, "unexplained")
        assert np.allclose(wrong.pattern, 3 * right.pattern)

    @pytest.mark.parametrize(("thickness_mm", "outside"), [(5.2, False), (5.3, True)])
    def test_a_pad_far_outside_the_training_is_told(self, thickness_mm, outside):
        pad = make_pad(pad=Pad(thickness_mm=thickness_mm))
        assert (pad.push(PRESS).untrusted_reason == "pad") is outside

    @pytest.mark.parametrize("every_scan", [True, False])
    def test_a_stuck_taxel_is_told_at_the_fifth_repeat(self, every_scan):
        pad, series, told = make_pad(options=replace(EVERY, every_scan=every_scan)), ScanSeries("4", USPA44), []
        for number in range(20):
            scan = pad.scan(PRESS)
            if number == 10:
                held = scan.counts[:, 0, 0].copy()
            if number >= 10:
                scan.counts[:, 0, 0] = held
            result = pad.runtime.push(series.close(scan.counts, scan.time_ns))
            told.append(result.untrusted_reason)
        assert told.index("stuck") == 15

    def test_an_odd_sensor_is_suspected_and_cleared_with_events(self):
        pad = make_pad()

        def touch(x):
            counts = pad.scan(PRESS).counts
            counts[0, 0, 0] += x
            pad.results.append(counted(pad, counts))
            pad.push()
            return pad.results[-2]

        assert {touch(3000).untrusted_reason for _ in range(8)} == {"unfamiliar"} and pad.kinds == ["suspected"]
        assert touch(0).untrusted_reason == "sensor"
        assert [touch(0).trusted for _ in range(60)][-1] is True and pad.kinds == ["suspected", "cleared"]


@pytest.mark.parametrize("contract", [make_contract(), make_pad_contract()])
def test_a_model_without_checks_says_that_it_does_not_know(tmp_path, contract):
    pad = make_pad(ModelSession(write_model(tmp_path / "plain.onnx", contract)))
    for taxel in (FOREIGN_TAXEL, ELSEWHERE):
        result = pad.tap(taxel=taxel)
        assert result.pattern is not None
        assert (result.trusted, result.untrusted_reason, result.mismatch) == (None, None, None)
        assert result.tap_mismatch is None
    assert result.taps_used == 2
