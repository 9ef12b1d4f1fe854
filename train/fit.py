"""Train the bundled networks from nothing to their final error, or one network by name; in one seeded run.

    python -m train.fit checkpoints --data data/seen.npz data/figures.npz
    torchrun --nproc-per-node 2 -m train.fit checkpoints --data data/seen.npz --network stsr --steps 5000
    python -m train.fit checkpoints --data data/seen.npz --network mtsr2 --start seed-stsr --steps 5000

A base network of seven taps is trained from nothing; each bundled one starts as that network, with its own number of
taps, and is trained on. The small one is trained from nothing. Older taps drop out at random in training, so a network
is right with fewer taps than it takes.
A run that was cut short goes on where it was. `tensorboard --logdir checkpoints/logs` shows how it goes.
"""

import argparse
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

from train.dataset import Sequences, join, load_sequences
from train.errors import TrainError
from train.freeze import SEED, freeze, held_out
from train.loop import Recipe, leave_group, rank_and_world
from train.networks.registry import NETWORKS
from train.nuisances import Nuisances
from train.training import Training, fit_network

GIVEN: Final = {1: (1.0,), 2: (0.3, 0.7), 4: (0.3, 0.15, 0.1, 0.45)}
"""Share of windows with 1, 2, ... K taps given."""

BASE: Final = Training(
    "base", "compact-mtsr7", Recipe(steps=16_000, given=(0.2, 0.1, 0.1, 0.25, 0.05, 0.05, 0.25), bf16=True)
)
BUNDLED: Final = tuple(
    Training(
        name, f"compact-{name}", Recipe(steps=steps, learning_rate=5e-4, given=GIVEN[taps]), start="base", seed=1 + taps
    )
    for name, taps, steps in (("mtsr4", 4, 2000), ("mtsr2", 2, 1000), ("stsr", 1, 1000))
)
SMALL: Final = Training("stsr-small", "small-stsr", Recipe(steps=16_000, bf16=True))


def given_taps(taps: int) -> tuple[float, ...]:
    """Shares of windows with 1, 2, ... K taps given: half of them whole, the rest one tap first."""
    if taps in GIVEN:
        return GIVEN[taps]
    shares = [0.3, *[0.25 / (taps - 2)] * (taps - 2), 0.45]
    return tuple(shares)


def fit_bundled(data: Sequences, folder: Path, shorten: int = 1) -> None:
    """Train the base, then the bundled networks from it; `shorten` divides their steps, for tests."""
    validation = freeze(held_out("validation", taps=data.taps), Nuisances(), SEED)
    for training in (BASE, *BUNDLED, SMALL):
        _say(_line(fit_network(_shortened(training, shorten), data, validation, folder)))


def _shortened(training: Training, divisor: int) -> Training:
    if divisor < 1:
        raise ValueError(f"--shorten is {divisor}, expected 1 or more")
    steps = max(training.recipe.steps // divisor, 1)
    return replace(training, recipe=replace(training.recipe, steps=steps))


def _line(report: dict[str, Any]) -> str:
    covered = f", interval covers {report['validation_coverage']:.1%}" if "validation_coverage" in report else ""
    return (
        f"{report['name']}: validation {report['validation_psnr_db']:.2f} dB, SSIM {report['validation_ssim']:.3f}"
        f"{covered}; {report['steps']} steps, {report['elapsed_s']:.0f} s"
    )


def _say(line: str) -> None:
    if rank_and_world()[0] == 0:
        sys.stdout.write(line + "\n")
        sys.stdout.flush()


def main(arguments: list[str] | None = None) -> None:
    """Command line."""
    options = _parser().parse_args(arguments)
    started_s = time.monotonic()
    try:
        data = join([load_sequences(path) for path in options.data])
        if options.network is None:
            fit_bundled(data, options.folder, options.shorten)
        else:
            training = _training(options)
            validation = freeze(held_out("validation"), Nuisances(), SEED, scale=training.scale)
            report = fit_network(training, data, validation, options.folder)
            _say(_line(report))
    except (TrainError, ValueError) as error:
        sys.exit(f"fit: {error}")
    except KeyboardInterrupt:
        sys.exit("fit: stopped; the same command goes on where it was")
    _say(f"all in {(time.monotonic() - started_s) / 60:.1f} min")
    leave_group()


def _training(options: argparse.Namespace) -> Training:
    *_, taps = options.network.rpartition("mtsr")
    recipe = Recipe(
        steps=options.steps,
        batch=options.batch,
        learning_rate=options.learning_rate,
        given=given_taps(int(taps) if taps.isdigit() else 1),
        bf16=options.bf16,
        minutes=options.minutes,
    )
    return Training(
        options.name or _name(options.network), options.network, recipe, options.scale, options.start, seed=options.seed
    )


def _name(network: str) -> str:
    """Not that of a bundled one, which a network of the paper must not overwrite."""
    return network if network.startswith(("compact-", "small-")) else f"seed-{network}"


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m train.fit", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path, help="where to write the checkpoints")
    parser.add_argument("--data", type=Path, nargs="+", required=True, help="files of train.generate")
    parser.add_argument("--shorten", type=int, default=1, help="divide the bundled networks' steps, to try things out")
    one = parser.add_argument_group("one network instead of the bundled ones")
    one.add_argument("--network", choices=NETWORKS, metavar="NAME", help=", ".join(NETWORKS))
    one.add_argument(
        "--name", help="of the checkpoint (default: the network's, with seed- before it for those of the paper)"
    )
    one.add_argument("--start", metavar="NAME", help="checkpoint in the same folder to start from")
    one.add_argument("--scale", type=int, default=10, help="pattern pixels per taxel pitch")
    one.add_argument("--steps", type=int, default=9000)
    one.add_argument("--minutes", type=float, help="end by the clock where that comes first")
    one.add_argument("--batch", type=int, default=64, help="windows in a batch, shared by all devices")
    one.add_argument("--learning-rate", type=float, default=2e-3)
    one.add_argument("--bf16", action="store_true", help="multiply in bfloat16")
    one.add_argument("--seed", type=int, default=1)
    return parser


if __name__ == "__main__":
    main()
