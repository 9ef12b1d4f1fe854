"""Findings of the guided press, and the mounting that corrects the sensor."""

from dataclasses import replace
from typing import Final

from edge.doctor.findings import Finding, Verdict
from edge.doctor.pad_orientation import AS_MAPPED, FEWEST_CORNERS, find_axes, find_order, orders, why_no_order, z_sign
from edge.doctor.press_guide import Answer
from firmware_bridge.pad_geometry import USPA44, SensorGeometry
from firmware_bridge.scans.mounting import Mounting

USUAL_COUNTS_PER_NEWTON: Final = (900.0, 1700.0)
"""Range of counts per newton, around the 1150 to 1370 of data sheets and of a fit."""
_AGAIN: Final = "press again: run the doctor once more"
_NORM: Final = "as the model expects: x right, y down, z up when pressed"


def judge_press(
    answer: Answer, kept: bool, weighed: bool, geometry: SensorGeometry = USPA44
) -> tuple[list[Finding], Mounting | None]:
    """Return the findings, and the mounting that they give; None while order or axes are not clear.

    Args:
        answer: of the guided press.
        kept: the results go into a sensor file, so that nothing is left to be done.
        weighed: a weight was asked for.
        geometry: of the sensor.
    """
    presses = answer.presses
    findings: list[Finding] = []
    mounting = None
    if len(presses) < FEWEST_CORNERS:
        measured = f"{len(presses)} of 4 corners measured"
        findings = [Finding(name, "not known", measured, "", _AGAIN) for name in ("taxel order", "axis signs")]
    else:
        turn = find_order(presses, geometry)
        axes, z = find_axes(presses, geometry), z_sign(presses)
        findings.append(_order_finding(turn, "" if turn else why_no_order(presses, geometry), kept))
        if axes is None or z is None:
            findings.append(_unclear_axes(sum(press.push_counts is not None for press in presses), z))
        else:
            count = geometry.taxel_count
            found = Mounting(swap_xy=axes.swap_xy, signs=(*axes.signs, z), taxel_count=count)
            findings.append(_axes_finding(found, kept))
            if turn is not None:
                mounting = replace(found, order=orders(geometry)[turn])
    if weighed:
        findings.append(_force_finding(answer.counts_per_newton, kept))
    return findings, mounting


def _order_finding(turn: str | None, why: str, kept: bool) -> Finding:
    norm = "each corner answers where it is pressed"
    if turn is None:
        remedy = "the id map has the taxels in another order than any turn of this pad: try another --id-map"
        return Finding("taxel order", "wrong", why, norm, remedy)
    if turn == AS_MAPPED:
        return Finding("taxel order", "ok", turn, norm)
    return Finding("taxel order", _settled(kept), turn, norm, _use(kept))


def _axes_finding(found: Mounting, kept: bool) -> Finding:
    if not found.turns_axes:
        return Finding("axis signs", "ok", "x right, y down, z up when pressed", _NORM)
    ways = [way for way, sign in zip(("x", "y", "z"), found.signs, strict=True) if sign < 0]
    parts = ["x and y swapped"] * found.swap_xy + [f"{', '.join(ways)} reversed"] * bool(ways)
    return Finding("axis signs", _settled(kept), " and ".join(parts), _NORM, _use(kept))


def _unclear_axes(pushes: int, z: int | None) -> Finding:
    if z is None:
        remedy = "z must do the same under every press: the pad was still loaded, or a taxel is reversed; press again"
        return Finding("axis signs", "wrong", "z rises under some presses and falls under others", _NORM, remedy)
    if pushes < FEWEST_CORNERS:
        remedy = f"push harder towards the middle while pressing; {_AGAIN}"
        return Finding("axis signs", "not known", f"{pushes} of 4 pushes measured", _NORM, remedy)
    remedy = f"push along the diagonal, towards the middle; {_AGAIN}"
    return Finding("axis signs", "wrong", "the corners contradict each other", _NORM, remedy)


def _force_finding(counts_per_newton: float | None, kept: bool) -> Finding:
    low, high = USUAL_COUNTS_PER_NEWTON
    norm = f"{low:.0f} to {high:.0f}"
    if counts_per_newton is None:
        return Finding("force", "not known", "no steady weight measured", norm, "lay it on the middle, hands off")
    measured = f"{counts_per_newton:.0f} counts per newton"
    if not low <= counts_per_newton <= high:
        remedy = "is the weight as heavy as --weight-g states, and does it lie on the pad alone?"
        return Finding("force", "look", measured, norm, remedy)
    return Finding(
        "force", "ok", measured, norm, "" if kept else f"edge-sr --counts-per-newton {counts_per_newton:.0f}"
    )


def _settled(kept: bool) -> Verdict:
    return "look" if kept else "wrong"


def _use(kept: bool) -> str:
    return (
        "the sensor file states this: run edge-sr with it"
        if kept
        else "write a sensor file, edge-sr doctor --out FILE, and run edge-sr --sensor FILE"
    )
