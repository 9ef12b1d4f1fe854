"""Training loop for every network: mixed precision, several devices, resumable, and reproducible for one seed.

On a GPU a seed reproduces the weights up to the order of additions.

Under torchrun every process takes its share of each batch, and gradients are averaged: the weights are those of one
process up to the order of additions, except for batch normalisation, which sees the share alone.

    torchrun --nproc-per-node 2 -m train.fit checkpoints --data data/train.npz
"""

import hashlib
import json
import os
import platform
import time
from collections.abc import Callable, Generator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import asdict, dataclass
from math import cos, isfinite, pi
from pathlib import Path
from pickle import UnpicklingError
from typing import Any, Final, Protocol, TypeVar

import torch
from torch import Tensor, distributed, nn
from torch.nn.parallel import DistributedDataParallel
from torch.utils.tensorboard import SummaryWriter

from edge.terminal.progress_bar import Progress
from firmware_bridge.in_place import write_in_place
from train.data.press_batches import Batch
from train.errors import TrainError
from train.networks.blocks import PatternNet

Batches = Callable[[int], Batch]
"""Function from a number to its batch; the same number always gives the same batch."""
Course = list[dict[str, float]]
"""Validation figures at some steps of a training."""

_VALIDATIONS: Final = 5
"""Number of validations over a run."""
_WARM_UP: Final = 0.1
_FIRST_SHARE: Final = 1 / 25
_LAST_SHARE: Final = 1e-5
_KEEP_EVERY_S: Final = 60.0
_LOG_EVERY: Final = 50


class NotResumableError(TrainError, ValueError):
    """State of an interrupted run that had another configuration."""


class DivergedError(TrainError, ArithmeticError):
    """Loss or gradient that is not finite."""


class Objective(Protocol):
    """Loss function of a training. One with its own networks, such as a discriminator, trains and keeps them itself."""

    def loss(self, net: nn.Module, batch: Batch) -> Tensor:
        """Return the scalar loss of a batch."""
        ...

    def after_step(self) -> None:
        """Update the objective after the network has taken its step."""
        ...

    def state_dict(self) -> dict[str, Any]:
        """Return all learned state."""
        ...

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore learned state."""
        ...


@dataclass(frozen=True, slots=True)
class Recipe:
    """Hyperparameters of a training.

    Attributes:
        steps: optimizer steps.
        batch: windows in a batch, shared by all devices.
        learning_rate: highest of the one cycle.
        weight_decay: of AdamW.
        clip_norm: largest norm of a gradient.
        given: share of windows with 1, 2, ... K taps; older taps are dropped.
        bf16: multiply in bfloat16 and add in float32, on a device where that is faster.
        minutes: time after which the cycle ends if that comes first, or None. The weights then depend on the machine.
    """

    steps: int
    batch: int = 64
    learning_rate: float = 2e-3
    weight_decay: float = 0.0
    clip_norm: float = 1.0
    given: tuple[float, ...] = (1.0,)
    bf16: bool = False
    minutes: float | None = None

    def __post_init__(self) -> None:
        for name in ("steps", "batch", "learning_rate", "minutes"):
            value = getattr(self, name)
            if value is not None and not value > 0:
                raise ValueError(f"{name} is {value}, expected more than 0")


@dataclass(frozen=True, slots=True)
class Trained:
    """Result of a run.

    Attributes:
        steps: steps taken.
        elapsed_s: seconds of training over all its parts.
        loss: of the last batch.
        course: validation figures, each with its step.
    """

    steps: int
    elapsed_s: float
    loss: float
    course: Course


def rank_and_world() -> tuple[int, int]:
    """Return the rank of this process and the number of processes; joins torchrun's group on the first call."""
    if "WORLD_SIZE" not in os.environ:
        return 0, 1
    if not distributed.is_initialized():
        distributed.init_process_group("cpu:gloo,cuda:nccl" if torch.cuda.is_available() else "gloo")
        _keep_apart(int(os.environ["LOCAL_RANK"]), int(os.environ["LOCAL_WORLD_SIZE"]))  # ranks on this machine
    return distributed.get_rank(), distributed.get_world_size()


