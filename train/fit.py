"""Train STSR, MTSR-2 and MTSR-4 from nothing to their final error, in one seeded run.

    python -m train.fit checkpoints

Older taps drop out at random in training, so a network is right with fewer taps than it takes. One base network of four
taps is trained from nothing, on two threads; each of the three starts as that network, with its own number of taps, and
is trained on, a process and a thread each: MTSR-4 for twice as long, as it has to be right with one tap as well as with
four. A checkpoint is NAME.pt (weights) beside NAME.json (its configuration and what was measured).
"""

import argparse
import hashlib
import json
import multiprocessing
import sys
import time
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray
from tqdm import tqdm

from edge.frozen import FrozenSet
from edge.metrics import contact_iou, psnr_db, ssim
from firmware_bridge.geometry import USPA44
from train.compact_net import CompactNet
from train.dataset import (
    MAX_TAPS,
    SET_FORCE_N,
    VALIDATION_POSITION,
    Sequences,
    freeze,
    random_poses,
    solve_sequences,
    training_batches,
)
from train.layer import Layer
from train.simulation import SimulatedSensor
from train.skin import Nuisances

BASE_FILE: Final = "base.pt"
WORKERS: Final = 2
_CONTACT_LEVELS: Final = tuple(np.arange(0.5, 0.95, 0.05).round(2).tolist())


@dataclass(frozen=True, slots=True)
class Stage:
    """Training of one network.

    Attributes:
        taps: K.
        steps: optimizer steps.
        learning_rate: highest of the cycle.
        given: share of windows with 1, 2, ... K taps given, older ones dropped.
    """

    taps: int
    steps: int
    learning_rate: float
    given: tuple[float, ...]

    @property
    def name(self) -> str:
        """Name of the network: stsr, mtsr2, mtsr4."""
        return "stsr" if self.taps == 1 else f"mtsr{self.taps}"


@dataclass(frozen=True, slots=True)
class TrainingConfig:
    """All that decides the weights.

    Attributes:
        base: starts from nothing.
        stages: start from what the base has learnt.
    """

    seed: int = 1
    sequences: int = 9000
    batch: int = 64
    scale: int = 10
    channels: int = 64
    blocks: int = 6
    clip_norm: float = 1.0
    counts_per_unit: tuple[float, float, float] = (500.0, 500.0, 1000.0)
    set_force_n: tuple[float, float] = SET_FORCE_N
    layer: Layer = field(default_factory=Layer)
    nuisances: Nuisances = field(default_factory=Nuisances)
    base: Stage = Stage(taps=4, steps=9000, learning_rate=2e-3, given=(0.25, 0.15, 0.1, 0.5))
    stages: tuple[Stage, ...] = (
        Stage(taps=4, steps=2000, learning_rate=5e-4, given=(0.3, 0.15, 0.1, 0.45)),
        Stage(taps=2, steps=1000, learning_rate=5e-4, given=(0.3, 0.7)),
        Stage(taps=1, steps=1000, learning_rate=5e-4, given=(1.0,)),
    )

    def sha256(self) -> str:
        """Hash of the configuration, as written in the models' contract."""
        return hashlib.sha256(json.dumps(asdict(self), sort_keys=True).encode()).hexdigest()


def network_input(window_counts: NDArray[np.float32], config: TrainingConfig) -> torch.Tensor:
    """Windows (n, K, 3, rows, cols) in zeroed counts to network input (n, 3K, rows, cols)."""
    per_unit = np.array(config.counts_per_unit, dtype=np.float32)[:, None, None]
    return torch.from_numpy((window_counts / per_unit).reshape(len(window_counts), -1, *window_counts.shape[3:]))


def train_stage(
    net: CompactNet,
    stage: Stage,
    config: TrainingConfig,
    solved: Sequences,
    rng: np.random.Generator,
    position: int = 0,
) -> None:
    """Train one network in place."""
    optimizer = torch.optim.AdamW(net.parameters(), lr=stage.learning_rate, weight_decay=0.0)
    schedule = torch.optim.lr_scheduler.OneCycleLR(
        optimizer, stage.learning_rate, total_steps=stage.steps, pct_start=0.1
    )
    net.train()
    bar = tqdm(total=stage.steps, desc=stage.name, unit="step", position=position, disable=not sys.stderr.isatty())
    done, shown = 0, torch.tensor(torch.inf)
    while done < stage.steps:
        for windows, patterns in training_batches(
            solved, rng, config.nuisances, USPA44, config.batch, config.set_force_n
        ):
            kept = _drop_taps(windows[:, : stage.taps], rng, stage.given)
            loss = _relative_error(net(network_input(kept, config)), torch.from_numpy(patterns.copy()))
            optimizer.zero_grad()
            loss.backward()
            torch.nn.utils.clip_grad_norm_(net.parameters(), config.clip_norm)
            optimizer.step()
            schedule.step()
            shown = loss.detach()
            done += 1
            bar.update()
            if done == stage.steps:
                break
        bar.set_postfix(loss=f"{float(shown):.4f}")
    bar.close()
    net.eval()


