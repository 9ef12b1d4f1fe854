"""Finding of the guided grips, and the gains of the pad."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from edge.doctor.findings import Finding
from edge.doctor.flat_grip_gains import load_table
from edge.doctor.flat_grip_guide import GRIPS, GuidedGrips
from edge.inference.bundled import FLAT_GRIPS
from firmware_bridge.pad_geometry import AXES
from firmware_bridge.scans.mounting import Mounting
from firmware_bridge.scans.pad_constants import GAINS, Pad

USUAL: Final = 0.25
"""Largest deviation of a gain from 1 on devices that are well."""
CLEAR: Final = 0.06
"""Largest RMS of the half widths, over the gains of one axis, at which they count as measured."""
_NORM: Final = f"within {100 * USUAL:.0f} % of 1, each within {100 * CLEAR:.0f} %"


def judge_grips(guide: GuidedGrips, found: Mounting | None, kept: bool) -> tuple[Finding, Pad | None]:
    """Return the finding, and the gains along the pad's axes; None where there were too few grips.

    Args:
        guide: of the guided grips.
        found: correction of the mounting by which the grips were read; None where it is not clear.
        kept: the results go into a sensor file.
    """
    if len(guide.grips) < GRIPS:
        why = f", {guide.refused}" if guide.refused else ""
        remedy = "grip something flat and larger than the pad, firmly: run the doctor once more"
        return Finding("gains", "not known", f"{len(guide.grips)} of {GRIPS} flat grips felt{why}", _NORM, remedy), None
    pad = load_table(FLAT_GRIPS).gains([_placed(grip, found or Mounting()) for grip in guide.grips])
    if pad is None or pad.gains is None or pad.gain_half_widths is None:
        remedy = "begin each grip lightly and end it firmly: run the doctor once more"
        return Finding("gains", "not known", "the grips did not grow", _NORM, remedy), None
    gains = np.asarray(pad.gains)
    widths = [f"{axis} {100 * width:.1f} %" for axis, width in zip(AXES, _widths(pad), strict=True)]
    measured = f"{gains.min():.2f} to {gains.max():.2f}, each within {', '.join(widths)}"
    if _widths(pad)[:2].max() > CLEAR:
        remedy = "push the object sideways while you grip it, one way and then across"
        return Finding("gains", "look", measured, _NORM, remedy), pad
    if np.abs(gains - 1).max() > USUAL:
        worst = int(np.abs(gains - 1).argmax())
        axis, taxel = divmod(worst, GAINS // len(AXES))
        remedy = f"taxel {taxel} reads {AXES[axis]} unlike the others: was the object flat, and is the taxel well?"
        return Finding("gains", "look", measured, _NORM, remedy), pad
    return Finding("gains", "ok", measured, _NORM, "" if kept else "keep them with --out FILE"), pad


def _placed(grip: NDArray[np.float32], found: Mounting) -> NDArray[np.float32]:
    """Return the readings of a grip (n, 3, rows, cols) by the corrected mounting, with z rising under pressure."""
    moved = grip.reshape(len(grip), len(AXES), -1)[..., list(found.order)].reshape(grip.shape)
    turned = np.array([found.correct(one) for one in moved])
    turned[:, AXES.index("z")] *= np.sign(turned[:, AXES.index("z")].mean())
    return turned


def _widths(pad: Pad) -> NDArray[np.float64]:
    """Return the RMS of the half widths of x, y and z."""
    return np.sqrt(np.square(pad.gain_half_widths or ()).reshape(len(AXES), -1).mean(axis=1))