def _keep_apart(rank: int, world: int) -> None:
    """Pin one of several processes of a machine without a GPU to its share of the available cores.

    Without it the kernel kept two processes on one core for minutes, each at half speed, while the other core was
    idle: they wait for each other at every step, so neither is busy for long enough to be moved.
    """
    if world == 1 or torch.cuda.is_available() or not hasattr(os, "sched_setaffinity"):
        return
    cores = sorted(os.sched_getaffinity(0))
    share = cores[rank * len(cores) // world : (rank + 1) * len(cores) // world]
    if share:  # with more processes than cores, the kernel schedules them
        os.sched_setaffinity(0, share)


def gains_by_bf16(device: torch.device) -> bool:
    """Return True if a device multiplies in bfloat16 natively; others emulate it slowly."""
    if device.type == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    able = torch.cpu.get_capabilities()
    return bool(able.get("avx512_bf16") or able.get("amx_bf16") or able.get("bf16"))


def leave_group() -> None:
    """End torchrun's group with all processes at once: one that leaves first would close the others' connections."""
    if distributed.is_initialized():
        distributed.barrier()
        distributed.destroy_process_group()


def wait_for_all() -> None:
    """Wait until all processes have reached this point."""
    if distributed.is_initialized():
        distributed.barrier()


def device_of_rank(rank: int) -> torch.device:
    """Return the device on which a process computes."""
    return torch.device("cuda", rank % torch.cuda.device_count()) if torch.cuda.is_available() else torch.device("cpu")


def device_name(device: torch.device) -> str:
    """Return the name of a device in reports."""
    return torch.cuda.get_device_name(device) if device.type == "cuda" else f"{platform.machine()} processor"


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
    log_folder: Path | None = None,
    validate: Callable[[PatternNet], Mapping[str, float]] | None = None,
) -> Trained:
    """Train a network in place; an interrupted run resumes when this is called again.

    Args:
        net: on any device; left in evaluation mode.
        objective: loss function.
        batches: function from a number to its batch.
        recipe: hyperparameters.
        resume_path: file that keeps the state while the run lasts.
        identity: of network and data; an interrupted run resumes only with the same identity.
        log_folder: for TensorBoard, or None.
        validate: returns figures to log and to keep, of the network in evaluation mode.

    The state at `resume_path` is left there: the caller deletes it when the result is safe.

    Raises:
        ValueError: a batch cannot be shared evenly by the processes.
        DivergedError: the loss is not finite; the network is as it was before that step.
    """
    rank, world = rank_and_world()
    if recipe.batch % world:
        raise ValueError(f"a batch of {recipe.batch} windows is shared by {world} processes: expected as many for each")
    device = device_of_rank(rank)
    _place(net, device).train()
    optimizer = torch.optim.AdamW(net.parameters(), lr=recipe.learning_rate, weight_decay=recipe.weight_decay)
    parallel = DistributedDataParallel(net) if world > 1 else net
    keeper = _Keeper(resume_path, recipe, identity, net, optimizer, objective, rank)
    step, spent_s, course = keeper.restore(device)
    wait_for_all()  # the first process to finish may delete the state
    clock = _Clock(recipe, spent_s)
    logged = _Log(resume_path.stem, step, recipe.steps, log_folder if rank == 0 else None)
    check_at = {round(recipe.steps * (i + 1) / _VALIDATIONS) for i in range(_VALIDATIONS)} if validate else set()
    loss = torch.inf
    with closing(logged) as log, closing(drawn_ahead(batches, step, recipe.steps)) as drawn:
        while (progress := clock.progress(step)) < 1:
            rate = recipe.learning_rate * learning_rate_share(progress)
            for group in optimizer.param_groups:
                group["lr"] = rate
            batch = next(drawn).share(rank, world, device)
            with torch.autocast(device.type, torch.bfloat16, enabled=recipe.bf16 and gains_by_bf16(device)):
                descended = objective.loss(parallel, batch)
            optimizer.zero_grad()
            descended.backward()
            norm = float(nn.utils.clip_grad_norm_(net.parameters(), recipe.clip_norm))
            loss = float(descended.detach())
            if not (isfinite(norm) and isfinite(loss)):
                raise DivergedError(f"{resume_path.stem}: loss {loss} at step {step}: lower the learning rate")
            optimizer.step()
            objective.after_step()
            step += 1
            log.step(step, loss, rate)
            if validate and step in check_at and rank == 0:
                net.eval()
                figures = validate(net)
                log.figures(step, figures)
                course.append({"step": step, **figures})
                net.train()
            keeper.keep_now_and_then(step, clock.elapsed_s(), course)
    net.eval()
    return Trained(step, clock.elapsed_s(), loss, course)


Drawn = TypeVar("Drawn")