def _drop_taps(windows: NDArray[np.float32], rng: np.random.Generator, given: tuple[float, ...]) -> NDArray[np.float32]:
    count = rng.choice(np.arange(1, len(given) + 1), size=len(windows), p=given)
    kept = np.arange(len(given)) < count[:, None]
    return windows * kept[..., None, None, None].astype(np.float32)


def _relative_error(patterns: torch.Tensor, truth: torch.Tensor) -> torch.Tensor:
    """Mean absolute error of each pattern as a share of its truth's RMS: light contacts count as much as firm ones."""
    error = (patterns - truth).abs().mean(dim=(1, 2))
    return (error / truth.square().mean(dim=(1, 2)).sqrt()).mean()


def infer(net: CompactNet, windows: NDArray[np.float32], config: TrainingConfig) -> NDArray[np.float32]:
    """Patterns (n, H, W) of windows (n, K, 3, rows, cols) in zeroed counts."""
    with torch.inference_mode():
        parts = torch.split(network_input(windows, config), 256)
        return torch.cat([net(part) for part in parts]).numpy()


def best_contact_level(patterns: NDArray[np.float32], validation: FrozenSet) -> float:
    """Share of a pattern's maximum whose outline overlaps the true contact best."""
    overlap = [contact_iou(patterns, validation.touching(), level).mean() for level in _CONTACT_LEVELS]
    return _CONTACT_LEVELS[int(np.argmax(overlap))]


def fit_base(config: TrainingConfig, solved: Sequences, folder: Path) -> str:
    """Train the base network, write its weights, and say so."""
    started_s = time.monotonic()
    torch.set_num_threads(WORKERS)  # nothing else runs yet
    torch.manual_seed(config.seed)
    net = CompactNet(config.base.taps, config.scale, config.channels, config.blocks)
    train_stage(net, config.base, config, solved, np.random.default_rng([config.seed, 0]))
    torch.save(net.state_dict(), folder / BASE_FILE)
    return f"base: {time.monotonic() - started_s:.0f} s"


def fit_stage(config: TrainingConfig, index: int, solved: Sequences, validation: FrozenSet, folder: Path) -> str:
    """Train the base on for one network, write its checkpoint, and say what came out."""
    started_s = time.monotonic()
    torch.set_num_threads(1)
    stage = config.stages[index]
    base = CompactNet(config.base.taps, config.scale, config.channels, config.blocks)
    base.load_state_dict(torch.load(folder / BASE_FILE, weights_only=True))
    net = base.with_fewer_taps(stage.taps)
    train_stage(net, stage, config, solved, np.random.default_rng([config.seed, 1 + index]), position=index)
    report = _report(net, stage, config, validation)
    torch.save(net.state_dict(), folder / f"{stage.name}.pt")
    (folder / f"{stage.name}.json").write_text(json.dumps(report, indent=1) + "\n")
    return (
        f"{stage.name}: validation {report['validation_psnr_db']:.2f} dB, SSIM {report['validation_ssim']:.3f},"
        f" {time.monotonic() - started_s:.0f} s"
    )


def _report(net: CompactNet, stage: Stage, config: TrainingConfig, validation: FrozenSet) -> dict[str, Any]:
    patterns, truth = infer(net, validation.windows(stage.taps), config), validation.patterns()
    return {
        "name": stage.name,
        "taps": stage.taps,
        "config": asdict(config),
        "training_sha256": config.sha256(),
        "contact_level": best_contact_level(patterns, validation),
        "validation_psnr_db": float(psnr_db(patterns, truth, validation.full_scale_mm).mean()),
        "validation_ssim": float(ssim(patterns, truth, validation.full_scale_mm).mean()),
    }


def fit(config: TrainingConfig, folder: Path) -> None:
    """Make the training taps, train the base, then the stages side by side, and write checkpoints."""
    folder.mkdir(parents=True, exist_ok=True)
    sensor = SimulatedSensor(USPA44, config.layer, config.scale)
    started_s, count = time.monotonic(), config.sequences * MAX_TAPS
    with tqdm(total=count, desc="poses", unit="pose", disable=not sys.stderr.isatty()) as bar:
        poses = random_poses(np.random.default_rng(config.seed), config.sequences)
        solved = solve_sequences(sensor, *poses, progress=bar.update)
    _say(f"{count} poses, {count / (time.monotonic() - started_s):.0f} a second")
    validation = freeze(sensor, VALIDATION_POSITION, config.nuisances, config.seed)
    with ProcessPoolExecutor(WORKERS, multiprocessing.get_context("spawn")) as pool:
        _say(pool.submit(fit_base, config, solved, folder).result())
        stages = [
            pool.submit(fit_stage, config, index, solved, validation, folder) for index in range(len(config.stages))
        ]
        for done in as_completed(stages):
            _say(done.result())


def _say(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def main(arguments: list[str] | None = None) -> None:
    """Command line."""
    parser = argparse.ArgumentParser(prog="python -m train.fit", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path, help="where to write the checkpoints")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--sequences", type=int, default=9000, help="sequences of four taps to make")
    options = parser.parse_args(arguments)
    started_s = time.monotonic()
    fit(TrainingConfig(seed=options.seed, sequences=options.sequences), options.folder)
    _say(f"all in {(time.monotonic() - started_s) / 60:.1f} min")


if __name__ == "__main__":
    main()
