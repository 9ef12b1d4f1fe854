"""Finite-element results of a press, computed once and kept with the reports, because each surface takes minutes."""

import hashlib
import json
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from firmware_bridge.pad_geometry import USPA44
from train.physics.elastic_layer import Layer
from train.physics.mooney_rivlin import C2_SHARE
from train.surfaces.depth_image import Pose, Relief, depth_image
from train.surfaces.named_surfaces import surface_mesh

SCALE: Final = 10
"""Patterns are compared at 40 x 40, as in the paper."""
CENTRE: Final = Pose(0.0, 0.0, 0.0)
"""Position 5, rotation 0 of the paper."""
_EDITION: Final = 1
"""Edition of kept results; raise it when the results of train.physics.fem_reference change."""


class Mesh(NamedTuple):
    """Fineness of the elements: nodes per taxel pitch, and elements over the thickness."""

    scale: int
    cells_high: int

    def __str__(self) -> str:
        return f"{self.scale} nodes a pitch, {self.cells_high} high"


FINEST: Final = Mesh(10, 8)
"""Mesh whose nodes are the pixels of the 40 x 40 pattern."""
REFERENCE_POISSON: Final = 0.495
"""Poisson's ratio of rubber. The layer's own value is lower to account for free sides, which the elements have."""


@dataclass(frozen=True, slots=True)
class Verdict:
    """Equilibria of one press at `s` indentations.

    Attributes:
        patterns_mm: (s, 40, 40), in [mm].
        force_n: (s,), in [N].
        newton_steps: (s,), linear systems solved.
        residual: (s,), force out of balance as a share of the reactions.
        run_s: (s,), computation time, in [s].
    """

    patterns_mm: NDArray[np.float32]
    force_n: NDArray[np.float32]
    newton_steps: NDArray[np.int64]
    residual: NDArray[np.float32]
    run_s: NDArray[np.float32]


def press_or_recall(surface: str, mesh: Mesh, indentation_mm: NDArray[np.floating], folder: Path) -> Verdict:
    """Press a surface into the middle of the finite elements, or load the kept result.

    Args:
        surface: its name.
        mesh: fineness of the elements.
        indentation_mm: (s,), rising, in [mm].
        folder: where results are kept, made if absent.

    Raises:
        NoEquilibriumError: a step did not converge.
        ModuleNotFoundError: nothing is kept, and FElupe is not installed.
    """
    layer = LAYER
    question = {
        "edition": _EDITION,
        "surface": surface,
        "mesh": mesh,
        "pose": asdict(CENTRE),
        "indentation_mm": np.round(indentation_mm, 6).tolist(),
        "layer": asdict(layer),
        "c2_share": C2_SHARE,
        "geometry": asdict(USPA44),
    }
    path = folder / f"fem-{hashlib.sha256(json.dumps(question).encode()).hexdigest()[:16]}.npz"
    if not path.exists():
        folder.mkdir(parents=True, exist_ok=True)
        _keep(path, _work_out(surface, mesh, indentation_mm, layer))
    with np.load(path, allow_pickle=False) as kept:
        return Verdict(kept["patterns_mm"].astype(np.float32), *(kept[name] for name in _FIGURES))


def relief(surface: str) -> Relief:
    """Return a named surface as a relief."""
    return Relief(surface, surface_mesh(surface))


LAYER: Final = replace(Layer(), poisson=REFERENCE_POISSON)
"""Layer of the pad as it is modelled by the finite elements."""
_FIGURES: Final = ("force_n", "newton_steps", "residual", "run_s")


def _work_out(surface: str, mesh: Mesh, indentation_mm: NDArray[np.floating], layer: Layer) -> Verdict:
    from train.physics.fem_reference import FemPad  # here, because kept results need no FElupe

    pad = FemPad(*mesh, layer)
    presses = pad.press(depth_image(relief(surface), CENTRE, pad.size, pad.cell_mm), indentation_mm)
    return Verdict(
        pad.pattern(presses.displacement_mm, SCALE),
        presses.force_n.astype(np.float32),
        presses.newton_steps,
        presses.residual.astype(np.float32),
        presses.run_s.astype(np.float32),
    )


def _keep(path: Path, verdict: Verdict) -> None:
    """Save a result in half precision: 0.05 % of a displacement, a tenth of the mesh's own error."""
    figures = {name: getattr(verdict, name) for name in _FIGURES}
    unfinished = path.with_suffix(".part.npz")  # a run that is stopped leaves no half result under the name
    np.savez_compressed(unfinished, patterns_mm=verdict.patterns_mm.astype(np.float16), **figures)
    unfinished.rename(path)
