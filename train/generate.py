"""Make a dataset of taps on all cores, or on a cluster; an interrupted run continues.

    python -m train.generate data/train.npz --glyphs 2000 --polygons 2000 --count 9000

Chunks of sequences are solved by joblib's workers and written next to the file as they are completed, in
`data/train.npz.parts`; at the end they are joined and removed. The arrays are the same, to the bit, however often a run
was interrupted.

An existing cluster takes the work through joblib's own backends. With Dask:

    import joblib
    from distributed import Client
    from train.generate import generate
    from train.data.generation_config import Generation

    with Client("tcp://scheduler:8786"), joblib.parallel_config(backend="dask"):
        generate(Generation(count=100_000), Path("train.npz"))

and with Ray, after `from ray.util.joblib import register_ray; register_ray()`, the same with backend="ray". Workers
need this package installed, and users' meshes at the same path. Only the caller writes files.
"""

import argparse
import os
import shutil
import sys
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Final, cast

import joblib

from edge.terminal.progress_bar import Progress
from firmware_bridge.pad_geometry import PADS, USPA44
from train.data.dataset import Sequences, join, load_sequences
from train.data.generation_config import FORCE_N, Generation, one_thread, random_figures, solve_chunk
from train.data.workers import quiet_workers
from train.errors import DatasetError, TrainError
from train.surfaces.meshes import MESH, mesh_name, size_of
from train.surfaces.named_surfaces import PLATES, SURFACES, surface_mesh
from train.surfaces.poses import ANGLE_STEP_DEG, MAX_TAPS

_INTERRUPTED: Final = 130
# Joblib's resource tracker, a separate process, occasionally reports on the terminal that an interrupted pool's
# semaphore is gone before it was unregistered. Python's warning filter is its only switch.
_TRACKER_QUIET: Final = "ignore:resource_tracker:UserWarning"
_NAMED: Final = {"all": SURFACES, "plate1": PLATES[0], "plate2": PLATES[1], "none": ()}


def generate(
    config: Generation, path: Path, jobs: int = -1, progress: Callable[[int], object] = lambda poses: None
) -> Sequences:
    """Solve the sequences of a configuration, and write them; an interrupted call resumes. A bar shows the progress.

    Args:
        config: configuration of the dataset.
        path: of the npz.
        jobs: processes, -1 for one on each core; joblib's configured backend may have its own number.
        progress: called with the number of poses that have been completed.

    Raises:
        DatasetError: the file at `path` or its parts were made with another configuration, or cannot be written.
        SurfaceError: a surface's name is unknown.
        MeshError: a user's mesh cannot be used.
    """
    if path.exists():
        if (there := load_sequences(path)).config != config.facts():
            raise DatasetError(f"{path} exists and was made with other settings: delete it, or write to another file")
        progress(len(there) * there.taps)
        return there
    if jobs == 0:
        raise DatasetError("jobs is 0, expected 1 or more, or -1 for one on each core")
    for name in config.surfaces:
        if name.startswith(MESH):  # checked before any work, because meshes fail most often
            surface_mesh(name)
    folder = path.with_name(path.name + ".parts")
    missing = _missing_chunks(config, folder, progress)
    lacking = sum(min(config.chunk, config.sequences - chunk * config.chunk) for chunk in missing)
    total, there = config.sequences * config.taps, (config.sequences - lacking) * config.taps
    # Workers may be threads of this process.
    with one_thread(), Progress("poses", total, "pose", done=there) as bar:
        for chunk, part in _solved(config, missing, jobs):
            part.save(_part_path(folder, chunk))
            progress(len(part) * part.taps)
            bar.advance(len(part) * part.taps)
    made = join([load_sequences(_part_path(folder, chunk)) for chunk in range(config.chunks)])
    made.save(path)
    shutil.rmtree(folder)
    return made


def _part_path(folder: Path, chunk: int) -> Path:
    return folder / f"{chunk:06d}.npz"


