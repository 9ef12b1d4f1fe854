"""Both wheels as a release has them: the runtime in an environment that holds nothing else, then both.

And, by night, README's two commands and six ways, typed literally in a bare clone and empty environments, as a new user
does; they fetch gigabytes: `pytest -m night -s tests/system/test_wheel.py` prints how long each line took.
"""

import json
import os
import re
import signal
import subprocess
import sys
import time
import venv
import zipfile
from pathlib import Path

import pytest
import trimesh
from edge_samples import ROOT

from edge import __version__
from edge.cli.main import COMMANDS, main

OURS = {"edge", "firmware_bridge", "train", "export"}
ANY_LICENCE = "Apache License\n                           Version 2.0, January 2004"
IN_THE_WHEEL = {"edge", "firmware_bridge"}
INSTALL = ("install", "--quiet", "--no-compile")
NOT_IN_THE_RUNTIME = {"torch", "onnx", "onnxscript", "trimesh", "scipy", "shapely"}


@pytest.fixture(scope="module")
def wheels(tmp_path_factory):
    """Paths of the runtime's wheel and of the second one, made by the command of a release."""
    folder = tmp_path_factory.mktemp("dist")
    made = run([sys.executable, str(ROOT / "release/wheels.py"), str(folder)], PYTHONPATH=str(ROOT)).splitlines()
    assert {Path(path) for path in made} == set(folder.iterdir())
    return made


@pytest.fixture(scope="module")
def fresh(tmp_path_factory, wheels):
    """Folder bin of a new environment with the runtime's wheel and its dependencies."""
    folder = tmp_path_factory.mktemp("wheel") / "env"
    venv.create(folder)
    pip(folder, *INSTALL, wheels[0], PIP_CONSTRAINT=str(ROOT / "constraints.txt"))
    return folder / "bin"


@pytest.fixture(scope="module")
def both(fresh, wheels):
    """The same environment with the second wheel as well, without torch and the like: used by the last tests alone."""
    pip(fresh.parent, *INSTALL, "--no-deps", wheels[1])
    return fresh


def pip(environment, *words, **variables):
    """Run the pip of this environment on another one: to install one there takes longer than all that follows."""
    command = [sys.executable, "-m", "pip", "--disable-pip-version-check", "--python", str(environment)]
    return run([*command, *words], **variables)


def ended(folder, *command, **environment):
    """Run a command in a folder to its end, without PYTHONPATH: a checkout on it would lend what the wheel lacks."""
    variables = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"} | environment
    settings = {"stdin": subprocess.DEVNULL, "capture_output": True, "text": True, "timeout": 240}
    return subprocess.run(list(map(str, command)), cwd=folder, env=variables, **settings)


def run(command, **environment):
    done = ended(None, *command, **environment)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_it_holds_the_runtime_alone_with_types_for_a_checker(fresh, tmp_path):
    installed = {package["name"].lower() for package in json.loads(pip(fresh.parent, "list", "--format", "json"))}
    assert "tactile-edge-sr" in installed and not NOT_IN_THE_RUNTIME & installed
    (packages,) = fresh.parent.glob("lib/python*/site-packages")
    assert {path.name for path in packages.iterdir()} & OURS == IN_THE_WHEEL
    assert {path.parent.name for path in packages.glob("*/py.typed") if path.parent.name in OURS} == IN_THE_WHEEL
    assert not (packages / "edge" / "bench").exists()
    emulation = {path.stem for path in (packages / "firmware_bridge" / "emulation").glob("[!_]*.py")}
    assert emulation == {"pty_port", "slcan_emulator"}, "what the demo needs"
    assert {path.name for path in (packages / "edge" / "models").iterdir()} == {
        *("mtsr-int8.onnx", "stsr-int8.onnx", "stsr-small-int8.onnx"),
        *("contacts.npz", "demo.npz", "grip.npz", "taxels.npz"),
    }
    done = ended(tmp_path, fresh / "edge-sr", "bench")
    line = "edge-sr: edge-sr bench is in another wheel, which is not installed: install tactile-edge-sr-train as well"
    assert (done.returncode, done.stdout, done.stderr.splitlines()) == (2, "", [line])


def test_licence_and_version_are_in_the_wheel(fresh):
    (about,) = fresh.parent.glob("lib/python*/site-packages/tactile_edge_sr-*.dist-info")
    assert ANY_LICENCE in (about / "licenses/LICENSE").read_text()
    metadata = (about / "METADATA").read_text()
    assert "\nLicense-Expression: Apache-2.0\n" in metadata and f"\nVersion: {__version__}\n" in metadata
    assert f"\n## {__version__}" in (ROOT / "docs/changelog.md").read_text()
    assert run([str(fresh / "edge-sr"), "--version"]) == f"edge-sr {__version__}\n"


@pytest.mark.parametrize(
    ("typed", "offered"),
    [
        ("edge-sr re", {"record", "replay"}),
        ("edge-sr doctor --no", {"--no-press"}),
        ("edge-sr --model stsr-s", {"stsr-small", "stsr-small-int8"}),
        ("edge-sr replay pre", {"press.mcap"}),
    ],
)
def test_bash_completes(fresh, tmp_path, typed, offered):
    (tmp_path / "press.mcap").touch()
    words = " ".join(f"'{word}'" for word in typed.split())
    last = len(typed.split()) - 1
    program = f"""
cd '{tmp_path}'; complete() {{ [[ "$*" == *" edge-sr" ]] && completer=${{@: -2:1}}; }}
. '{fresh.parent}/share/bash-completion/completions/edge-sr'
COMP_WORDS=({words}); COMP_CWORD={last}
$completer edge-sr "${{COMP_WORDS[{last}]}}"
printf '%s\\n' "${{COMPREPLY[@]}}"
"""
    assert set(run(["bash", "--norc", "-c", program]).split()) == offered


