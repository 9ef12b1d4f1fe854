"""Make a set of presses on all cores; an interrupted run continues.

    python -m train.data.make_presses data/gripped.npz --count 24000
    python -m train.data.make_presses data/parts.npz --mesh part.stl --count 2000

Every pad's presses are written as they are solved, into `data/gripped.npz.parts`; at the end they are joined.
"""

import argparse
import os
import shutil
import signal
import sys
import time
import warnings
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import cache, partial
from multiprocessing import get_context, parent_process
from pathlib import Path
from threading import Thread

from edge.terminal.progress_bar import progress
from firmware_bridge.pad_geometry import PADS, USPA44
from train.data.presses import PressSet, join_presses, load_presses
from train.data.world import LEAST_FORCE_N, World, solve_pad
from train.errors import DatasetError, ended_by_errors
from train.families.catalogue import SHARES
from train.surfaces.meshes import MESH, mesh_name, size_of
from train.surfaces.poses import SCHEDULES


def make_presses(world: World, path: Path) -> PressSet:
    """Solve the presses of a world, on all cores, and write them; an interrupted call resumes.

    Where there are several pads, call it from the main thread, and from a script only under its guard of `__main__`.
    DatasetError if files there were made otherwise.
    """
    facts = world.facts()
    if path.exists():
        if (there := load_presses(path)).config != facts:
            raise DatasetError(f"{path} exists and was made with other settings: delete it, or write to another file")
        return there
    folder = path.with_name(path.name + ".parts")
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / f"{number:06d}.npz" for number in range(world.chunks)]
    parts = {number: load_presses(path) for number, path in enumerate(paths) if path.exists()}
    if any(part.config != facts for part in parts.values()):
        raise DatasetError(f"{folder} holds parts that were made with other settings: delete it")
    missing = [number for number in range(world.chunks) if number not in parts]
    with progress("pads", world.chunks, "pad", done=world.chunks - len(missing)) as bar:
        solve = partial(solve_pad, world)
        solved = map(solve, missing) if len(missing) < 2 else _workers().map(solve, missing)
        for number, part in zip(missing, solved, strict=True):
            parts[number] = replace(part, config=facts)
            parts[number].save(paths[number])
            bar.update()
    if not any(map(len, parts.values())):
        raise DatasetError(f"every press of {path} came out lighter than {LEAST_FORCE_N} N: ask for more of them")
    made = replace(join_presses([parts[number] for number in range(world.chunks)]), config=facts)
    made.save(path)
    shutil.rmtree(folder)
    return made


@cache
def _workers() -> ProcessPoolExecutor:
    """Return processes for all cores, which ignore Ctrl-C: it reaches them too, and each would print a traceback."""
    count = len(os.sched_getaffinity(0))
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)  # inherited, so that no start is open to it either
    try:
        pool = ProcessPoolExecutor(count, get_context("spawn"), _begin_quietly)
        for _ in range(count):
            pool.submit(int)
    finally:
        signal.signal(signal.SIGINT, before)
    return pool


def _begin_quietly() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    Thread(target=_end_with_parent, daemon=True).start()
    # shapely divides by the length of an edge, and leaves out those without length afterwards.
    warnings.filterwarnings("ignore", category=RuntimeWarning, module="shapely")


def _end_with_parent() -> None:
    """End this process once the one that started it was killed, which tells its workers nothing."""
    if (parent := parent_process()) is not None:
        parent.join()
    os._exit(1)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line."""
    options = _parser().parse_args(arguments)
    started_s = time.monotonic()
    with ended_by_errors("train.data.make_presses"):
        world = _world(options)
        for name in world.families:
            if name.startswith(MESH):
                sys.stdout.write(f"{size_of(name)}\n")
        sys.stdout.flush()  # before the simulation, which takes long
        made = make_presses(world, options.out)
    rate = len(made) * made.taps / (time.monotonic() - started_s)
    sys.stdout.write(f"{options.out}: {len(made)} sequences, {rate:.0f} presses/s, sha256 {made.sha256()}\n")
    if len(made) < world.count:
        why = f"lighter than {LEAST_FORCE_N} N, or off the pattern"
        sys.stdout.write(f"{world.count - len(made)} of {world.count} presses left out: {why}\n")


def _world(options: argparse.Namespace) -> World:
    families = dict(SHARES)
    if options.families == "even":
        families = dict.fromkeys(SHARES, 1.0)
    elif options.families != "all":
        names = [name for name in options.families.split(",") if name != "none"]
        families = {name: SHARES.get(name, 1.0) for name in names}
    families |= {mesh_name(path, options.unit_mm): options.mesh_share for path in options.mesh}
    same = ("count", "taps", "schedule", "per_pad", "spread", "seed", "pad")
    return World(families=families, **{name: getattr(options, name) for name in same})


def _parser() -> argparse.ArgumentParser:
    about = (__doc__ or "").splitlines()[0]
    parser = argparse.ArgumentParser(prog="python -m train.data.make_presses", description=about)
    add = parser.add_argument
    add("out", type=Path, metavar="OUT.npz")
    add("--count", type=int, default=24_000, help="number of sequences (24000)")
    add("--taps", type=int, default=1, help="presses in each sequence (1)")
    schedules = f"poses of a sequence's presses: {', '.join(SCHEDULES)}, or turns:DEGREES (mixed)"
    add("--schedule", default="mixed", help=schedules)
    add("--per-pad", type=int, default=24, help="sequences of each pad (24)")
    families = f"names with commas: {', '.join(SHARES)}, or of figures of the paper (all)"
    add("--families", default="all", help=f"all; even (equally many of each); none; or {families}")
    add("--mesh", type=Path, action="append", default=[], metavar="FILE", help="STL, OBJ or PLY file to add")
    add("--unit-mm", type=float, default=1.0, help="unit of the meshes in mm: 25.4 for inches, 1000 for metres (1)")
    add("--mesh-share", type=float, default=20.0, help="frequency of each mesh; all families: 117 (20)")
    add("--spread", type=float, default=1.0, help="spread of the pads' constants; 0: the nominal pad (1)")
    add("--seed", type=int, default=1, help="seed of pads, shapes and drags (1)")
    models = ", ".join(pad.name for pad in PADS)
    add("--pad", default=USPA44.name, help=f"model of the pads: {models} ({USPA44.name})")
    return parser


if __name__ == "__main__":
    main()
