"""Make a training set of a sensor's own taps on a known surface, with the truth of the tactile PSF.

    python -m train.taps letters.csv --surface letters.stl --sensor-file sensor.toml --out taps.npz
    python -m train.taps 1.mcap 2.mcap --surface letters.stl shapes.stl --sensor-file sensor.toml --out taps.npz
    python -m train.taps C.npy F.npy --sensor-file sensor.toml --out taps.npz

The poses of a recording say where the pad was, the surface what lay under it, and the constants of the sensor file how
deep it was pressed where it reads so much. `python -m train.own --taps` learns from the patterns that the PSF makes.

The reach of the PSF is that of the pad's layer, as in all other training. With --truth fitted it is the paper's: a
network of the PSF is fitted on these very taps. psf and depth, which have no plateau or no reach, are to compare.

Source: Wu and Liu 2024, Section IV, Eq. 4-10, Table II.
"""

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray

from edge.terminal.argument_types import positive
from edge.terminal.progress_bar import tracked
from firmware_bridge.in_place import check_writable
from firmware_bridge.pad_geometry import USPA44
from firmware_bridge.sensor_file.model import SensorEntry, load_sensor_file
from train.data.presses import SEED, PressSet, join_presses, one_thread
from train.data.recorded_taps import RecordedTap, Surface, image_surface, placed, pressed, recorded_taps, surface_of
from train.errors import DatasetError, ended_by_errors
from train.networks.tactile_psf import PsfNet, fit_psf_net
from train.own import Knowledge, knowledge_of, say
from train.physics.gripped import FINE_SCALE, MAX_INDENTATION_MM, SCALE, TRACTION_SCALE, GrippedPad
from train.physics.pad_draws import constants
from train.physics.tpsf import resample_touching, spread, tpsf_pattern
from train.surfaces.depth_image import Pose

FEWEST: Final = 27  # places to tap: one of each nine is held out for validation and one for the test, as in the paper
EPOCHS: Final = 20  # of the network of the PSF
TRUTHS: Final = ("tpsf", "fitted", "psf", "depth")
_IMAGE_MM: Final = USPA44.rows * USPA44.pitch_mm  # side of a published depth image: the taxels' area


@one_thread()
def tapped(paths: Sequence[Path], surfaces: Sequence[Surface], knowledge: Knowledge, entry: SensorEntry) -> PressSet:
    """Return all frames of the taps in recordings, each of its surface, without patterns; contact at FINE_SCALE."""
    gripped = GrippedPad(knowledge.middle())  # also of what is not known
    gains = np.reshape(knowledge.pad.gains or np.ones(USPA44.scan_shape), USPA44.scan_shape)
    parts: list[PressSet] = []
    places: list[tuple[object, ...]] = []
    for number, path in enumerate(paths):
        taps = recorded_taps(path, entry, knowledge.name)
        if taps[0].image is not None:
            images = [(tap.image, tap.pose) for tap in taps if tap.image is not None]
            under = [(image_surface(image, _IMAGE_MM / len(image)), pose) for image, pose in images]
            places += [(number, tap) for tap in range(len(taps))]
            say(f"{path}: {len(taps)} published taps")
        else:
            if len(surfaces) not in (1, len(paths)):
                raise DatasetError(f"{path}: on what? pass --surface once for all recordings, or once for each")
            surface = surfaces[number % len(surfaces)]
            even = [replace(tap, counts=tap.counts / gains) for tap in taps]
            where = placed(even, surface, gripped)
            under = [(surface, where(tap.pose)) for tap in taps]
            places += [(number, round(tap.pose.x_mm, 1), round(tap.pose.y_mm, 1)) for tap in taps]
            say(f"{path}: {len(taps)} taps; {where.told()}")
        for tap, (surface, pose) in zip(tracked(taps, "what they touch", "tap"), under, strict=True):
            parts.append(_frames(tap, surface, pose, gripped, gains, path.stem))
    made = join_presses(parts)  # the number of a frame's pad is that of its tap
    numbers = {place: number for number, place in enumerate(dict.fromkeys(places))}
    if len(numbers) < FEWEST:
        raise DatasetError(f"taps at {len(numbers)} places, expected at least {FEWEST}; see the page on own models")
    ninth = (np.random.default_rng(SEED).permutation(len(numbers)) % 9)[[numbers[place] for place in places]]
    split = {"training": ninth > 1, "validation": ninth == 1, "test": ninth == 0}
    numbered = {name: np.flatnonzero(part).tolist() for name, part in split.items()}
    return replace(made, config={"sensor": knowledge.name, "split": numbered})


