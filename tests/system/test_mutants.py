"""The mutation survey, of one mutant."""

import subprocess
import sys

from edge_samples import ROOT


def test_a_survey_of_one_module_is_a_page():
    """python tests/system/mutation_survey.py slcan --mutants 1"""
    command = [sys.executable, "tests/system/mutation_survey.py", "slcan", "--mutants", "1"]
    page = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    assert page.startswith("# ") and "firmware_bridge.can.slcan" in page