def _missing_chunks(config: Generation, folder: Path, progress: Callable[[int], object]) -> list[int]:
    """Return the numbers of chunks that no earlier run has left; damaged ones are solved again."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise DatasetError(f"{folder} cannot be made: {error.strerror}") from error
    missing: list[int] = []
    for chunk in range(config.chunks):
        path = _part_path(folder, chunk)
        try:
            part = load_sequences(path)
        except DatasetError:
            missing.append(chunk)
            continue
        if part.config != config.facts():
            raise DatasetError(f"{folder} holds parts of another run: delete it, or write to another file")
        progress(len(part) * part.taps)
    return missing


def _solved(config: Generation, chunks: Sequence[int], jobs: int) -> Iterator[tuple[int, Sequences]]:
    """Yield chunks with their numbers, as they are completed."""
    tasks = [joblib.delayed(_numbered)(config, chunk) for chunk in chunks]
    if len(tasks) == 1:
        jobs = 1  # a separate process takes seconds to start
    try:
        pool, at_once = joblib.Parallel(n_jobs=jobs, return_as="generator_unordered"), len(tasks)
    except ValueError:  # a backend without generators, such as Ray's: run in rounds, so that parts are kept as well
        pool, at_once = joblib.Parallel(n_jobs=jobs), 4 * joblib.effective_n_jobs(jobs)
    for start in range(0, len(tasks), max(at_once, 1)):
        yield from cast("Iterable[tuple[int, Sequences]]", pool(tasks[start : start + at_once]))


def _numbered(config: Generation, chunk: int) -> tuple[int, Sequences]:
    return chunk, solve_chunk(config, chunk)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; 0 when done, 1 on an error of the user, 130 when interrupted."""
    options = _parser().parse_args(arguments)
    os.environ["PYTHONWARNINGS"] = ",".join(filter(None, (os.environ.get("PYTHONWARNINGS"), _TRACKER_QUIET)))
    # Joblib warns when an interruption leaves chunks unsolved, or solved and not yet fetched, which is intended here.
    warnings.filterwarnings("ignore", r"\d+ tasks (which were still being processed|have been successfully executed)")
    started_s = time.monotonic()
    try:
        config = _config(options)
        for name in config.surfaces:
            if name.startswith(MESH):
                sys.stdout.write(f"{size_of(name)}\n")
        sys.stdout.flush()  # before the simulation, which takes long
        total = config.sequences * config.taps
        with quiet_workers(options.jobs) if options.jobs and config.chunks > 1 else nullcontext():
            made = generate(config, options.out, options.jobs)
    except TrainError as error:
        sys.stderr.write(f"train.generate: {error}\n")
        return 1
    except KeyboardInterrupt:
        sys.stderr.write("train.generate: interrupted; the same command continues\n")
        return _INTERRUPTED
    rate = total / (time.monotonic() - started_s)
    sys.stdout.write(
        f"{options.out}: {len(made)} sequences, {total} poses, {rate:.0f} poses/s, sha256 {made.sha256()}\n"
    )
    return 0


def _config(options: argparse.Namespace) -> Generation:
    named = _NAMED.get(options.surfaces)
    if named is None:
        named = tuple(name.strip() for name in options.surfaces.split(","))
        for name in named:
            surface_mesh(name)
    figures = random_figures(options.glyphs, options.polygons, options.seed)
    meshes = tuple(mesh_name(path, options.unit_mm) for path in options.mesh)
    return Generation(
        surfaces=(*named, *figures, *meshes),
        poses=options.poses,
        split=options.split,
        count=options.count,
        taps=options.taps,
        angle_step_deg=options.angle_step_deg,
        force_n=options.force_n,
        seed=options.seed,
        pad=options.pad,
    )


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m train.generate", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("out", type=Path, metavar="OUT.npz")
    parser.add_argument("--surfaces", default="all", help="all, plate1, plate2, none, or names with commas (all)")
    parser.add_argument("--glyphs", type=int, default=0, help="random stroke figures to add (0)")
    parser.add_argument("--polygons", type=int, default=0, help="random polygons to add (0)")
    parser.add_argument(
        "--mesh", type=Path, action="append", default=[], metavar="FILE", help="STL, OBJ or PLY file to add"
    )
    parser.add_argument(
        "--unit-mm", type=float, default=1.0, help="unit of the meshes in mm: 25.4 for inches, 1000 for metres (1)"
    )
    parser.add_argument("--poses", choices=("random", "paper"), default="random", help="choice of the poses (random)")
    parser.add_argument(
        "--split",
        choices=("train", "validation", "test"),
        default="train",
        help="split of the paper's positions (train)",
    )
    parser.add_argument("--count", type=int, default=9000, help="sequences with random poses (9000)")
    parser.add_argument("--taps", type=int, default=MAX_TAPS, help=f"taps in a sequence ({MAX_TAPS})")
    parser.add_argument("--angle-step-deg", type=float, default=ANGLE_STEP_DEG, help="rotation between taps (5)")
    parser.add_argument("--force-n", type=float, default=FORCE_N, help="force at the end of a press (9.2)")
    parser.add_argument("--pad", choices=[pad.name for pad in PADS], default=USPA44.name, help="sensor model (uSPa44)")
    parser.add_argument("--seed", type=int, default=1, help="seed of poses and random figures (1)")
    parser.add_argument("--jobs", type=int, default=-1, help="processes; -1: one on each core (-1)")
    return parser


if __name__ == "__main__":
    sys.exit(main())
