"""Models of a contract: what they take of the pad, and what of it reaches them."""

from dataclasses import replace

import numpy as np
import pytest
from edge_samples import (
    BASELINE,
    FakeModel,
    inferred,
    make_contract,
    make_pad_contract,
    make_scan,
    tiny_pattern,
    tiny_stiffness,
    tiny_traction,
    write_model,
)

from edge.errors import ModelError, WindowError
from edge.inference.onnx_session import ModelSession
from edge.perception.run_options import RuntimeOptions
from edge.perception.runtime import Runtime
from firmware_bridge.pad_geometry import CHANNELS
from firmware_bridge.scans.mounting import Mounting
from firmware_bridge.scans.pad_constants import LEVEL_90, Pad

GAINED = tuple(np.linspace(0.5, 2, CHANNELS).tolist())
PAD = Pad(thickness_mm=5.0, gains=GAINED)
MEASURED = replace(PAD, gain_half_widths=(0.02 * LEVEL_90,) * CHANNELS)
OTHER = Pad(thickness_mm=4.0, counts_per_newton=2000.0)


def random_window(seed=0):
    return np.random.default_rng(seed).normal(size=(4, 3, 4, 4)).astype(np.float32)


def row(*numbers):
    return np.array(numbers, dtype=np.float32)


@pytest.mark.parametrize(
    ("pad", "expected"),
    [
        (None, row(0, 0, 0, 0, 0)),
        (Pad(poisson=0.4), row(0, 0, 0, 0, 0)),
        (PAD, row(1, 0, 1, 0, 0.9)),
        (MEASURED, row(1, 0, 1, 0, 1 - 0.02 / 0.075)),
        (replace(PAD, gain_half_widths=(0.0,) * CHANNELS), row(1, 0, 1, 0, 1)),
        (replace(PAD, gain_half_widths=(0.5,) * CHANNELS), row(1, 0, 1, 0, 0)),
        (replace(OTHER, intervals={"thickness_mm": (3.8, 4.2)}), row(-1, 2, 1, 1, 0)),
        (replace(OTHER, intervals={"thickness_mm": (3.0, 5.0)}), row(0, 2, 0, 1, 0)),
        (Pad(counts_per_newton=1000.0), row(0, 0, 0, 1, 0)),
    ],
)
def test_a_pad_is_values_then_flags_then_the_certainty_of_gains(pad, expected):
    got = make_pad_contract().pad_row(pad)
    assert got.dtype == np.float32
    np.testing.assert_allclose(got, expected, atol=1e-6)


@pytest.mark.parametrize("factor", [None, 1.6])
def test_pad_and_traction_are_bound_beside_window_and_pattern(tmp_path, factor):
    contract = make_pad_contract(interval_factor=factor)
    session = ModelSession(write_model(tmp_path / "pad.onnx", contract))
    window = random_window()
    for pad in (None, contract.pad_row(PAD), contract.pad_row(OTHER), None):
        stiffness = 1 if pad is None else tiny_stiffness(pad)
        np.testing.assert_allclose(session.run(window, pad), stiffness * tiny_pattern(window), atol=1e-5)
        assert session.traction is not None and session.traction.shape == (3, 8, 8)
        np.testing.assert_allclose(session.traction, stiffness * tiny_traction(window, 2), atol=1e-5)
        assert (session.deviation is None) == (factor is None)


@pytest.mark.parametrize("pad", [row(0, 0, 0, 0), np.zeros(5), np.full(5, np.nan, np.float32)])
def test_a_pad_that_no_contract_gave_is_refused(tmp_path, pad):
    session = ModelSession(write_model(tmp_path / "pad.onnx", make_pad_contract()))
    with pytest.raises(WindowError, match=r"pad is .*, expected \(5,\) float32, finite"):
        session.run(random_window(), pad)


def test_a_traction_that_is_not_finite_is_never_given_out(tmp_path):
    contract = make_pad_contract(counts_per_unit=(1.0, 1.0, 1.0))
    session = ModelSession(write_model(tmp_path / "loud.onnx", contract, gain=3e38))
    window = np.zeros((4, 3, 4, 4), dtype=np.float32)
    window[0, 0] = 1e3  # x, which the tiny pattern does not see
    with pytest.raises(ModelError, match="'loud' gave a traction that is not finite"):
        session.run(window)


def runtime_of(model, **settings):
    baselines = {name: replace(BASELINE, sensor=name) for name in ("4", "6")}
    return Runtime(
        model,
        **({"source": "device", "baselines": baselines, "options": RuntimeOptions(every_scan=True)} | settings),
    )


