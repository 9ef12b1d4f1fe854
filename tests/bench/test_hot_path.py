import shutil

import hot_path
from hot_path import ROOT, compare, main, slower

from edge.bench.ratios import Ratio


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
    assert "no-such-commit cannot be compared with: fatal" in capsys.readouterr().out
