"""The guided press, by simulated fingers: every way a pad can lie, by itself and over a real pseudo-terminal."""

from itertools import product

import numpy as np
import pytest
from doctor_samples import visit

from edge.doctor import guided_press
from edge.doctor.grip import Grip
from edge.doctor.guided_press import (
    ASK_WEIGHT,
    GuidedPress,
    Press,
    Weighed,
    find_order,
    judge_force,
    judge_press,
    orders,
)
from edge.doctor.rehearsal import load_asked
from firmware_bridge.pad_geometry import USPA44
from firmware_bridge.scans.mounting import Mounting

CORNERS = USPA44.corners


def answer_to(deformations, guide=None, period_s=0.01, typed=()):
    """Return the questions of a guide, and the guide, for these deformations (n, 3, 4, 4); grams are `typed`."""
    guide, lines = guide or GuidedPress(weigh=bool(typed)), list(typed)
    asked = [guide.first]
    for number, zeroed in enumerate(deformations):
        ask = guide.push(zeroed.astype(np.float32), number * period_s)
        while ask is not None:
            asked.append(ask)
            ask = guide.type(lines.pop(0)) if ask.endswith(ASK_WEIGHT) and lines else None
    return asked, guide


def judged(guide):
    findings, mounting = judge_press(guide.presses)
    return {finding.name: finding for finding in findings}, mounting


@pytest.mark.parametrize("name", orders())
def test_every_turn_and_every_axis_is_found(name):
    order = orders()[name]
    for swap, *signs in product((False, True), *[(1, -1)] * 3):
        sits = Mounting(order, swap, tuple(signs))
        script = visit(sits)
        asked, guide = answer_to(script + np.random.default_rng(1).normal(0, 2, script.shape))
        assert guide.done and len(asked) == 12
        findings, mounting = judged(guide)
        assert mounting == sits
        assert (findings["taxel order"].verdict == "ok") == (order == tuple(range(16)))
        assert (findings["axis signs"].verdict == "ok") == (not mounting.turns_axes)


def test_a_skipped_corners_finger_does_not_count_for_the_next():
    guide = GuidedPress()
    pressed = load_asked("Press the top left corner", np.zeros((3, 4, 4)))
    answer_to([pressed] * 10, guide)
    assert guide.type() == "Skipped. Let go."
    more, _ = answer_to([pressed] * 40, guide)
    assert more[1:] == [], "the finger is still there"
    rest = visit()
    rest = rest[np.flatnonzero(rest[:, 2].any(axis=(1, 2)))[90:][0] :]  # from the press of the second corner on
    more, _ = answer_to([np.zeros((3, 4, 4))] * 25 + list(rest), guide)
    assert "Press the top right corner" in more[1] and guide.done
    assert [press.place for press in guide.presses] == [3, 15, 12]
    _, mounting = judged(guide)
    assert mounting == Mounting()
    assert guide.type() is None


def press(place, taxel=None, z=4000.0, push=(500.0, 500.0)):
    x, y = dict(zip(CORNERS, ((1, 1), (-1, 1), (-1, -1), (1, -1)), strict=True))[place]
    return Press(place, place if taxel is None else taxel, z, None if push is None else (push[0] * x, push[1] * y))