def _frames(
    tap: RecordedTap, surface: Surface, pose: Pose, gripped: GrippedPad, gains: NDArray[np.floating], name: str
) -> PressSet:
    simulated, n = pressed([pose], surface, gripped), len(tap.counts)
    z = (tap.counts / gains)[:, 2].sum(axis=(1, 2))
    return PressSet(
        family=np.array([name] * n),
        pad=np.zeros(n, dtype=np.int64),
        constants=np.tile(constants(gripped.pad), (n, 1)),
        counts=tap.counts[:, None],
        angle_deg=np.full((n, 1), pose.angle_deg, dtype=np.float32),
        poses=np.zeros((n, 1, 3), dtype=np.float32),
        patterns=np.zeros((n, 1, 1), dtype=np.float16),
        touching=np.repeat(simulated.touching, n, axis=0),
        traction_kpa=np.full((n, 3, *USPA44.pattern_shape(TRACTION_SCALE)), np.nan, dtype=np.float16),
        force_n=np.stack([0 * z, 0 * z, z / gripped.pad.counts_per_newton], axis=1).astype(np.float32),
        twist_nmm=np.zeros(n, dtype=np.float32),
        indentation_mm=(MAX_INDENTATION_MM * z / simulated.counts[0, -1, 2].sum()).astype(np.float32),
    )


def with_patterns(taps: PressSet, truth: str, scale: int) -> tuple[PressSet, str]:
    """Return taps with their patterns at a scale, and a line on how these were made: one of TRUTHS."""
    touching, depth_mm = resample_touching(taps.touching, FINE_SCALE, scale), taps.indentation_mm
    told, force_n = f"truth {truth}", taps.force_n[:, 2]
    if truth == "tpsf":
        patterns = tpsf_pattern(touching, depth_mm, USPA44.pitch_mm / scale)
    elif truth == "depth":  # in proportion to the force
        patterns = touching * (force_n * (force_n @ depth_mm / np.square(force_n).sum()))[:, None, None]
    else:
        net, counts, area = PsfNet(), torch.from_numpy(taps.counts[:, 0]), torch.from_numpy(touching).float()
        seen = np.isin(taps.pad, taps.config["split"]["training"])
        coarse = resample_touching(taps.touching[seen], FINE_SCALE, SCALE)
        fit_psf_net(net, taps.counts[seen, 0], coarse.astype(np.float32), depth_mm[seen], epochs=EPOCHS)
        with torch.no_grad():
            read = net(counts)
            blurred = net.k_scale * read.alpha[:, None, None] * spread(area, read.beta_mm, USPA44.pitch_mm / scale)
            patterns = (blurred if truth == "psf" else net.pattern(read, area)).numpy()
        told += f", reach of the PSF {read.beta_mm.mean():.2f} mm, gamma {read.gamma:.2f}, k_scale {net.k_scale:.3g}"
    config = dict(taps.config) | {"truth": truth}
    return replace(taps, patterns=patterns.astype(np.float16), touching=touching, config=config), told


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line."""
    options = _parser().parse_args(arguments)
    with ended_by_errors("train.taps"):
        _make(options)


def _make(options: argparse.Namespace) -> None:
    options.out.parent.mkdir(parents=True, exist_ok=True)
    check_writable(options.out)  # before minutes are spent on it
    file = load_sensor_file(options.sensor_file)
    knowledge = knowledge_of(file, options.sensor)
    surfaces = [surface_of(path, options.unit_mm, options.pixel_mm) for path in options.surface]
    taps = tapped(options.recordings, surfaces, knowledge, file.sensors[knowledge.name])
    if (deepest_mm := float(taps.indentation_mm.max())) > 2 * MAX_INDENTATION_MM:
        raise DatasetError(
            f"a tap is {deepest_mm:.2f} mm deep by the constants of the sensor file, expected at most "
            f"{MAX_INDENTATION_MM:g} mm: press less, correct the poses, or lay a weight on it with edge-sr doctor"
        )
    made, told = with_patterns(taps, options.truth, options.scale)
    made.save(options.out)
    shares = [f"{np.isin(made.pad, part).sum()} {name}" for name, part in made.config["split"].items()]
    deepest = f"deepest {deepest_mm:.2f} mm by the constants of the sensor file"
    say(f"{options.out}: {len(made)} LR-HR pairs, {', '.join(shares)}; {told}; {deepest}")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m train.taps", description=(__doc__ or "").splitlines()[0])
    add = parser.add_argument
    add("recordings", type=Path, nargs="+", metavar="RECORDING", help="taps with poses, or .npy as the authors publish")
    add("--surface", type=Path, nargs="+", default=[], metavar="FILE", help="mesh or depth image (PNG), of all or each")
    add("--sensor-file", type=Path, required=True, metavar="SENSOR.toml", help="as edge-sr doctor --out writes it")
    add("--sensor", metavar="NAME", help="which sensor of the file (default: its only one)")
    add("--out", type=Path, required=True, help="npz file of the taps")
    add("--truth", choices=TRUTHS, default=TRUTHS[0], help="how patterns are made (tpsf)")
    add("--scale", type=int, choices=range(4, FINE_SCALE + 1), default=SCALE, metavar="4..20", help="pixels a pitch")
    add("--unit-mm", type=float, default=1.0, help="unit of the meshes in mm (1)")
    add("--pixel-mm", type=positive, default=0.1, help="side of a depth image's pixel in mm (0.1)")
    return parser


if __name__ == "__main__":
    main()