def drawn_ahead(batches: Callable[[int], Drawn], first: int, end: int) -> Generator[Drawn, None, None]:
    """Yield the batches from number `first` to before `end`, each drawn in a thread while the one before is used."""
    with ThreadPoolExecutor(1, "batches") as thread:
        coming = thread.submit(batches, first)
        for number in range(first, end):
            batch = coming.result()
            if number + 1 < end:
                coming = thread.submit(batches, number + 1)
            yield batch


def _place(net: PatternNet, device: torch.device) -> PatternNet:
    """Move a network to a device; on a GPU with channels last and cudnn's benchmark: 28 ms a step, not 34 (H100)."""
    if device.type != "cuda":
        return net.to(device)
    torch.backends.cudnn.benchmark = True
    return nn.utils.convert_conv2d_weight_memory_format(net.to(device), torch.channels_last)


class _Log:
    """Progress bar on a terminal, and TensorBoard."""

    def __init__(self, name: str, done: int, steps: int, folder: Path | None) -> None:
        self._bar = Progress(name, steps, "step", done=done)
        self._writer = SummaryWriter(str(folder)) if folder else None

    def step(self, step: int, loss: float, rate: float) -> None:
        self._bar.advance()
        if step % _LOG_EVERY == 0:
            self._bar.note(f"loss {loss:.4f}")
            self.figures(step, {"loss": loss, "learning rate": rate})

    def figures(self, step: int, values: Mapping[str, float]) -> None:
        if self._writer:
            for name, value in values.items():
                self._writer.add_scalar(name, value, step)

    def close(self) -> None:
        self._bar.close()
        if self._writer:
            self._writer.close()


class _Clock:
    """Progress of a run by its steps or by its time, the same in all processes."""

    def __init__(self, recipe: Recipe, spent_s: float) -> None:
        self._recipe = recipe
        self._started_s = time.monotonic() - spent_s

    def elapsed_s(self) -> float:
        return time.monotonic() - self._started_s

    def progress(self, step: int) -> float:
        by_steps = step / self._recipe.steps
        if self._recipe.minutes is None:
            return by_steps
        by_time = torch.tensor(self.elapsed_s() / (60 * self._recipe.minutes), dtype=torch.float64)
        if distributed.is_initialized():
            distributed.broadcast(by_time, src=0)
        return max(by_steps, float(by_time))


class _Keeper:
    """State of a run on disk, saved every minute, so that an interruption costs at most that."""

    def __init__(
        self,
        path: Path,
        recipe: Recipe,
        identity: str,
        net: nn.Module,
        optimizer: torch.optim.Optimizer,
        objective: Objective,
        rank: int,
    ) -> None:
        self._path = path
        self._hash = hashlib.sha256(json.dumps([asdict(recipe), identity], sort_keys=True).encode()).hexdigest()
        self._parts = {"net": net, "optimizer": optimizer, "objective": objective}
        self._rank = rank
        self._kept_s = time.monotonic()

    def restore(self, device: torch.device) -> tuple[int, float, Course]:
        """Return the steps, seconds and figures of an interrupted run; zeros for a new run."""
        if not self._path.exists():
            return 0, 0.0, []
        try:
            state = torch.load(self._path, map_location=device, weights_only=True)
        except (OSError, ValueError, KeyError, TypeError, RuntimeError, EOFError, UnpicklingError) as error:
            reason = next(iter(str(error).splitlines()), type(error).__name__)
            raise NotResumableError(
                f"{self._path} is not a run's state ({reason}): delete it to start again"
            ) from error
        if not isinstance(state, dict) or state.get("recipe") != self._hash:
            raise NotResumableError(
                f"{self._path} is of a run with another recipe or on other data: delete it to start again"
            )
        for name, part in self._parts.items():
            part.load_state_dict(state[name])
        return state["step"], state["elapsed_s"], state.get("course", [])

    def keep_now_and_then(self, step: int, elapsed_s: float, course: Course) -> None:
        if self._rank == 0 and time.monotonic() - self._kept_s > _KEEP_EVERY_S:
            self.keep(step, elapsed_s, course)

    def keep(self, step: int, elapsed_s: float, course: Course) -> None:
        state = {name: part.state_dict() for name, part in self._parts.items()}
        state |= {"recipe": self._hash, "step": step, "elapsed_s": elapsed_s, "course": course}
        write_in_place(
            self._path,
            lambda draft: torch.save(state, draft),
            lambda draft: torch.load(draft, map_location="cpu", weights_only=True),
            keep_before=False,
        )
        self._kept_s = time.monotonic()
