"""The wide frozen set, and presses as sensors with gains of their own read them."""

import numpy as np
import pytest
from edge_samples import make_pad_contract
from press_samples import make_press_set

from train.data.frozen_presses import load_frozen_presses, main
from train.families.catalogue import SHARES
from train.physics.pad_draws import KNOWN, input_scale

WIDE_SHA256 = "edeb2202b59f15f51a49c3e5c96b8a1d752b877ffb50361257bf527b2cbedac2"


@pytest.fixture(scope="module")
def wide():
    return load_frozen_presses()


def test_the_wide_set_is_the_one_that_figures_are_of(wide):
    assert wide.presses.sha256() == WIDE_SHA256
    assert set(wide.presses.family) == set(SHARES) and len(np.unique(wide.presses.pad)) == 126
    assert min(np.unique(wide.presses.family, return_counts=True)[1]) >= 30


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
    make_press_set(6).save(tmp_path / "presses.npz")
    main([str(tmp_path / "presses.npz"), str(tmp_path / "frozen.npz")])
    assert load_frozen_presses(tmp_path / "frozen.npz").presses.sha256() in capsys.readouterr().out
    with pytest.raises(SystemExit, match=r"^frozen_presses: .*no such file"):
        main([str(tmp_path / "absent.npz"), str(tmp_path / "frozen.npz")])
