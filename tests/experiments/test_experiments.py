"""Every experiment runs, in miniature, and leaves a page with its tables."""

import pytest
from experiment_samples import quick_bench, tables_of

from train.experiments.__main__ import main, run
from train.experiments.paper_tables import HELD_OUT, training_sets

# Number of tables of each experiment that needs no recordings.
TABLES = dict.fromkeys(("table3", "table4", "angle", "taps", "unseen", "pads", "nonnegative", "fig7"), 1)
TABLES |= {"families": 3, "posed-taps": 5, "second-world": 3, "blind-sensors": 2}


@pytest.mark.parametrize(
    "name", [name if name.startswith("fig") else pytest.param(name, marks=pytest.mark.night) for name in TABLES]
)
def test_it_runs_in_miniature(tmp_path, tmp_path_factory, name):
    page = run(name, quick_bench(tmp_path_factory), tmp_path)
    assert page.read_text().startswith(f"# {name}\n")
    tables = tables_of(page)
    assert len(tables) == TABLES[name] and all(len(rows[0]) > 1 for rows in tables)


@pytest.mark.night
def test_training_sets_keep_to_their_names(tmp_path_factory):
    sets = training_sets(quick_bench(tmp_path_factory))
    surfaces = {name: set(data.family.tolist()) for name, (_, data) in sets.items()}
    assert [name for name, there in surfaces.items() if there & set(HELD_OUT)] == ["18 + figures"]
    assert surfaces["15 + figures"] - surfaces["15"] == {"glyph", "polygon"}
    assert surfaces["18 + figures"] == surfaces["15 + figures"] | set(HELD_OUT)


def test_a_folder_without_recordings_is_named_first(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("TACTILE_RECORDINGS", str(tmp_path / "none"))
    with pytest.raises(SystemExit, match=r"^experiments: .*TACTILE_RECORDINGS"):
        main(["real"])
    assert not (tmp_path / "data").exists()
