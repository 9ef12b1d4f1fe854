from dataclasses import replace

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from dataset_samples import make_sequences
from onnx import helper
from test_export import frozen_at
from torch import nn

from export.errors import ExportError
from export.graphs.graph import outputs, to_model
from export.graphs.parity import GraphRun
from export.quantisation.fine_tune import FineTuning, fine_tuned, graph_psnr_db, quantised_well, recalibrated
from export.quantisation.int8 import quantised
from export.quantisation.integer_nodes import integer_nodes
from export.quantisation.rounding import folded, integer_convolutions, rounded
from firmware_bridge.pad_geometry import USPA44
from train.data.batch import Batch
from train.data.batches import network_input
from train.learning.interval_calibration import interval_coverage
from train.networks.blocks import PatternNet
from train.networks.registry import build
from train.networks.wu_liu_2024 import SeedNet

STEPS = 30


@pytest.fixture(scope="module")
def taps():
    return make_sequences(count=12, taps=1)


@pytest.fixture(scope="module")
def tuning():
    return FineTuning(STEPS, frozen_at(10, taps=1), learning_rate=1e-3, batch=8)


@pytest.fixture(scope="module")
def windows():
    return torch.randn(64, 3, 4, 4, generator=torch.Generator().manual_seed(0)).numpy()


def seen_of(windows) -> Batch:
    """Return the batch that ranges are taken from; its truth is not used."""
    return Batch(torch.from_numpy(windows), torch.zeros(len(windows), 40, 40))


def compact(seed=0) -> PatternNet:
    torch.manual_seed(seed)
    return folded(build("compact-stsr", 10, channels=16, blocks=1))


@pytest.fixture(scope="module")
def hostile():
    """One channel lives on steps that are coarse for all others: what reads it is scaled down by as much."""
    net = compact()
    first, second = net.trunk[0].body[0], net.trunk[0].body[2]
    with torch.no_grad():
        net.leave[2].bias += 0.05  # or patterns that nobody trained are cut at zero, and there is nothing to lose
        first.weight[0] *= 300
        first.bias[0] *= 300
        second.weight[:, 0] /= 300
    return net


@pytest.fixture(scope="module")
def hostile_graphs(hostile, taps, tuning):
    model = to_model(hostile, USPA44)
    seen = seen_of(network_input(tuning.validation.windows(1)).numpy()[:64])
    return model, quantised(model, seen), seen


def seed_size() -> SeedNet:
    """Return the network of the paper, its batch normalisation as after some training."""
    torch.manual_seed(0)
    net = SeedNet(1, 1)
    for module in net.modules():
        if isinstance(module, nn.BatchNorm2d):
            nn.init.normal_(module.running_mean, 0, 0.1)
            nn.init.uniform_(module.running_var, 0.5, 2)
    return net.eval()


def steps_apart(net, model, integers, windows):
    """Return distances of torch's convolutions from the quantised graph's on equal inputs: steps, by weight."""
    weights = {node.name: node.input[1] for node in model.graph.node if node.op_type == "Conv"}
    convs = {weights[node.name]: node for node in integers.graph.node if node.name in weights}
    opened = onnx.ModelProto.FromString(integers.SerializeToString())
    opened.graph.output.extend(
        helper.make_tensor_value_info(value, onnx.TensorProto.FLOAT, None)
        for value in dict.fromkeys(value for node in convs.values() for value in (node.input[0], node.output[0]))
    )
    options = onnxruntime.SessionOptions()
    options.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_DISABLE_ALL
    session = onnxruntime.InferenceSession(opened.SerializeToString(), options, ["CPUExecutionProvider"])
    names = [output.name for output in session.get_outputs()]
    runs = [dict(zip(names, session.run(None, {"window": window[None]}), strict=True)) for window in windows]
    told = {name: torch.from_numpy(np.concatenate([run[name] for run in runs])) for name in names}
    convolutions, apart = integer_convolutions(model, integers), {}
    with rounded(net, convolutions), torch.inference_mode():
        for name, grids in convolutions.items():
            mine = net.get_submodule(name.removesuffix(".weight"))(told[convs[name].input[0]])
            true = grids.given(told[convs[name].output[0]])
            apart[name] = ((mine - true).abs() / grids.given.scale).numpy()
    return apart


def assert_within_a_step(apart):
    """Values half-way between two steps may go either way, and are few."""
    for name, steps in apart.items():
        assert steps.max() < 1.01 and (steps > 0.5).mean() < 1e-3, name


@pytest.mark.parametrize("every", [False, True])
def test_torch_rounds_as_onnxruntime_does(every, windows):
    net = compact()
    model = to_model(net, USPA44)
    integers = quantised(model, seen_of(windows), every=every)
    convolutions = integer_convolutions(model, integers)
    convs = {node.input[1] for node in model.graph.node if node.op_type == "Conv" and node.name in integer_nodes(model)}
    assert set(convolutions) == ({n.input[1] for n in model.graph.node if n.op_type == "Conv"} if every else convs)
    with rounded(net, convolutions):
        mine = [maps.numpy() for maps in outputs(net, torch.from_numpy(windows))]
    in_float = [maps.numpy() for maps in outputs(net, torch.from_numpy(windows))]
    for level in ("none", "all"):
        for true, rounding, plain in zip(GraphRun(integers, level)(windows), mine, in_float, strict=True):
            # An output that integers do not reach differs by the rounding of float32 alone.
            lost = max(np.abs(true - plain).mean(), 1e-6)
            # A value that lies half-way between two steps may go either way, and takes others along.
            assert np.abs(true - rounding).mean() < lost / 100
            assert (np.abs(true - rounding) > lost / 10).mean() < 1e-2
    assert_within_a_step(steps_apart(net, model, integers, windows))


