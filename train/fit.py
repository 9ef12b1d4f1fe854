"""Train the bundled networks on from their bundled weights, or one network by name; in one seeded run.

    python -m train.fit checkpoints --data data/gripped.npz data/taps7.npz --validation data/validation.npz

The bundled networks are trained for as many steps, that of one tap and that of several taps, so that taps alone tell
them apart. An interrupted run resumes with the same command. NAME.json, next to the weights, has the loss by steps.
"""

import argparse
import sys
import time
from pathlib import Path
from typing import Any, Final

from train.data.frozen_presses import freeze_presses
from train.data.presses import SEED, PressSet, join_presses, load_presses
from train.errors import DatasetError, ended_by_errors
from train.learning.checkpoint import Training, fit_network
from train.learning.training_loop import Recipe
from train.networks.named_networks import NETWORKS
from train.physics.pad_draws import KNOWN
from train.surfaces.poses import MAX_TAPS

# Share of windows with 1, 2, ... K taps; of batches, for a network that takes poses.
GIVEN: Final = {1: (1.0,), 2: (0.3, 0.7), 4: (0.3, 0.15, 0.1, 0.45), 7: (0.3, 0.14, 0.1, 0.25, 0.04, 0.04, 0.13)}
_KNOWN: Final = {"known": KNOWN}
_COMPACT: Final = ("compact-", "small-", "fusion-")  # networks that take constants of the pad and give deviations


def _trained_on(name: str, network: str, taps: int = 1) -> Training:
    recipe = Recipe(steps=10_000, learning_rate=1e-3, given=GIVEN[taps], bf16=True)
    return Training(name, network, recipe, start=f"{name}.onnx", options=_KNOWN)


BUNDLED: Final = (
    _trained_on("stsr", "compact-stsr"),
    _trained_on("stsr-small", "small-stsr"),
    _trained_on("mtsr", "fusion-mtsr7", MAX_TAPS),
)


def given_taps(taps: int) -> tuple[float, ...]:
    """Return the shares of windows with 1, 2, ... K taps: about half of them whole, most of the rest with one tap."""
    if taps in GIVEN:
        return GIVEN[taps]
    return (0.3, *[0.25 / (taps - 2)] * (taps - 2), 0.45)


def bundled(data: PressSet) -> tuple[Training, ...]:
    """Return the trainings of the bundled networks; DatasetError if no sequence has as many taps as they take."""
    most = int(data.counts.any(axis=(2, 3, 4)).sum(axis=1).max())
    needed = max(len(training.recipe.given) for training in BUNDLED)
    if most < needed:  # before hours of training of those that come first
        raise DatasetError(
            f"the presses have at most {most} taps, the bundled networks take {needed}: add data/taps7.npz, or train "
            "one network with --network"
        )
    return BUNDLED


def _line(report: dict[str, Any]) -> str:
    covered = f", interval covers {report['validation_coverage']:.1%}" if "validation_coverage" in report else ""
    found = f"{report['name']}: validation {report['validation_psnr_db']:.2f} dB{covered}"
    return f"{found}; {report['steps']} steps, {report['elapsed_s']:.0f} s"


def _say(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def main(arguments: list[str] | None = None) -> None:
    """Run the command line."""
    options = _parser().parse_args(arguments)
    started_s = time.monotonic()
    with ended_by_errors("fit"):
        data = join_presses([*map(load_presses, options.data)])
        frozen = freeze_presses(load_presses(options.validation), SEED).as_frozen_set()
        for training in bundled(data) if options.network is None else (_training(options),):
            _say(_line(fit_network(training, data, frozen, options.folder)))
    _say(f"all in {(time.monotonic() - started_s) / 60:.1f} min")


def _training(options: argparse.Namespace) -> Training:
    *_, taps = options.network.rpartition("mtsr")
    recipe = Recipe(options.steps, given=given_taps(int(taps) if taps.isdigit() else 1), bf16=True)
    compact = options.network.startswith(_COMPACT)
    # A network of the paper must not overwrite a bundled one.
    name = options.network if compact else f"seed-{options.network}"
    constants = _KNOWN if compact else {}
    return Training(name, options.network, recipe, start=options.start_from, seed=options.seed, options=constants)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m train.fit", description=(__doc__ or "").splitlines()[0])
    alone = parser.add_argument_group("one network instead of the bundled ones").add_argument
    add = parser.add_argument
    add("folder", type=Path, help="folder for the checkpoints")
    add("--data", type=Path, nargs="+", required=True, help="files of train.data.make_presses")
    add("--validation", type=Path, required=True, help="presses to calibrate on, not used for training")
    those = ", ".join(NETWORKS) + "; those of the paper are seed-NAME.pt"
    alone("--network", choices=NETWORKS, metavar="NAME", help=those)
    alone("--start-from", metavar="NAME", help="checkpoint in the same folder, or bundled NAME.onnx, to start from")
    alone("--steps", type=int, default=9000)
    alone("--seed", type=int, default=1)
    return parser


if __name__ == "__main__":
    main()