class TestAnswers:
    def test_presses_that_fit_no_turn_are_told_apart(self):
        crossed = [press(0, 0), press(3, 15), press(15, 3), press(12, 12)]
        assert find_order(crossed) is None
        (order, _), mounting = judge_press(crossed)
        assert (order.verdict, mounting) == ("wrong", None) and "top right: taxel 15" in order.measured
        assert find_order([press(0, 0), press(3, 0), press(15, 15), press(12, 12)]) is None

    @pytest.mark.parametrize(
        ("presses", "verdict", "measured"),
        [
            # One push is not outvoted by three.
            ([press(place, push=(-500, 500) if place == 3 else (900, 900)) for place in CORNERS],
             "wrong", "the corners contradict each other"),
            ([press(place, push=None if place > 3 else (500, 500)) for place in CORNERS],
             "not known", "2 of 4 pushes measured"),
            ([press(place, z=-4000.0 if place == 15 else 4000.0) for place in CORNERS],
             "wrong", "z rises under some presses and falls under others"),
        ],
    )  # fmt: skip
    def test_axes_that_are_not_clear_are_told_and_give_no_mounting(self, presses, verdict, measured):
        (order, axes), mounting = judge_press(presses)
        assert (order.name, order.verdict, mounting) == ("taxel order", "ok", None)
        assert (axes.name, axes.verdict, axes.measured) == ("axis signs", verdict, measured)

    def test_what_a_sensor_file_keeps_is_no_longer_wrong(self):
        turned = [press(place, CORNERS[(n + 1) % 4]) for n, place in enumerate(CORNERS)]
        for kept, verdict, words in ((False, "wrong", "--out FILE"), (True, "look", "the sensor file states this")):
            findings, mounting = judge_press(turned, kept=kept)
            assert mounting is not None and mounting.moves_taxels
            assert findings[0].verdict == verdict and words in findings[0].remedy
            assert findings[0].measured == "turned by 270 degrees clockwise"


class TestPerson:
    def test_a_press_in_the_middle_torn_scans_and_a_missing_push(self):
        middle, script = np.zeros((40, 3, 4, 4)), visit(rest=25)
        middle[:, 2, 1:3, 1:3] = 1000
        script[70:115] = 0  # let go without a push, which is a press all the same
        script[5::7, :, :2] = np.nan
        asked, guide = answer_to([*middle, *np.zeros((30, 3, 4, 4)), *script])
        assert asked[2] == "No push was measured. Let go." and guide.presses[0].push_counts is None
        assert len(asked) == 12 and guide.done and len(guide.presses) == 4
        assert judged(guide)[1] == Mounting()

    def test_nobody_there(self):
        asked, guide = answer_to(np.zeros((700, 3, 4, 4)), period_s=guided_press.PATIENCE_S / 600)
        assert guide.done and len(asked) == 1
        findings, mounting = judged(guide)
        assert mounting is None and {one.verdict for one in findings.values()} == {"not known"}

    @pytest.mark.parametrize(
        ("z_counts", "beside", "error", "verdict", "kept"),
        [
            (2353.6, 1.0, 0.08, "ok", True),
            (2353.6, 0.3, 0.08, "ok", True),
            (2353.6, 0.2, 0.3, "look", True),
            (2353.6, -0.4, 0.3, "look", True),  # the layer bulges beside the weight
            (1700.0, 1.0, 0.08, "look", True),
            (1500.0, 1.0, 0.08, "look", False),
            (1500.0, 0.2, 0.3, "look", True),
            (200.0, 1.0, 0.08, "look", False),  # 2000 g typed as 200
        ],
    )
    def test_a_weight_gives_counts_per_newton(self, z_counts, beside, error, verdict, kept):
        laid, share = np.zeros((120, 3, 4, 4)), np.full((4, 4), beside / 16)
        share[1:3, 1:3] = (16 - 12 * beside) / 64
        laid[:, 2] = z_counts * share + np.random.default_rng(0).normal(0, 1, (120, 4, 4))
        laid[:20, 2] *= np.linspace(0, 1, 20)[:, None, None]
        script = [*visit(), *laid, *np.zeros((30, 3, 4, 4))]
        asked, guide = answer_to(script, typed=["200"])
        assert asked[-2:] == ["Lay 200 g on the pad, flat and covering all of it, hands off.", "Good. Take it off."]
        assert guide.weighed == pytest.approx((z_counts / 1.96133, error), rel=0.02)
        finding = judge_force(guide.weighed, kept=False)
        assert finding.verdict == verdict and guide.weighed.plausible == kept == ("not kept" not in finding.remedy)

    @pytest.mark.parametrize("noise", [1.0, 12.0])
    def test_a_weight_is_steady_within_noise_and_not_while_it_moves(self, noise):
        time_s = np.arange(400) / 100
        for share in (time_s**0, time_s / 5, 1 + 0.1 * np.sin(2 * np.pi * time_s)):  # lies, is laid down, tilts
            laid = np.random.default_rng(1).normal(0, noise, (400, 3, 4, 4))
            laid[:, 2] += 147.1 * share[:, None, None]
            _, guide = answer_to([*visit(), *laid, *np.zeros((30, 3, 4, 4))], typed=["200"])
            assert guide.weighed == (pytest.approx((1200.0, 0.08), rel=0.02) if np.ptp(share) == 0 else None)
        free = np.random.default_rng(1).normal(0, 40, (2000, 3, 4, 4))  # strong noise of a free pad is no weight
        assert answer_to([*visit(), *free], typed=["200"])[1].weighed is None

    @pytest.mark.parametrize("wrong", ["0.2", "19", "4001", "nan", "-200", "200 g", "\x1b[2J"])
    def test_what_is_no_mass_in_grams_is_asked_again(self, wrong):
        asked, guide = answer_to(visit(), typed=[wrong, " 200 "])
        assert asked[-2].startswith(f"{wrong!r} is not a mass of 20 to 4000 grams.") and guide.weight_g == 200
        assert answer_to(visit(), typed=[wrong, ""])[1].weight_g is None


