"""Training loop for every network: mixed precision, resumable, and reproducible for one seed.

One process uses all cores, or one GPU, on which a seed reproduces the weights up to the order of additions.
"""

import hashlib
import io
import json
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from math import cos, isfinite, pi
from pathlib import Path
from pickle import UnpicklingError
from typing import Any, Final

import torch
from torch import nn

from edge.terminal.progress_bar import progress
from firmware_bridge.in_place import write_in_place
from train.data.press_batches import Batch
from train.errors import CheckpointError, TrainError
from train.networks.blocks import Objective, PatternNet

Batches = Callable[[int], Batch]  # function from a number to its batch; the same number always gives the same batch

_WARM_UP: Final = 0.1
_FIRST_SHARE: Final = 1 / 25
_LAST_SHARE: Final = 1e-5

# Errors of loading a file that is not what it should be.
DAMAGES: Final = (OSError, ValueError, KeyError, TypeError, RuntimeError, EOFError, UnpicklingError)


def reason(error: BaseException) -> str:
    """Return the first line of an error."""
    return next(iter(str(error).splitlines()), type(error).__name__)


class DivergedError(TrainError, ArithmeticError):
    """Loss or gradient that is not finite."""


@dataclass(frozen=True, slots=True)
class Recipe:
    """Hyperparameters of a training."""

    steps: int  # of the optimizer
    batch: int = 64  # windows
    learning_rate: float = 2e-3  # highest of the one cycle
    weight_decay: float = 0.0  # of AdamW
    given: tuple[float, ...] = (1.0,)  # share of windows with 1, 2, ... K taps; older taps are dropped
    bf16: bool = False  # multiply in bfloat16 and add in float32, on a device where that is faster

    def __post_init__(self) -> None:
        for name in ("steps", "batch", "learning_rate"):
            if not (value := getattr(self, name)) > 0:
                raise CheckpointError(f"{name} is {value}, expected more than 0")


def gains_by_bf16(device: torch.device) -> bool:
    """Return True if a device multiplies in bfloat16 natively; others emulate it slowly."""
    if device.type == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    able = torch.cpu.get_capabilities()
    return bool(able.get("avx512_bf16") or able.get("amx_bf16") or able.get("bf16"))


def best_device() -> torch.device:
    """Return the GPU if there is one, else the processor."""
    return torch.device("cuda" if torch.cuda.is_available() else "cpu")


def learning_rate_share(progress: float) -> float:
    """Return the share of the highest learning rate at a share of the run (Smith 2018, one cycle of two cosines)."""
    if progress < _WARM_UP:
        return _FIRST_SHARE + (1 - _FIRST_SHARE) * (1 - cos(pi * progress / _WARM_UP)) / 2
    return _LAST_SHARE + (1 - _LAST_SHARE) * (1 + cos(pi * (progress - _WARM_UP) / (1 - _WARM_UP))) / 2


def train(
    net: PatternNet,
    objective: Objective,
    batches: Batches,
    recipe: Recipe,
    resume_path: Path,
    *,
    identity: str = "",
    keep_every_s: float = 60.0,
) -> tuple[float, dict[int, float]]:
    """Train a network in place, and return the seconds that it took, and the loss of a hundred steps by their numbers.

    A run that was interrupted resumes when this is called again with the same `identity`, of network and data, from the
    state in `resume_path`, which the caller deletes when the result is safe. DivergedError if the loss is not finite;
    the network is then as before that step.
    """
    device = best_device()
    net.to(device).train()
    optimizer = torch.optim.AdamW(net.parameters(), lr=recipe.learning_rate, weight_decay=recipe.weight_decay)
    parts = {"net": net, "optimizer": optimizer, "objective": objective}
    recipe_sha256 = hashlib.sha256(json.dumps([asdict(recipe), identity], sort_keys=True).encode()).hexdigest()
    state = _restored(resume_path, parts, recipe_sha256, device)
    first, kept_s = state["step"], time.monotonic()
    started_s = kept_s - state["elapsed_s"]
    course: dict[int, float] = state["course"]
    with progress(resume_path.stem, recipe.steps, "step", done=first) as bar:
        for step in range(first + 1, recipe.steps + 1):
            rate = recipe.learning_rate * learning_rate_share((step - 1) / recipe.steps)
            for group in optimizer.param_groups:
                group["lr"] = rate
            batch = batches(step - 1).to(device)
            with torch.autocast(device.type, torch.bfloat16, enabled=recipe.bf16 and gains_by_bf16(device)):
                descended = objective.loss(net, batch)
            optimizer.zero_grad()
            descended.backward()
            norm = float(nn.utils.clip_grad_norm_(net.parameters(), max_norm=1.0))
            loss = float(descended.detach())
            if not (isfinite(norm) and isfinite(loss)):
                raise DivergedError(f"{resume_path.stem}: loss {loss} at step {step - 1}: lower the learning rate")
            optimizer.step()
            objective.after_step()
            bar.update()
            if step % max(recipe.steps // 100, 1) == 0:
                course[step] = round(loss, 5)
                bar.set_postfix_str(f"loss {loss:.4f}", refresh=False)
            now_s = time.monotonic()
            if now_s - kept_s > keep_every_s:
                kept = {name: part.state_dict() for name, part in parts.items()} | {"recipe": recipe_sha256}
                kept |= {"step": step, "elapsed_s": now_s - started_s, "course": course}
                write_state(resume_path, kept, keep_before=False)
                kept_s = time.monotonic()
    net.eval()
    return time.monotonic() - started_s, course


def _restored(path: Path, parts: Mapping[str, Any], recipe_sha256: str, device: torch.device) -> dict[str, Any]:
    """Return what is known of an interrupted run, whose parts are restored; that of a new run if none."""
    if not path.exists():
        return {"step": 0, "elapsed_s": 0.0, "course": {}}
    try:
        state = torch.load(path, map_location=device, weights_only=True)
    except DAMAGES as error:
        raise CheckpointError(f"{path} is not a run's state ({reason(error)}): delete it to start again") from error
    if not isinstance(state, dict) or state.get("recipe") != recipe_sha256:
        raise CheckpointError(f"{path} is of a run with another recipe or on other data: delete it to start again")
    for name, part in parts.items():
        part.load_state_dict(state[name])
    return state


def write_state(path: Path, state: Mapping[str, Any], *, keep_before: bool = True) -> None:
    """Write weights, or the state of a run, in place; CheckpointError if they cannot be written."""
    held = io.BytesIO()  # torch tells neither the file nor the reason where it cannot write one itself
    torch.save(state, held)
    try:
        write_in_place(
            path,
            lambda draft: draft.write_bytes(held.getbuffer()),
            lambda draft: torch.load(draft, map_location="cpu", weights_only=True),
            keep_before=keep_before,
        )
    except OSError as error:
        why = f"{error.strerror or error}; make room, and the same command continues"
        raise CheckpointError(f"{path} cannot be written: {why}") from error
