"""Reports of the shipped models on other pads, families and taps: their parts, and their pages in miniature."""

import csv
from dataclasses import replace

import numpy as np
import pytest
from edge_samples import make_pad_contract, write_model
from experiment_samples import quick_bench

from train.data.frozen_presses import load_frozen_presses
from train.experiments.sensor import pads, shipped
from train.physics.pad_draws import NOMINAL


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    """Workbench with a model that makes squares of taxels, with pad, traction and intervals."""
    folder = tmp_path_factory.mktemp("models")
    levels = {"90": [1.6] * 4}
    contract = make_pad_contract(taps=1, output_full_scale=0.5, interval_factor=1.6, interval_levels=levels)
    write_model(folder / "stsr-int8.onnx", contract)
    return replace(quick_bench(tmp_path_factory), models=folder)


@pytest.fixture(scope="module")
def few():
    return load_frozen_presses().pick(np.arange(5))


def rows_of(path):
    with path.open() as file:
        return list(csv.DictReader(file))


def test_readings_are_divided_by_gains_and_the_pad_enters_where_they_are_known(bench, few):
    model = bench.model()
    found = {known: shipped.infer_presses(model, few, known).patterns for known in (shipped.NOTHING, shipped.ALL)}
    known = [few.pad(index, gains=True) for index in range(5)]
    scaled = [model.contract.scale_window(window) for window in few.windows(1, gains_known=True)]
    by_hand = [model.run(one, model.contract.pad_row(pad)).copy() for one, pad in zip(scaled, known, strict=True)]
    assert found[shipped.ALL] == pytest.approx(np.stack(by_hand), rel=1e-5)
    assert not np.allclose(found[shipped.NOTHING], found[shipped.ALL])


def test_one_constant_of_a_pad_is_off():
    assert pads.OffPad("thickness_mm", -10).pad == replace(NOMINAL, thickness_mm=NOMINAL.thickness_mm * 0.9)
    assert pads.OffPad("free_sides", 20).pad.free_sides == pytest.approx(0.2)
    assert pads.NONE_OFF.pad == NOMINAL
    assert not pads.OffPad("poisson", 20).can_be and not pads.OffPad("free_sides", -5).can_be
    assert pads.OffPad("poisson", 10).can_be
