"""The mutator of the mutation survey."""

import ast
import subprocess
import sys

from edge_samples import ROOT
from mutants import mutants

SOURCE = '''"""Words."""
LIMIT: int = 5

def close(values: list[int], most: int = 2) -> bool:
    """Words."""
    if not values:
        raise ValueError(f"{len(values) + 1} values")
    total = sum(values) - min(values)
    return total <= most and len(values) > 1
'''


def test_every_place_that_decides_is_changed_and_no_word_is():
    names = {mutant.name for mutant in mutants(ast.parse(SOURCE))}
    assert names == {
        "LIMIT: 5 -> 6",
        "close: 2 -> 3",
        "close: if not values: -> if not not values:",
        "close: not values -> values",
        "close: raise ValueError(f'{len(values) + 1} values') -> pass",
        "close: sum(values) - min(values) -> sum(values) + min(values)",
        "close: min(values) -> max(values)",
        "close: return total <= most and len(values) > 1 -> return None",
        "close: total <= most and len(values) > 1 -> total <= most or len(values) > 1",
        "close: total <= most -> total < most",
        "close: len(values) > 1 -> len(values) >= 1",
        "close: 1 -> 2",
    }


def test_a_survey_of_one_module_is_a_page():
    """python tests/system/mutation_survey.py slcan --mutants 1"""
    command = [sys.executable, "tests/system/mutation_survey.py", "slcan", "--mutants", "1"]
    page = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    assert page.startswith("# ") and "firmware_bridge.can.slcan" in page
