"""What the runtime really loads, in a process of its own."""

import subprocess
import sys

from edge_samples import ROOT

FORBIDDEN = {"torch", "onnx", "trimesh", "scipy", "shapely", "skimage", "pytest", "hypothesis"}


def loaded(*modules: str) -> set[str]:
    script = f"import sys, {', '.join(modules)}; print(*sys.modules, sep='\\n')"
    done = subprocess.run(
        [sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, check=True, timeout=120
    )
    return {name.partition(".")[0] for name in done.stdout.split()}


def test_the_runtime_loads_no_training_library():
    modules = [
        ".".join(path.relative_to(ROOT).with_suffix("").parts)
        for package in ("edge", "firmware_bridge")
        for path in sorted((ROOT / package).rglob("*.py"))
        if path.stem != "__init__"
    ]
    assert {"edge.cli", "edge.session", "edge.demo", "firmware_bridge.emulator"} <= set(modules)
    assert not loaded(*modules) & FORBIDDEN


def test_contract_and_cli_load_no_onnxruntime():
    assert "onnxruntime" not in loaded("edge.contract", "edge.cli", "edge.runtime", "edge.pump", "edge.sinks.forms")
