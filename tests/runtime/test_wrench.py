"""Force and torque of a traction, and separate contacts of a pattern from scan to scan, against closed forms."""

import math
from dataclasses import replace

import numpy as np
import pytest
from edge_samples import fake_source, make_contract, make_pad_contract, make_scan, make_wrench_result
from hypothesis import given
from hypothesis import strategies as st
from mcap_samples import arrays_of, messages_of
from scipy import ndimage

from edge.api import USPA44, Pad, PatchEvents, Result, UsageError, find_model, load_model, patches
from edge.inference.trust_model import features
from edge.perception.pattern_description import LEAST_FORCE_N, Balance, wrench_of
from edge.sinks.mcap import McapSink
from edge.sinks.ros2.map_messages import recorded_map
from edge.sinks.ros2.messages import WRENCH_STAMPED, force_and_torque

PITCH_MM, PIXELS = 4.7, 8
NEAR = {"counts_per_newton": (1300.0, 1500.0)}
CELL_MM = 4 * PITCH_MM / PIXELS
AREA_MM2 = (4 * PITCH_MM) ** 2
FORCE_N = 20 * PITCH_MM**2 / 1000
"""Force of make_wrench_result: 20 kPa on taxel 5, the second of the second row."""


def even(x=0.0, y=0.0, z=0.0):
    return np.ones((3, PIXELS, PIXELS), np.float32) * np.array([x, y, z], np.float32)[:, None, None]


@given(st.integers(1, 9), st.integers(1, 9), st.floats(0.1, 10), st.integers(0, 99))
def test_any_traction_gives_the_sums_over_its_pixels(height, width, pixel_mm, seed):
    traction = np.random.default_rng(seed).normal(size=(3, height, width))
    force, torque = np.zeros(3), np.zeros(3)
    for row in range(height):
        for col in range(width):
            arm = (col - (width - 1) / 2) * pixel_mm, (row - (height - 1) / 2) * pixel_mm, 0
            part = traction[:, row, col] * pixel_mm**2 / 1000
            force, torque = force + part, torque + np.cross(arm, part)
    wrench = wrench_of(traction, pixel_mm)
    np.testing.assert_allclose(wrench.force_n, force, atol=1e-12 * pixel_mm**2 * 100)
    np.testing.assert_allclose(wrench.torque_n_mm, torque, atol=1e-10 * pixel_mm**3)


def test_of_a_light_touch_neither_centre_nor_shear_is_told():
    for share, told in ((0.99, False), (1.01, True), (-5, False)):
        wrench = wrench_of(even(z=share * LEAST_FORCE_N * 1000 / AREA_MM2), CELL_MM)
        assert (wrench.centre_of_pressure_mm is not None) == (wrench.shear_ratio is not None) == told
    assert wrench_of(even(3, -4, 10), CELL_MM).shear_ratio == pytest.approx(0.5)


@pytest.fixture
def press():
    """Readings of a press to the right of the middle under 4 N of drag, by the bundled model's own operator."""
    contract = load_model(find_model("stsr-int8")).contract
    forward, row = contract.read_trust().forward, np.zeros(contract.pad_width, np.float32)
    pattern = np.zeros(contract.pattern_shape, np.float32)
    pattern[10:30, 24:36] = 0.3
    drag_n = np.array([4.0, -2.0], np.float32)
    traction = even(*drag_n * 1000 / AREA_MM2, z=20.0)
    operator = forward.of_pad(row[: len(contract.pad_inputs)])
    readings = (operator @ features(pattern, traction)).reshape(3, 4, 4)
    return Balance(USPA44), pattern, traction, readings, operator, drag_n


def test_force_follows_the_readings_whatever_the_network_finds(press):
    balance, pattern, traction, readings, operator, drag_n = press
    level_n = wrench_of(traction, CELL_MM).force_n[2]
    for number, (strength, off) in enumerate([(1.0, 1.0)] * 40 + [(1.0, 1.1), (1.2, 0.8), (0.8, 1.3)]):
        found = traction * np.array([off, 2 - off, off], np.float32)[:, None, None] * np.float32(strength)
        balanced = balance(found, pattern * np.float32(strength), readings * np.float32(strength), 7, operator)
        force_n = wrench_of(balanced, CELL_MM).force_n
        assert force_n[2] == pytest.approx(strength * level_n, rel=0.02), number
        assert force_n[:2] == pytest.approx(strength * drag_n, abs=0.05 if strength == 1 else 0.4), number