ZERO, SCALE = "zero after a grip", "scale in a grip"


@pytest.mark.parametrize(
    ("weighed", "ratio", "rest", "found", "wrong"),
    [
        ({}, -1.25, 0, {}, {SCALE: "not known"}),  # sensors differ by more, so that the ratio shows nothing
        ({}, -2.0, 0, {}, {SCALE: "look"}),
        ({"a": Weighed(1000.0, 0.06)}, -1.25, 0, {"b": (1250.0, 0.075)}, {}),
        ({"b": Weighed(1000.0, 0.0)}, -1.25, 0, {"a": (800.0, 0.045)}, {}),
        ({"a": Weighed(1000.0, 0.06), "b": Weighed(1250.0, 0.06)}, -1.25, 0, {}, {}),
        ({"a": Weighed(1000.0, 0.06), "b": Weighed(1000.0, 0.06)}, -1.25, 0, {}, {SCALE: "wrong"}),
        ({"a": Weighed(1000.0, 0.06)}, -0.4, 0, {}, {SCALE: "look"}),
        ({}, -1.25, 1800, {}, {ZERO: "wrong", SCALE: "not known"}),
        ({"a": Weighed(1000.0, 0.06)}, -1.25, 1200, {}, {ZERO: "wrong"}),
        ({"a": Weighed(1000.0, 0.0)}, -1.25, 500, {"b": (1250.0, 0.067)}, {}),
    ],
)
def test_a_grip_gives_a_pad_the_scale_of_its_partner(weighed, ratio, rest, found, wrong):
    grip = Grip(("a", "b"))
    for scan, z in enumerate([0] * 20 + [8000] * 120 + [0] * 30):
        assert not grip.over or scan > 140
        grip.push("a", scan / 100, z)
        grip.push("b", scan / 100 + 0.003, ratio * z - rest * (scan >= 140))
    assert grip.over and {one.name: one.verdict for one in grip.judge(weighed) if one.verdict != "ok"} == wrong
    assert grip.weighed.keys() == found.keys()
    assert all(one == pytest.approx(found[name], rel=0.01) for name, one in grip.weighed.items())


def test_a_grip_of_one_pad_alone_settles_nothing():
    grip = Grip(("a", "b"))
    for scan in range(200):
        grip.push("a", scan / 100, 4000.0)
        grip.push("b", scan / 100, 3.0)
    assert not grip.over and [one.verdict for one in grip.judge({})] == ["not known"]
    assert [one.verdict for one in Grip(("a", "b")).judge({})] == ["not known"]
