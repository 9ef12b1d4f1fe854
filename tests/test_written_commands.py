"""Commands that README.md and the Makefile give are commands that there are."""

import importlib
import re

import pytest
from edge_samples import ROOT

WRITTEN = {
    (source, module)
    for source in ("README.md", "Makefile")
    for module in re.findall(
        r"python\s+-m\s+((?:edge|export|firmware_bridge|train)\.[\w.]*\w)", (ROOT / source).read_text()
    )
}


def test_they_were_found():
    assert {("README.md", "train.fit"), ("Makefile", "export.to_onnx")} <= WRITTEN


@pytest.mark.parametrize(("source", "module"), sorted(WRITTEN))
def test_a_module_has_its_command_line_and_help(source, module, capsys):
    package = hasattr(importlib.import_module(module), "__path__")
    with pytest.raises(SystemExit) as left:
        importlib.import_module(f"{module}.__main__" if package else module).main(["--help"])
    assert left.value.code == 0
    assert f"python -m {module}" in capsys.readouterr().out