def test_networks_of_the_paper_round_so_too_once_folded(windows):
    net = folded(seed_size())
    model = to_model(net, USPA44)
    integers = quantised(model, seen_of(windows[:4]))
    apart = steps_apart(net, model, integers, windows[:2])
    assert len(apart) == 37, "all but the last"
    assert_within_a_step(apart)


def test_fine_tuning_wins_back_what_rounding_loses(hostile, hostile_graphs, taps, tuning):
    model, integers, seen = hostile_graphs
    validation = tuning.validation
    in_float_db = graph_psnr_db(model, 1, validation)
    before_db = in_float_db - graph_psnr_db(integers, 1, validation)
    done = quantised_well(hostile, model, USPA44, seen, taps, tuning, before_db - 1e-6)
    now_db = in_float_db - graph_psnr_db(done.integers, 1, validation)
    assert done.trained_on and now_db < before_db
    assert done.said == f"fine-tuned {STEPS} steps: before {before_db:.3f} dB lost in validation, now {now_db:.3f}"
    pattern, deviation, _ = GraphRun(done.integers)(network_input(validation.windows(1)).numpy())
    assert interval_coverage(validation.patterns(), pattern, deviation) == pytest.approx(0.9, abs=0.01)


def test_what_costs_little_is_left_as_it_is(hostile, hostile_graphs, taps, tuning):
    model, integers, seen = hostile_graphs
    for allowed_db, way in ((100.0, tuning), (-100.0, None)):
        done = quantised_well(hostile, model, USPA44, seen, taps, way, allowed_db)
        assert done.net is hostile and not done.trained_on and not done.said
        assert done.integers.SerializeToString() == integers.SerializeToString()


def test_weights_that_are_no_better_are_not_taken(hostile, hostile_graphs, taps, tuning):
    model, integers, seen = hostile_graphs
    bad = replace(tuning, steps=3, learning_rate=1.0)
    done = quantised_well(hostile, model, USPA44, seen, taps, bad, -100.0)
    assert done.net is hostile and not done.trained_on and done.said.endswith(", so not used")
    assert done.integers.SerializeToString() == integers.SerializeToString()


def test_the_same_seed_gives_the_same_plain_weights_and_leaves_the_given_ones(hostile, hostile_graphs, taps, tuning):
    model, integers, _ = hostile_graphs
    given = {name: value.clone() for name, value in hostile.state_dict().items()}
    recipe = replace(tuning, steps=3).recipe(1)
    first, again, other = (fine_tuned(hostile, model, integers, taps, recipe, seed) for seed in (1, 1, 2))
    assert [name for name, _ in first.named_modules()] == [name for name, _ in hostile.named_modules()]
    assert list(first.state_dict()) == list(given) and not first.training
    assert not any(module._forward_hooks or module._forward_pre_hooks for module in first.modules())
    for name, value in first.state_dict().items():
        assert torch.equal(value, again.state_dict()[name])
        assert torch.equal(given[name], hostile.state_dict()[name])
    weight = "trunk.0.body.0.weight"
    assert not torch.equal(first.state_dict()[weight], given[weight])
    assert not torch.equal(first.state_dict()[weight], other.state_dict()[weight])


def test_nothing_stays_rounded_after_an_error(hostile, hostile_graphs):
    model, integers, _ = hostile_graphs
    net = compact()
    window = torch.ones(1, 3, 4, 4)
    before = outputs(net, window)
    with pytest.raises(ZeroDivisionError), rounded(net, integer_convolutions(model, integers)):
        assert not torch.equal(outputs(net, window)[0], before[0])
        raise ZeroDivisionError
    assert torch.equal(outputs(net, window)[0], before[0])
    assert sorted(net.state_dict()) == sorted(hostile.state_dict())


def test_batch_normalisation_is_folded_and_the_same_is_computed():
    net = seed_size()
    plain = folded(net)
    assert not any(isinstance(module, nn.BatchNorm2d) for module in plain.modules())
    assert any(isinstance(module, nn.BatchNorm2d) for module in net.modules())
    window = torch.randn(4, 3, 4, 4)
    (true,), (mine,) = outputs(net, window), outputs(plain, window)
    assert true.max() > 0
    torch.testing.assert_close(mine, true, rtol=1e-4, atol=1e-7)


def test_what_cannot_be_folded_and_what_is_not_of_the_network_is_said(hostile_graphs):
    model, integers, _ = hostile_graphs
    alone = compact()
    alone.trunk.append(nn.Sequential(nn.ReLU(), nn.BatchNorm2d(16)))
    with pytest.raises(ExportError, match=r"trunk\.1\.1 does not follow a convolution"):
        folded(alone)
    with (
        pytest.raises(ExportError, match="does not belong to the network"),
        rounded(seed_size(), integer_convolutions(model, integers)),
    ):
        pass


def test_a_network_without_deviations_has_none_to_calibrate(tuning):
    net = folded(seed_size())
    same = recalibrated(net, onnx.ModelProto(), tuning.validation)
    assert all(torch.equal(value, same.state_dict()[name]) for name, value in net.state_dict().items())
