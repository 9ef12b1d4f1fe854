"""Intervals as a step of export: in the graph, in the contract, and of the graph in integers."""

import numpy as np
import onnx
import pytest
import torch
from interval_samples import LEVEL, PRESSES, export_with_intervals, some_frames

from edge.evaluation.evaluate import infer_all
from edge.inference.intervals import regions
from edge.inference.onnx_session import ModelSession
from export.graphs.reference import network_of, origin_of
from export.to_onnx import export, main
from train.learning.interval_calibration import half_width_mm
from train.learning.interval_fit import readings_of_presses
from train.networks.compact import CompactNet


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("intervals")
    export_with_intervals(folder)
    return folder


@pytest.mark.parametrize("name", ["one", "one-int8"])
@pytest.mark.parametrize("given", [1, 2])
def test_intervals_hold_on_the_presses_that_set_them(folder, name, given):
    session = ModelSession(folder / f"{name}.onnx")
    held: dict[int, list[bool]] = {}
    for one in readings_of_presses(PRESSES, 2):
        for window, pad, truth in zip(one.with_taps(given), one.pads, one.truth, strict=True):
            pattern = session.run(window.reshape(2, 3, 4, 4), pad)
            region = regions(pattern[None], LEVEL, 4)[0]
            inside = np.abs(pattern - truth) <= half_width_mm(session.deviation)
            for number in np.unique(region):
                held.setdefault(int(number), []).extend(inside[region == number].tolist())
    assert len(held) > 1
    assert [float(np.mean(share)) for share in held.values()] == pytest.approx([0.9] * len(held), abs=0.02)


@pytest.mark.parametrize("name", ["one", "one-int8"])
def test_the_contract_tells_the_levels(folder, name):
    levels = ModelSession(folder / f"{name}.onnx").contract.interval_levels
    assert list(levels) == ["50", "80", "90", "95"]
    assert all(low <= high for low, high in zip(levels["50"], levels["95"], strict=True))


def test_the_network_of_the_graph_has_the_correction(folder):
    model = onnx.load(folder / "one.onnx")
    net = network_of(model)
    assert origin_of(model)["options"]["intervals"] is True
    assert isinstance(net, CompactNet) and net.intervals is not None
    frozen, session = some_frames(), ModelSession(folder / "one.onnx")
    windows = torch.from_numpy(np.stack([session.contract.scale_window(one) for one in frozen.windows(2)[::20]]))
    deviations = net(windows.flatten(1, 2))[1].detach().numpy()
    for window, expected in zip(windows.numpy(), deviations, strict=True):
        session.run(window)
        np.testing.assert_allclose(session.deviation, expected, rtol=1e-4)


def test_the_pattern_is_the_same_with_and_without(folder, tmp_path):
    frozen = some_frames()
    export(folder / "one.pt", tmp_path, frozen)
    found = [ModelSession(place / "one.onnx") for place in (folder, tmp_path)]
    one, other = (infer_all(session.run, session.contract, frozen) for session in found)
    np.testing.assert_allclose(one, other, atol=1e-7)
    assert found[1].contract.interval_levels == {}


def test_training_presses_without_validation_are_a_usage_error():
    with pytest.raises(SystemExit) as end:
        main(["one.pt", "--intervals", "x.npz"])
    assert end.value.code == 2
