"""Fig. 5: alpha and beta of the tactile PSF against the contact force, for two surfaces.

One network is trained on simulated taps of both surfaces, and evaluated on taps at other poses. Scans are clean,
because the question is the method's behaviour without noise. The network's beta is compared with the beta that explains
each scan best, by search: on a pad whose pressure is proportional to the indentation it has no reason to grow.

Source: Wu and Liu 2024, Fig. 4 and 5, Section IV-C, Eq. 4-10.
"""

from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from firmware_bridge.pad_geometry import USPA44
from train.experiments.workbench import Workbench
from train.families.family_shares import tap
from train.networks.tactile_psf import PsfNet, PsfParameters, fit_psf_net, pressed
from train.physics.gripped import FINE_SCALE, FRAMES, SCALE, GrippedPad, Taps
from train.physics.pad_draws import NOMINAL
from train.physics.tpsf import resample
from train.report import Report, Row
from train.surfaces.poses import random_poses

SURFACES: Final = ("large circle", "small circle")
"""Surfaces of the experiment; the first has four times the area of the second."""
_BINS: Final = 8


def fig5(bench: Workbench, report: Report) -> None:
    """Compare alpha and beta of the tactile PSF with the force: the paper's Fig. 5."""
    poses, epochs = (6, 5) if bench.quick else (60, 120)
    names, pad = [*SURFACES] * poses, GrippedPad(NOMINAL)
    places = random_poses(np.random.default_rng(5), len(names))
    taps = tap(pad, names, places, 5.0)
    held_out = np.arange(len(names)) // len(SURFACES) % 3 == 0
    counts, depth = _scans(taps, ~held_out)
    net = PsfNet()
    losses = fit_psf_net(net, counts, depth, taps.indentation_mm[~held_out].ravel(), epochs=epochs)

    counts, depth = _scans(taps, held_out)
    with torch.no_grad():
        scans, images = torch.from_numpy(counts), torch.from_numpy(depth)
        read = net(scans)
        reach = net.pattern(read, images).amax(dim=(1, 2)).numpy()
        z = pressed(scans)
        unexplained = float(((net.degraded(read, images) - z) ** 2).sum() / ((z - z.mean(dim=0)) ** 2).sum())
    seen = {
        "alpha": read.alpha.numpy() * float(net.k_scale),
        "beta": read.beta_mm.numpy(),
        "beta by search": _search(net, read, scans, images).numpy(),
    }
    surface = np.repeat(np.array(names)[held_out], taps.counts.shape[1])
    force_n, indentation_mm = taps.force_n[held_out].ravel(), taps.indentation_mm[held_out].ravel()

    rows: list[Row] = []
    lines: list[Row] = []
    for name in SURFACES:
        mine = surface == name
        rows += [{"surface": name} | row for row in _by_force(force_n[mine], {key: seen[key][mine] for key in seen})]
        lines += [
            {"surface": name, "parameter": key} | _line(force_n[mine], value[mine]) for key, value in seen.items()
        ]

    report.table(
        rows,
        "Alpha and beta by contact force at poses that the network has not seen: means, and the median of the betas "
        "found by search.",
    )
    report.table(lines, "Straight lines through them.")
    error = np.sqrt(np.mean((reach - indentation_mm) ** 2)) / indentation_mm.max()
    report.say(
        f"Training loss {losses[0]:.4g} at first, {losses[-1]:.4g} at last. On the held-out taps "
        f"{100 * unexplained:.1f} % of the variance of z is not explained, and the plateaus miss the indentations by "
        f"{100 * error:.1f} % of the largest. gamma = {float(read.gamma):.3g} mm^0.5, "
        f"k_scale = {float(net.k_scale):.3g} mm per (100 counts/mm^2)."
    )


def _scans(taps: Taps, which: NDArray[np.bool_]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return all frames of some taps: counts (n, 3, rows, cols), and depth images (n, H, W) in 0..1."""
    counts = taps.counts[which]
    depth = resample(taps.touching[which], FINE_SCALE, SCALE)
    return counts.reshape(-1, *USPA44.scan_shape), np.repeat(depth, counts.shape[1], axis=0)


def _search(net: PsfNet, read: PsfParameters, scans: Tensor, images: Tensor) -> Tensor:
    """Return the beta (n,) in [mm] that, with its best alpha, leaves the least of each scan unexplained.

    Gamma is the network's.
    """
    betas_mm = torch.linspace(0.1, 2.0, 39)
    wanted = pressed(scans).flatten(1)
    left: list[Tensor] = []
    for beta_mm in betas_mm:
        unit = PsfParameters(torch.ones(1), beta_mm[None], read.gamma)
        one = net.degraded(unit, images[::FRAMES]).flatten(1).repeat_interleave(FRAMES, dim=0)
        alpha = (one * wanted).sum(dim=1) / (one * one).sum(dim=1)
        left.append(((alpha[:, None] * one - wanted) ** 2).sum(dim=1))
    return betas_mm[torch.stack(left).argmin(dim=0)]


def _by_force(force_n: NDArray[np.floating], seen: dict[str, NDArray[np.floating]]) -> list[Row]:
    edges = np.linspace(0, force_n.max(), _BINS + 1)
    bin_of = np.clip(np.digitize(force_n, edges) - 1, 0, _BINS - 1)
    return [
        {
            "force N": float(force_n[inside].mean()),
            "alpha mm/mm2": float(seen["alpha"][inside].mean()),
            "beta mm": float(seen["beta"][inside].mean()),
            "beta by search mm": float(np.median(seen["beta by search"][inside])),
            "scans": int(inside.sum()),
        }
        for number in range(_BINS)
        if (inside := bin_of == number).any()
    ]


def _line(force_n: NDArray[np.floating], value: NDArray[np.floating]) -> Row:
    slope, start = np.polyfit(force_n, value, 1)
    left = np.mean((value - start - slope * force_n) ** 2)
    share = float(1 - left / max(np.var(value), 1e-30))
    return {"at no force": float(start), "slope per N": float(slope), "share explained": share}
