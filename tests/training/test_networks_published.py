import pytest
import torch

from train.experiments.support.workbench import macs, parameters_count
from train.networks.published import SeedNet
from train.networks.registry import build, grown
from train.networks.symmetric import write_out

PUBLISHED = {
    "srcnn": (4.36, 6.96),
    "stsr": (4.584, 7.32),
    "mtsr2": (4.659, 7.44),
    "mtsr4": (4.811, 7.68),
    "mtsr5": (4.886, 7.81),
    "mtsr7": (5.038, 8.05),
}


def window(taps, count=2, seed=0):
    return torch.randn(count, 3 * taps, 4, 4, generator=torch.Generator().manual_seed(seed))


@pytest.fixture(scope="module")
def stsr():
    torch.manual_seed(0)
    return SeedNet(1, 2)


def mtsr_of(stsr, taps):
    net = SeedNet(taps, stsr.scale)
    net.take_over(stsr)
    return net


@pytest.mark.parametrize("name", PUBLISHED)
def test_parameters_and_macs_are_the_published_ones(name):
    millions, giga_macs = PUBLISHED[name]
    net = build(name, 10)
    digits = 2 if name.startswith("sr") else 3
    assert round(parameters_count(net) / 1e6, digits) == millions
    assert macs(net) / 1e9 == pytest.approx(giga_macs, abs=0.007)


@pytest.mark.parametrize(("name", "scale"), [("stsr", 4), ("mtsr3", 2), ("srcnn", 3), ("mtsr7", 1)])
def test_patterns_have_the_pattern_size_at_any_scale(name, scale):
    net = build(name, scale).eval()
    assert net.scale == scale
    with torch.inference_mode():
        pattern = net(window(net.taps))
    assert pattern.shape == (2, 4 * scale, 4 * scale)
    assert pattern.min() >= 0


def test_all_of_an_mtsr_trains_and_nothing_of_its_stsr(stsr):
    before = {name: value.clone() for name, value in stsr.state_dict().items()}
    mtsr = mtsr_of(stsr, 2).train()
    start = {name: value.clone() for name, value in mtsr.named_parameters()}
    optimizer = torch.optim.Adam(mtsr.parameters(), lr=1e-2)
    for seed in range(2):
        optimizer.zero_grad()
        (mtsr(window(2, 4, seed)) - 0.2).square().mean().backward()
        optimizer.step()
    assert {name for name, value in mtsr.named_parameters() if torch.equal(value, start[name])} == set()
    assert all(torch.equal(value, before[name]) for name, value in stsr.state_dict().items())


@pytest.mark.parametrize(("taps", "scale", "said"), [(0, 2, "1 to 7"), (8, 2, "1 to 7"), (1, 0, "at least 1")])
def test_what_is_out_of_range_is_refused(taps, scale, said):
    with pytest.raises(ValueError, match=said):
        SeedNet(taps, scale)


@pytest.mark.parametrize("name", ["stsr", "mtsr2", "srcnn", "compact-stsr"])
def test_every_network_learns_in_low_precision(name):
    torch.manual_seed(2)
    net = build(name, 2).train()
    with torch.autocast("cpu", dtype=torch.bfloat16):
        output = net(window(net.taps, 3))
        patterns = output[0] if isinstance(output, tuple) else output
        assert patterns.dtype == torch.float32
        (patterns - 0.1).abs().mean().backward()
    # The deviation of a compact network teaches nothing else, and neither it nor the traction was asked for.
    gradients = [value.grad for key, value in net.named_parameters() if not key.startswith(("uncertainty", "traction"))]
    assert all(gradient is not None and torch.isfinite(gradient).all() for gradient in gradients)


def test_an_unknown_name_is_refused_with_the_known_ones():
    with pytest.raises(ValueError, match=r"no network 'mtsr8', expected one of srcnn, .*compact-mtsr7"):
        build("mtsr8", 10)


@pytest.mark.parametrize(
    ("start", "name", "scale"),
    [("stsr", "mtsr3", 3), ("mtsr2", "mtsr2", 2), ("stsr", "stsr", 1)],
)
def test_a_network_grown_from_another_computes_the_same(start, name, scale):
    torch.manual_seed(4)
    old = build(start, scale).eval()
    net = grown(old, name, scale).eval()
    given = window(net.taps)
    with torch.inference_mode():
        assert torch.allclose(net(given), old(given[:, : 3 * old.taps]), atol=1e-6)
        next(net.parameters()).zero_()
    assert next(old.parameters()).abs().max() > 0


def test_at_another_scale_a_compact_network_keeps_all_but_what_makes_pixels():
    torch.manual_seed(6)
    old = build("compact-mtsr2", 4, channels=16, blocks=1)
    net = grown(old, "compact-mtsr2", 10, channels=16, blocks=1)
    assert net(window(2))[0].shape == (2, 40, 40)
    before = write_out(old).state_dict()
    changed = {key for key, value in write_out(net).state_dict().items() if not torch.equal(value, before[key])}
    assert changed == {f"{end}.{part}" for end in ("leave.2", "uncertainty.2") for part in ("weight", "bias")}


@pytest.mark.parametrize(("start", "name"), [("stsr", "srcnn"), ("mtsr2", "mtsr3"), ("stsr", "compact-stsr")])
def test_weights_that_do_not_fit_are_refused(start, name):
    with pytest.raises(ValueError, match=f"{name} at scale 2 cannot start from a SeedNet of"):
        grown(build(start, 2), name, 2)
