"""The wide frozen set, and presses as sensors with gains of their own read them."""

from dataclasses import replace

import numpy as np
import pytest
from edge_samples import make_pad_contract

from train.data.frozen_presses import freeze_presses, load_frozen_presses, main
from train.data.presses import PressSet
from train.families.catalogue import SHARES
from train.freeze import fit_classical, fit_taxels
from train.physics.pad_draws import INPUTS, KNOWN, input_scale
from train.physics.sensor_noise import Nuisances

WIDE_SHA256 = "edeb2202b59f15f51a49c3e5c96b8a1d752b877ffb50361257bf527b2cbedac2"


@pytest.fixture(scope="module")
def wide():
    return load_frozen_presses()


def a_few(n=6, taps=2) -> PressSet:
    rng = np.random.default_rng(1)
    return PressSet(
        family=np.array(["paper"] * n),
        pad=np.arange(n),
        constants=rng.uniform(-1, 1, (n, len(INPUTS))).astype(np.float32),
        counts=rng.uniform(300, 1200, (n, taps, 3, 4, 4)).astype(np.float32),
        angle_deg=np.zeros((n, taps), dtype=np.float32),
        poses=np.zeros((n, taps, 3), dtype=np.float32),
        patterns=rng.uniform(0, 0.3, (n, 40, 40)).astype(np.float16),
        touching=np.ones((n, 40, 40), dtype=bool),
        traction_kpa=np.ones((n, 3, 8, 8), dtype=np.float16),
        force_n=np.ones((n, 3), dtype=np.float32),
        twist_nmm=np.zeros(n, dtype=np.float32),
        indentation_mm=np.full(n, 0.3, dtype=np.float32),
    )


def test_the_wide_set_is_the_one_that_figures_are_of(wide):
    assert wide.presses.sha256() == WIDE_SHA256
    assert set(wide.presses.family) == set(SHARES) and len(np.unique(wide.presses.pad)) == 126
    assert min(np.unique(wide.presses.family, return_counts=True)[1]) >= 30


def test_known_gains_leave_what_the_chips_would_read_without(tmp_path):
    presses = a_few()
    frozen = freeze_presses(presses, 3, replace(Nuisances.none(), gain_spread=0.075))
    known, unknown = (frozen.windows(2, gains_known=known) for known in (True, False))
    assert known == pytest.approx(presses.counts, abs=1.2)  # rounded before and after the gain
    assert np.abs(unknown / presses.counts - 1).max() > 0.05
    frozen.presses.save(tmp_path / "frozen.npz")
    assert np.array_equal(load_frozen_presses(tmp_path / "frozen.npz").gains, frozen.gains)


def test_a_pad_as_a_sensor_file_holds_it_is_the_one_that_networks_are_trained_with(wide):
    """The contract's row of a `firmware_bridge.scans.pad_constants.Pad` is what `FrozenPresses.pads` gives."""
    contract = make_pad_contract(pad_inputs=tuple(input_scale()))
    rows = wide.pads(known=True)
    assert rows.shape == (len(wide), KNOWN)
    for index in (0, 500, 1100):
        assert contract.pad_row(wide.pad(index, gains=True)) == pytest.approx(rows[index], abs=1e-5)
        assert contract.pad_row(wide.pad(index))[-1] == 0
    assert not wide.pads(known=False).any()


def test_it_is_written_by_one_command(tmp_path, capsys):
    a_few().save(tmp_path / "presses.npz")
    main([str(tmp_path / "presses.npz"), str(tmp_path / "frozen.npz")])
    assert load_frozen_presses(tmp_path / "frozen.npz").presses.sha256() in capsys.readouterr().out
    with pytest.raises(SystemExit, match=r"^frozen_presses: .*no such file"):
        main([str(tmp_path / "absent.npz"), str(tmp_path / "frozen.npz")])


def test_classical_methods_and_taxels_are_fitted_on_presses_too():
    presses = a_few(40, 1)
    presses.patterns[:] = (presses.counts[:, 0, 2, :1, :1] / 4000).astype(np.float16)  # flat, by the first taxel's z
    fitted = fit_classical(presses, 40)
    assert fitted["linear_map"].shape == (48, 1600) and fitted["bilinear_gain"] > 0
    assert fit_taxels(presses, 40)["covariances"].shape[1:] == (48, 48)
