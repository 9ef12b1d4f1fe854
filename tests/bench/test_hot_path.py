import shutil

import hot_path
import numpy as np
import pytest
from hot_path import ROOT, compare, main, slower

from edge.bench.system import Ratio, ratio_of


def test_a_way_that_takes_longer_than_the_one_before_is_red(tmp_path, monkeypatch, capsys):
    """The tree before is this one, without the work that the change adds to each scan."""
    for package in ("edge", "firmware_bridge"):
        shutil.copytree(ROOT / package, tmp_path / package, ignore=shutil.ignore_patterns("__pycache__"))
    changed = tmp_path / "firmware_bridge/scans/slcan_scans.py"
    text = changed.read_text()
    begin = "        scans: list[Scan] = []\n"
    assert text.count(begin) == 1
    changed.write_text(text.replace(begin, f"{begin}        sum(range(40_000))\n"))
    ratio, took_us = compare(tmp_path, ROOT, pairs=2)["at rest"]
    assert slower(ratio) and took_us > 0
    monkeypatch.setattr(hot_path, "tree_of", lambda commit, folder: ROOT)
    monkeypatch.setattr(hot_path, "compare", lambda tree, before: {"at rest": (ratio, took_us)})
    assert main([]) == 1 and ": more than a tenth slower" in capsys.readouterr().out
    assert not slower(Ratio(1.05, 1.04, 1.06)) and not slower(Ratio(1.2, 0.9, 1.4))


def test_a_commit_that_cannot_be_run_is_named_and_is_not_red(capsys):
    assert main(["no-such-commit"]) == 0
    assert "no-such-commit: fatal" in capsys.readouterr().out


def test_pairs_are_drawn_together_so_that_what_meets_both_cancels():
    weather = np.random.default_rng(3).uniform(1, 3, 30)
    paired = ratio_of(2 * weather, weather)
    assert (paired.ratio, paired.low, paired.high) == pytest.approx((2, 2, 2)) and str(paired) == "2 (2..2)"


def test_an_interval_holds_the_truth_about_as_often_as_it_says():
    rng = np.random.default_rng(4)
    found = [ratio_of(rng.normal(12, 1, 30), rng.normal(10, 1, 30)) for _ in range(60)]
    assert 50 <= sum(one.low <= 1.2 <= one.high for one in found) < 60


def test_blocks_that_cannot_be_compared_are_refused():
    with pytest.raises(ValueError, match="3 blocks over 2"):
        ratio_of([1, 2, 3], [1, 2])
    with pytest.raises(ValueError, match="0 blocks over 0"):
        ratio_of([], [])