def test_shear_is_never_scaled_beyond_what_pads_differ_by(press):
    _, pattern, traction, readings, operator, drag_n = press
    for off, most in ((20.0, 3.0), (-5.0, 0.5)):
        found, balance = traction * np.array([off, off, 1], np.float32)[:, None, None], Balance(USPA44)
        for _ in range(300):
            force_n = wrench_of(balance(found, pattern, readings, 9, operator), CELL_MM).force_n
        assert force_n[:2] == pytest.approx(most * drag_n, abs=0.1)


def test_where_nothing_presses_the_traction_stays(press):
    balance, pattern, traction, readings, operator, _ = press
    assert balance(traction, pattern, -readings, 0, operator) is traction
    weak = traction * np.float32(0.001)
    assert balance(weak, pattern, readings, 0, operator) is weak


def test_a_recording_holds_it_as_messages_and_as_arrays(tmp_path):
    sink = McapSink(tmp_path / "out.mcap", make_pad_contract(interval_factor=1.6), fake_source())
    free, pressed = (make_wrench_result(number, press) for number, press in ((0, 0), (1, 20_000)))
    for result in (free, pressed):
        sink.write(result, {})
    sink.close()
    told, torque_n_mm = messages_of(tmp_path / "out.mcap"), pressed.wrench.torque_n_mm
    [(_, traction)], [(_, data)] = told["/s4/traction"], told["/s4/wrench"]
    np.testing.assert_allclose(recorded_map(traction), pressed.traction * 1e3, rtol=1e-6)  # in [Pa]
    stamped = WRENCH_STAMPED.decode(data)["wrench"]
    assert list(stamped["force"].values()) == pytest.approx([0, 0, FORCE_N])
    assert list(stamped["torque"].values()) == pytest.approx([one / 1000 for one in torque_n_mm])
    arrays = arrays_of(tmp_path / "out.mcap")
    np.testing.assert_allclose(arrays["traction"], [0 * pressed.traction, pressed.traction], rtol=1e-6)
    assert np.isnan(arrays["wrench"][0]).all() and np.isnan(arrays["centre_of_pressure_mm"][0]).all()
    np.testing.assert_allclose(arrays["wrench"][1], (*pressed.wrench.force_n, *torque_n_mm), atol=5e-4)
    np.testing.assert_allclose(arrays["centre_of_pressure_mm"][1], (-2.35, -2.35), rtol=1e-6)
    assert arrays["wrench_origin"].tolist() == ["", "nominal"]


def test_ros_takes_the_wrench_before_the_calibrated_force():
    both = make_wrench_result(counts_per_newton=1000.0)
    assert both.wrench is not None and both.force_n == 20 and both.wrench_origin == "calibrated"
    told = force_and_torque(both, USPA44)
    assert told is not None and told[0] == both.wrench.force_n and not math.isnan(told[1][2])


def test_a_record_states_how_far_its_newtons_may_be_off():
    for settings, expected in (
        ({}, 0.45),  # 90 % of the even range of the sensors that the model was trained for
        ({"counts_per_newton": 1500.0}, None),
        ({"counts_per_newton": {"4": 1500.0}, "scale_intervals": {"4": (1410.0, 1590.0)}}, 0.06),
        (
            {"counts_per_newton": {"4": 1500.0}, "scale_intervals": {"4": (900.0, 2100.0)}},
            0.45,
        ),  # not given to the model
        ({"pad": Pad(counts_per_newton=1200.0)}, None),
        ({"pad": Pad(counts_per_newton=1200.0, intervals=NEAR)}, 0.25),  # to its farther end
        ({"pad": Pad(intervals=NEAR), "counts_per_newton": 1500.0}, None),  # that is no interval of these
        ({"pad": Pad(counts_per_newton=1200.0), "scale_intervals": {"4": (1140.0, 1260.0)}}, None),
    ):
        made = make_wrench_result(**settings)
        assert made.scale_error == (None if expected is None else pytest.approx(expected)), settings
        assert made.wrench_origin == ("nominal" if expected == 0.45 else "calibrated")


CONTRACT = make_contract(scale=10, contact_level=0.5)
PIXEL_MM = 0.47
ACROSS_MM = (np.arange(40) - 19.5) * PIXEL_MM
X_MM, Y_MM = np.meshgrid(ACROSS_MM, ACROSS_MM)


def result_of(pattern, traction=None, **more):
    wrench = None if traction is None else wrench_of(traction, 18.8 / traction.shape[-1])
    given = {"scan": make_scan(), "source": "device", "model": "m", "state": "contact", "contact": True, **more}
    return Result(pattern=pattern.astype(np.float32), traction=traction, wrench=wrench, **given)


def disc(x_mm, y_mm, radius_mm):
    return np.hypot(X_MM - x_mm, Y_MM - y_mm) <= radius_mm


