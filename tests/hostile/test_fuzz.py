"""A short run of what `python tests/system/fuzz.py` does at length: by chance, without a guide, the same every time."""

import ast

import pytest
from edge_samples import ROOT
from fuzz import run_blind
from fuzz_targets import TARGETS

INPUTS = 300


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("name", TARGETS)
def test_whatever_comes_a_parser_keeps_its_promise(name):
    run_blind(name, INPUTS, seed=8)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("name", TARGETS)
def test_what_is_begun_with_is_kept_too(name):
    for seed in TARGETS[name].seeds():
        assert 0 < len(seed) <= TARGETS[name].longest, "what is longer is cut, and no valid input any more"
        TARGETS[name].run(seed)


LOADERS = {"numpy.load": ("allow_pickle", False), "torch.load": ("weights_only", True)}


def test_nothing_is_loaded_that_could_run():
    calls = 0
    for path in (
        path for package in ("edge", "firmware_bridge", "train", "export") for path in (ROOT / package).rglob("*.py")
    ):
        name = str(path.relative_to(ROOT))
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Call) and (key := ast.unparse(node.func).replace("np.", "numpy.")) in LOADERS:
                calls += 1
                option, value = LOADERS[key]
                told = {word.arg: ast.unparse(word.value) for word in node.keywords}
                assert told.get(option) == str(value), f"{name}:{node.lineno}: {key} without {option}={value}"
            imported = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            assert not {"pickle", "marshal", "shelve", "dill", "joblib.load"} & set(imported), name
    assert calls >= 4
