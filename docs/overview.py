"""Draw overview.svg: the taxels' readings in four taps, the pattern of MTSR-4, and the truth.

python docs/overview.py
"""

from pathlib import Path
from typing import Final

import numpy as np
from matplotlib import colormaps
from numpy.typing import NDArray

from edge.evaluation.metrics import psnr_db
from edge.inference.bundled import POSED_MODEL, demo_recording, find_model
from edge.inference.onnx_session import ModelSession

SIDE_PX: Final = 180
SMALL_PX: Final = 80
GAP_PX: Final = 24


def squares(values: NDArray[np.floating], high: float, left: float, top: float, side: float) -> str:
    """Return a map (H, W) as rectangles, with runs of one colour joined."""
    rgb = np.rint(255 * colormaps["viridis"](np.clip(values / high, 0, 1))[..., :3]).astype(int)
    height, width = values.shape
    parts = []
    for row in range(height):
        start = 0
        for col in range(1, width + 1):
            if col == width or (rgb[row, col] != rgb[row, start]).any():
                red, green, blue = rgb[row, start]
                parts.append(
                    f'<rect x="{left + start * side / width:.1f}" y="{top + row * side / height:.1f}" '
                    f'width="{(col - start) * side / width + 0.3:.1f}" height="{side / height + 0.3:.1f}" '
                    f'fill="#{red:02x}{green:02x}{blue:02x}"/>'
                )
                start = col
    return "".join(parts)


def arrows(shear: NDArray[np.floating], left: float, top: float, side: float) -> str:
    """Return shear (2, rows, cols) as lines from the taxels' centres."""
    _, rows, cols = shear.shape
    length = 0.45 * side / cols / np.abs(shear).max()
    parts = []
    for row in range(rows):
        for col in range(cols):
            x, y = left + (col + 0.5) * side / cols, top + (row + 0.5) * side / rows
            dx, dy = shear[:, row, col] * length
            parts.append(f'<path d="M{x:.1f} {y:.1f}l{dx:.1f} {dy:.1f}" stroke="#fff" stroke-width="1.5"/>')
            parts.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="1.6" fill="#fff"/>')
    return "".join(parts)


def caption(text: str, x: float, y: float) -> str:
    """Return a centred line of text."""
    return f'<text x="{x:.0f}" y="{y:.0f}" text-anchor="middle">{text}</text>'


def main() -> None:
    """Write the picture next to this file."""
    with np.load(demo_recording(), allow_pickle=False) as demo:
        tap, depth_mm, counts = demo["tap"], demo["indentation_mm"], demo["counts"]
        truth_mm, angles = demo["unit_patterns"].astype(np.float32), demo["angles_deg"]
    rest = np.median(counts[: np.argmax(tap >= 0)], axis=0)
    peaks = [int(np.argmax(np.where(tap == k, depth_mm, -1))) for k in range(len(angles))]
    felt = np.stack([counts[frame] - rest for frame in peaks]).astype(np.float32)
    session = ModelSession(find_model(POSED_MODEL))
    pattern = session.run(session.contract.scale_window(felt[::-1].copy()))
    truth = truth_mm[-1] * depth_mm[peaks[-1]]
    error_db = float(psnr_db(pattern, truth, session.contract.output_full_scale))

    taps_width = 2 * SMALL_PX + GAP_PX / 2
    parts = []
    for k, angle in enumerate(angles):
        left = GAP_PX + (k % 2) * (SMALL_PX + GAP_PX / 2)
        top = GAP_PX + (k // 2) * (SMALL_PX + GAP_PX)
        parts.append(squares(np.maximum(felt[k, 2], 0), float(felt[:, 2].max()), left, top, SMALL_PX))
        parts.append(arrows(felt[k, :2], left, top, SMALL_PX))
        parts.append(caption(f"tap {k + 1}, {angle:.0f}\N{DEGREE SIGN}", left + SMALL_PX / 2, top + SMALL_PX + 15))
    left = GAP_PX + taps_width + GAP_PX
    middle = GAP_PX + SIDE_PX / 2
    parts.append(f'<path d="M{left} {middle}h40m-9 -7l9 7l-9 7" stroke="#777" stroke-width="2.5" fill="none"/>')
    left += 40 + GAP_PX
    high = float(max(pattern.max(), truth.max()))
    for image, text in ((pattern, f"MTSR, 40 x 40: {error_db:.1f} dB"), (truth, "truth")):
        parts.append(squares(image, high, left, GAP_PX, SIDE_PX))
        parts.append(caption(text, left + SIDE_PX / 2, GAP_PX + SIDE_PX + 18))
        left += SIDE_PX + GAP_PX
    height = GAP_PX + SIDE_PX + 34
    head = f'<svg xmlns="http://www.w3.org/2000/svg" width="{left:.0f}" height="{height}" '
    style = 'font-family="sans-serif" font-size="13" fill="#777" shape-rendering="crispEdges"'
    svg = f'{head}viewBox="0 0 {left:.0f} {height}" {style}>{"".join(parts)}</svg>\n'
    Path(__file__).with_name("overview.svg").write_text(svg)


if __name__ == "__main__":
    main()
