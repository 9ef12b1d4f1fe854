"""Stiff and extreme cases of the bundled graphs, and of the program from raw counts to records."""

import numpy as np
import pytest

from edge.api import infer
from edge.errors import WindowError
from edge.inference.bundled import DEFAULT_MODEL, POSED_MODEL, bundled_models, find_model
from edge.inference.intervals import doubt
from edge.inference.onnx_session import ModelSession
from edge.perception.trust_check import PatternCheck
from export.parity import FULL_RANGE_COUNTS, extreme_windows
from firmware_bridge.scans.pad_constants import Pad
from firmware_bridge.scans.scan import ABSENT
from train.physics.pad_draws import RANGES

MOST_MM = 5.0
"""Bound of a pattern and its deviation: the pad is 4.5 mm thick."""
NO_TOUCH = ("zeros", "denormals", "a count in one taxel")
PRESS, LARGEST = 3000, 65_535
REST = np.broadcast_to(np.array([16_000, 16_400, 38_600])[:, None, None], (3, 4, 4))


def largest(session, window, pad=None):
    """The largest value of a pattern and its deviation, which is finite and above zero, and the pattern."""
    pattern = session.run(window, session.contract.pad_row(pad)).copy()
    assert np.isfinite(pattern).all() and np.isfinite(session.deviation).all() and (session.deviation > 0).all()
    return max(float(np.abs(pattern).max()), float(session.deviation.max())), pattern


@pytest.mark.parametrize("path", bundled_models(), ids=lambda path: path.stem)
def test_no_window_of_a_graph_is_without_bound_or_believed(path):
    one = ModelSession(path)
    contract, trust = one.contract, one.contract.read_trust()
    shape = (contract.taps, 3, 4, 4)
    press, tangential = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    press[:, 2, 1:3, 1:3], tangential[:, :2] = PRESS, FULL_RANGE_COUNTS
    opposite = press * np.where(np.arange(shape[0]) % 2, -1, 1)[:, None, None, None].astype(np.float32)
    counts = {f"press x {scale:g}": press * np.float32(scale) for scale in (1e-6, 1e-3, 1, 1e3, 1e6)}
    counts |= {"tangential": tangential, "earlier taps opposite": opposite}
    beyond = {name: window.reshape(shape) for name, window in extreme_windows(contract).items()}
    for name, window in (beyond | {name: contract.scale_window(of) for name, of in counts.items()}).items():
        size_mm, pattern = largest(one, window)
        assert size_mm <= MOST_MM * max(1, np.abs(window).max()), "patterns grow with the readings, no further"
        touch = name.endswith("taps") or name in ("press x 1e-06", "press x 0.001", "press x 1")
        if name in beyond and not touch and name not in NO_TOUCH:
            about = doubt(pattern, one.deviation)[0]
            assert (
                PatternCheck(trust, contract).judge(0, window[0], pattern, about, one.traction, 0).trusted is not True
            )
    for pads in ((0, 1), (1, 0)):  # the softest and the stiffest: a thick pad is soft
        names = [name for name, *_ in contract.pad_inputs]
        pad = Pad(**{name: RANGES[name][pads[name == "thickness_mm"]] for name in names})
        assert largest(one, contract.scale_window(press), pad)[0] <= MOST_MM
    for bad in (np.nan, np.inf):
        press[0, 2, 1, 1] = bad
        with pytest.raises(WindowError, match="not finite"):
            one.run(press)


def pressed(counts, taxels=(slice(1, 3), slice(1, 3))):
    raw = REST.copy()
    raw[(2, *taxels)] += counts
    return raw


def spoiled(value):
    raw = pressed(PRESS)
    raw[:, 0, 0] = value
    return raw


NEIGHBOURS = np.where(np.indices((4, 4)).sum(axis=0) % 2, 0, LARGEST) + 0 * REST
SCANS = {
    "a press": (pressed(PRESS), True),
    "26000 counts in every taxel": (pressed(26_000, (slice(4), slice(4))), True),
    "tangential alone": (REST + np.array([15_000, -15_000, 0])[:, None, None], True),
    "one taxel": (pressed(PRESS, (3, 3)), True),
    "a chip sends nothing": (spoiled(ABSENT), True),
    "a chip at its end": (spoiled(LARGEST), True),
    "neighbours at both ends": (NEIGHBOURS, False),
    "all at zero": (0 * REST, False),
    "all at the largest": (0 * REST + LARGEST, False),
}
NOISE = np.arange(40)[:, None, None, None] % 2  # a taxel without noise is stuck


@pytest.fixture(scope="module", params=[DEFAULT_MODEL, POSED_MODEL])
def session(request):
    return ModelSession(find_model(request.param))


@pytest.mark.parametrize("name", SCANS)
def test_a_broken_chip_or_bus_makes_no_pattern_without_bound(session, name):
    raw, known = SCANS[name]
    touched = np.where((raw <= 0) | (raw == LARGEST), raw, raw + NOISE)  # a saturated one has none, nor an absent one
    results = infer(session, np.concatenate([REST + NOISE[:30], touched]), REST + NOISE[:30])[40:]
    made = [result for result in results if result.pattern is not None]
    assert known or not made
    for result in made:
        assert np.isfinite(result.pattern).all() and np.isfinite(result.deviation).all()
        assert max(np.abs(result.pattern).max(), result.deviation.max()) <= MOST_MM


@pytest.mark.parametrize("rest", [0, 1, LARGEST - 1, LARGEST])
def test_a_free_pad_whose_counts_wrap_around_is_idle(session, rest):
    counts = (np.full((40, 3, 4, 4), rest) + NOISE) % (LARGEST + 1)
    assert {result.state for result in infer(session, counts, np.full((1, 3, 4, 4), rest))} == {"idle"}