def test_the_man_page_has_every_command_and_option(fresh, capsys):
    page = (fresh.parent / "share/man/man1/edge-sr.1").read_text()
    requests = {line.split()[0] for line in page.splitlines() if line.startswith(".")}
    known = {".TH", ".SH", ".SS", ".B", ".TP", ".nf", ".fi", ".br", ".sp", r".\""}
    assert requests <= known, "a word in their place"
    plain = page.replace("\\-", "-")
    for name in COMMANDS:
        assert f"edge-sr {name}" in plain
        with pytest.raises(SystemExit, match="0"):
            main([name, "--help"])
        assert all(one in plain for one in re.findall(r"^  (--[a-z-]+)", capsys.readouterr().out, re.MULTILINE))
    assert (fresh.parent / "share/zsh/site-functions/_edge-sr").read_text().startswith("#compdef edge-sr")


def test_both_wheels_together_are_the_packages_of_a_checkout(wheels):
    held = [set(zipfile.ZipFile(path).namelist()) for path in wheels]
    of_packages = [{name for name in names if name.partition("/")[0] in OURS} for names in held]
    assert not of_packages[0] & of_packages[1]
    kept = subprocess.run(["git", "ls-files", *sorted(OURS)], cwd=ROOT, capture_output=True, text=True, check=True)
    assert of_packages[0] | of_packages[1] >= set(kept.stdout.splitlines())


def test_the_demo_runs_from_the_wheel(fresh, tmp_path):
    done = ended(tmp_path, fresh / "edge-sr", "--source", "demo", "--sink", "jsonl:records", "--duration-s", "6")
    assert done.returncode == 0, done.stderr
    assert "PSNR" in done.stdout
    lines = [json.loads(line) for line in (tmp_path / "records").read_text().splitlines()]
    assert {line["source"] for line in lines} == {"emulated"}
    assert any(line["pattern"] for line in lines)


def test_the_second_wheel_adds_models_and_bench(both, tmp_path):
    listed = run([str(both / "edge-sr"), "models"]).splitlines()
    assert any(line.startswith("stsr ") for line in listed)
    assert "--only none: not one of bicubic, " in ended(tmp_path, both / "edge-sr", "bench", "--only", "none").stderr
    done = ended(tmp_path, both / "python", "-m", "train.data.make_presses", "x.npz")
    # Its dependencies were left out here: one line says what is missing and how to install it.
    (line,) = done.stderr.splitlines()
    assert done.returncode == 1 and line.startswith("not installed: ") and "torch" in line and "pip install" in line


ENDLESS = {
    "make run": "http://127.0.0.1",
    "edge-sr demo --view": "http://127.0.0.1",
    "edge-sr replay --example --view": "http://127.0.0.1",
    "edge-sr --source demo:loop --sink ros2:skin": "an emulated sensor taps",
}
"""Commands that go on until Ctrl-C, and what they print once they are at work."""
LONGEST_S = 1800


def typed() -> list[str]:
    """Lines of README's shell blocks up to the real sensor, without comments."""
    page = (ROOT / "README.md").read_text().partition("## A real sensor")[0]
    lines = "\n".join(re.findall(r"```sh\n(.*?)```", page, re.DOTALL)).splitlines()
    return [line for text in lines if (line := text.partition("  #")[0].strip())]


def run_in(folder: Path, command: str, at_work: str | None = None) -> str:
    """Run a command until it ends, or until it is at work and Ctrl-C; return what it printed."""
    variables = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    pipes = {"stdin": subprocess.DEVNULL, "stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
    shown = ""
    with subprocess.Popen(
        ["bash", "-c", command], cwd=folder, env=variables, start_new_session=True, **pipes
    ) as process:
        try:
            for line in process.stdout:
                if at_work is not None and at_work in line and at_work not in shown:
                    time.sleep(3)
                    os.killpg(process.pid, signal.SIGINT)
                shown += line
            process.wait(60)
        finally:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)
    assert at_work is None or at_work in shown, f"{command} ended: {shown[-2000:]}"
    allowed = {0} if at_work is None else {0, 130, -signal.SIGINT}
    assert process.returncode in allowed, f"{command}: {shown[-2000:]}"
    return shown


@pytest.mark.night
@pytest.mark.timeout(2 * LONGEST_S)
def test_what_readme_types_works(tmp_path):
    clone, *lines = typed()
    assert clone == "git clone URL tactile && cd tactile" and len([line for line in lines if "edge-sr" in line]) >= 3
    subprocess.run(["git", "clone", "--quiet", "--no-hardlinks", ROOT, tmp_path / "tactile"], check=True)
    folder, activated = tmp_path / "tactile", ":"
    bolt = trimesh.creation.cylinder(radius=3.0, height=12.0) + trimesh.creation.cylinder(radius=5.0, height=3.0)
    bolt.export(folder / "bolt.stl")
    for line in lines:
        begun_s = time.monotonic()
        trains = "train_and_deploy.py" in line  # four minutes of it hand no model over, which is a 1
        shown = run_in(folder, f"{activated} && {line}{'; test $? -le 1' if trains else ''}", ENDLESS.get(line))
        assert not trains or "not handed over: " in shown or "from now on: " in shown
        if re.search(r"(^|&& )\. \S+/activate$", line):
            activated = f". {line.rpartition('. ')[2]}"
        print(f"{time.monotonic() - begun_s:6.1f} s  {line}")
        assert "Traceback" not in shown, f"{line}: {shown[-2000:]}"