@pytest.mark.parametrize(
    ("settings", "expected", "origin"),
    [
        ({}, [0, 0, 0, 0, 0], "nominal"),
        ({"pad": PAD}, [1, 0, 1, 0, 0.9], "nominal"),
        ({"pad": {"4": OTHER}}, [-1, 2, 1, 1, 0], "calibrated"),
        ({"pad": {"6": OTHER}}, [0, 0, 0, 0, 0], "nominal"),
        ({"pad": PAD, "counts_per_newton": {"4": 1500.0}}, [1, 1, 1, 1, 0.9], "calibrated"),
        ({"pad": OTHER, "counts_per_newton": 1500.0}, [-1, 2, 1, 1, 0], "calibrated"),
        # A model that does not take the sensitivity gives nominal newtons.
        ({"counts_per_newton": 1500.0, "takes": (("thickness_mm", 4.5, 0.5),)}, [0, 0, 0], "nominal"),
    ],
)
def test_the_model_is_given_the_pad_of_the_sensor(settings, expected, origin):
    own = {name: value for name, value in settings.items() if name != "takes"}
    model = FakeModel(make_pad_contract(**({"pad_inputs": settings["takes"]} if "takes" in settings else {})))
    result = runtime_of(model, **own).push(make_scan(0, press_counts=3000))
    assert (model.pads[0].tolist(), result.wrench_origin) == (pytest.approx(expected), origin)


@pytest.mark.parametrize("takes_gains", [True, False])
def test_gains_divide_what_the_network_sees_and_nothing_else(takes_gains):
    model = FakeModel(make_pad_contract(takes_gains=takes_gains))
    bare = runtime_of(FakeModel(make_contract())).push(make_scan(0, press_counts=3000, taxel=9))
    result = runtime_of(model, pad=PAD).push(make_scan(0, press_counts=3000, taxel=9))
    np.testing.assert_array_equal(result.zeroed, bare.zeroed)
    np.testing.assert_array_equal(result.window[0], bare.zeroed)
    assert result.force_counts == bare.force_counts == 3000
    gain = GAINED[2 * 16 + 9] if takes_gains else 1
    assert model.windows[0][0, 2].flat[9] == pytest.approx(3 / gain)
    assert np.count_nonzero(model.windows[0]) == 1


def test_two_sensors_in_one_call_get_what_each_gets_alone(tmp_path):
    contract = make_pad_contract(interval_factor=1.6)
    path = write_model(tmp_path / "pad.onnx", contract)
    pads = {"4": PAD, "6": OTHER}
    runtime = runtime_of(ModelSession(path), pad=pads)
    scans = [make_scan(0, sensor=name, press_counts=press, noise=9) for name, press in (("4", 20_000), ("6", 9000))]
    together = inferred(runtime, scans)
    inferred(runtime, [make_scan(1, sensor=name, press_counts=5000) for name in ("4", "6")])
    for scan, result in zip(scans, together, strict=True):
        alone = runtime_of(ModelSession(path), pad=pads).push(scan)
        for name in ("pattern", "deviation", "traction"):
            assert getattr(result, name).tobytes() == getattr(alone, name).tobytes()
        assert result.wrench == alone.wrench is not None
        assert result.wrench_origin == alone.wrench_origin
    assert [one.wrench_origin for one in together] == ["nominal", "calibrated"]
    assert not np.shares_memory(together[0].traction, together[1].traction)


def test_a_pattern_that_is_given_again_keeps_its_wrench():
    runtime = runtime_of(FakeModel(make_pad_contract()), options=RuntimeOptions())
    first, again = (runtime.push(make_scan(number, press_counts=20_000)) for number in (0, 1))
    assert again.reused_from == 0 and again.wrench == first.wrench is not None
    assert again.traction is first.traction and again.wrench_origin == "nominal"
    dropped = runtime.push(make_scan(2, press_counts=9000), infer=False)
    assert dropped.state == "dropped" and dropped.traction is dropped.wrench is dropped.wrench_origin is None


def test_what_no_pad_has_is_refused():
    no_pads = [{"thickness_mm": 0.0}, {"counts_per_newton": float("nan")}, {"intervals": {"thickness_mm": (5, 4)}}]
    no_gains = [{"gains": (0.0,) * 48}, {"gain_half_widths": (0.02,) * 48}]
    for wrong in [*no_pads, *no_gains, {"gains": GAINED, "gain_half_widths": (1.1,) * 48}]:
        with pytest.raises(ValueError, match="expected"):
            Pad(**wrong)


def test_gains_go_with_their_places_and_axes():
    order = tuple(np.rot90(np.arange(16).reshape(4, 4)).ravel().tolist())
    widths = tuple((np.asarray(GAINED) / 50).tolist())
    turned = replace(PAD, gain_half_widths=widths).turned(Mounting(order=order, swap_xy=True, signs=(-1, 1, 1)))
    assert turned.gains is not None and turned.thickness_mm == 5.0
    for values, moved in ((GAINED, turned.gains), (widths, turned.gain_half_widths)):
        before, after = (np.asarray(one).reshape(3, 16) for one in (values, moved))
        np.testing.assert_array_equal(after, before[[1, 0, 2]][:, list(order)])
    assert Pad().turned(Mounting(order=order)) == Pad()
