"""Samples for the experiments' tests: one quick workbench, so that datasets and networks are made once a session."""

import pytest

from train.experiments.support.workbench import Workbench


def quick_bench(tmp_path_factory: pytest.TempPathFactory) -> Workbench:
    folder = tmp_path_factory.getbasetemp() / "quick"
    return Workbench(folder / "data", folder / "checkpoints", quick=True)