def test_two_contacts_have_areas_centres_and_shares_of_the_force():
    traction = np.zeros((3, 8, 8), dtype=np.float32)
    traction[2, :, :4], traction[2, :, 4:], traction[0, :, 4:] = 2, 6, 3
    big, small = patches(result_of(disc(5, 0, 3) + disc(-5, 1, 2), traction, trusted=True), CONTRACT)
    for one, place, radius_mm in ((big, (5, 0), 3), (small, (-5, 1), 2)):
        assert one.centre_mm == pytest.approx(place, abs=0.1) and one.trusted
        assert one.area_mm2 == pytest.approx(np.pi * radius_mm**2, rel=0.05)
        assert one.size_mm == pytest.approx((2 * radius_mm,) * 2, rel=0.05), "four deviations of a disc are its width"
        assert one.normal == pytest.approx((0, 0, 1), abs=1e-3)
    total = np.array(result_of(disc(0, 0, 1), traction).wrench.force_n)
    assert np.add(big.force_n, small.force_n) == pytest.approx(total)
    assert big.shear_ratio == pytest.approx(0.5) and small.shear_ratio == 0


def test_a_bar_has_an_axis_a_tilted_face_its_normal_specks_none():
    along, across = X_MM * np.cos(0.5) + Y_MM * np.sin(0.5), Y_MM * np.cos(0.5) - X_MM * np.sin(0.5)
    (bar,) = patches(result_of((abs(along) < 6) & (abs(across) < 1)), CONTRACT)
    assert bar.long_axis_deg == pytest.approx(np.degrees(0.5), abs=1) and bar.force_n is None is bar.shear_ratio
    assert bar.size_mm[0] > 4 * bar.size_mm[1]
    (face,) = patches(result_of((1 + 0.02 * X_MM) * disc(0, 0, 4)), CONTRACT)
    assert face.normal == pytest.approx(np.array([-0.02, 0, 1]) / np.hypot(0.02, 1), abs=1e-3)
    assert patches(result_of(np.zeros((40, 40))), CONTRACT) == []
    assert patches(replace(result_of(np.zeros((40, 40))), pattern=None), CONTRACT) == []
    assert len(patches(result_of(disc(3, 0, 4) + disc(-8, -8, 0.5)), CONTRACT)) == 1


def test_areas_are_those_that_are_connected_by_edges():
    rng = np.random.default_rng(1)
    for _ in range(50):
        mask = rng.random((40, 40)) < rng.uniform(0.2, 0.8)
        labels, count = ndimage.label(mask)
        sizes = np.bincount(labels.ravel())[1:]
        expected = sorted(sizes[sizes >= 0.05 * mask.sum()] * PIXEL_MM**2)
        assert count and sorted(one.area_mm2 for one in patches(result_of(mask), CONTRACT)) == pytest.approx(expected)


def told(events, results):
    return [(one.kind, one.number) for result in results for one in events(result)]


def test_a_contact_begins_moves_and_ends_once():
    events, held = PatchEvents(CONTRACT), result_of(disc(-5, 0, 2))
    free = result_of(np.zeros((40, 40)), state="idle", contact=False)
    assert told(events, [held, held]) == [] and told(events, [held, held]) == [("begin", 1)]
    assert told(events, [result_of(disc(-5 + 0.25 * step, 0, 2)) for step in range(9)]) == [("move", 1)] * 2
    both = result_of(disc(-3, 0, 2) + disc(5, 5, 2))
    assert told(events, [both] * 3) == [("begin", 2)]
    assert told(events, [free, free, both]) == [], "missing for two results is no end"
    lost = [replace(both, state="dropped"), replace(both, trusted=False), replace(both, contact=None)]
    assert told(events, lost) == []
    assert told(events, [free] * 3) == [("end", 1), ("end", 2)] and told(events, [free] * 3) == []
    assert told(events, [held, free, held, free, held]) == [], "a flicker is no contact"


def test_a_slip_is_told_once_until_it_has_stuck_again():
    def sheared(ratio):
        traction = np.zeros((3, 8, 8), dtype=np.float32)
        traction[2], traction[0] = 5, 5 * ratio
        return result_of(disc(0, 0, 3), traction)

    events = PatchEvents(CONTRACT, slip_ratio=0.6)
    ratios = [0.1, 0.1, 0.1, 0.61, 0.7, 0.55, 0.61, 0.4, 0.61]
    got = [[one.kind for one in events(sheared(ratio))] for ratio in ratios]
    assert got == [[], [], ["begin"], ["slip"], [], [], [], [], ["slip"]]
    for limit in ({"slip_ratio": float("nan")}, {"move_mm": -1.0}):  # which would never be reached
        with pytest.raises(UsageError, match="expected a positive number"):
            PatchEvents(CONTRACT, **limit)
