"""Round and rough shapes: domes, cylinders, cones, ridges, wires, saddles, reliefs and gratings."""

import numpy as np

from train.families.shape import Height, Lengths, log_uniform, where


def dome(rng: np.random.Generator) -> Height:
    """Draw a sphere of 3 to 300 mm radius."""
    radius = log_uniform(rng, 3, 300)
    return lambda x, y: _fall(np.hypot(x, y), radius)


def cylinder(rng: np.random.Generator) -> Height:
    """Draw a lying cylinder of 2 to 300 mm radius, some with an end."""
    radius, end = log_uniform(rng, 2, 300), rng.uniform(0, 9) if rng.random() < 0.3 else 1e3
    return lambda x, y: where(y < end, _fall(x, radius))


def cone(rng: np.random.Generator) -> Height:
    """Draw a cone of 2 to 45 degrees slope with a blunt tip."""
    slope, blunt = np.tan(np.radians(log_uniform(rng, 2, 45))), log_uniform(rng, 0.3, 3)
    return lambda x, y: (-slope * (np.sqrt(x * x + y * y + blunt**2) - blunt)).astype(np.float32)


def ridge(rng: np.random.Generator) -> Height:
    """Draw a roof of 2 to 45 degrees on either side with a blunt top, some with an end."""
    left, right = (np.tan(np.radians(log_uniform(rng, 2, 45))) for _ in range(2))
    blunt, end = log_uniform(rng, 0.1, 2), rng.uniform(0, 9) if rng.random() < 0.3 else 1e3

    def height(x: Lengths, y: Lengths) -> Lengths:
        slope = np.where(x > 0, right, left)
        return where(y < end, -slope * (np.sqrt(x * x + blunt**2) - blunt))

    return height


def wire(rng: np.random.Generator) -> Height:
    """Draw a straight or bent wire of .3 to 2 mm radius on a plate."""
    radius, bend = log_uniform(rng, 0.3, 2), rng.uniform(-0.06, 0.06) * (rng.random() < 0.5)

    def height(x: Lengths, y: Lengths) -> Lengths:
        across = (x - bend * y * y) / np.sqrt(1 + (2 * bend * y) ** 2)
        round_ = np.sqrt(np.maximum(radius**2 - across**2, 0)) + radius
        return np.where(abs(across) < radius, round_, 0).astype(np.float32) - 2 * radius

    return height


def saddle(rng: np.random.Generator) -> Height:
    """Draw a saddle or a bowl: two curvatures with independent signs, radii 8 to 300 mm."""
    across, along = log_uniform(rng, 8, 300), log_uniform(rng, 8, 300) * rng.choice([-1, 1])
    return lambda x, y: (-x * x / (2 * across) + y * y / (2 * along)).astype(np.float32)


def relief(rng: np.random.Generator) -> Height:
    """Draw a smooth random surface with waves of 4 to 20 mm and .05 to .6 mm RMS."""
    shortest, rms = log_uniform(rng, 4, 14), log_uniform(rng, 0.05, 0.6)
    waves = 24
    q = 2 * np.pi / rng.uniform(shortest, 2 * shortest, waves)
    turn, phase = rng.uniform(0, 2 * np.pi, (2, waves))
    size = rng.normal(0, rms * np.sqrt(2 / waves), waves)
    q_x, q_y = q * np.cos(turn), q * np.sin(turn)

    def height(x: Lengths, y: Lengths) -> Lengths:
        # The waves are separable in sines and cosines, which takes a fifth of the time of a sum over the grid.
        total = np.zeros(x.shape, dtype=np.float32)
        for wave in zip(q_x, q_y, phase, size, strict=True):
            total += np.float32(wave[3]) * np.sin(
                np.float32(wave[0]) * x + np.float32(wave[1]) * y + np.float32(wave[2])
            )
        return total

    return height


def grating(rng: np.random.Generator) -> Height:
    """Draw bars or waves with a period of 2.5 to 14 mm."""
    period, duty, depth = log_uniform(rng, 2.5, 14), rng.uniform(0.3, 0.7), log_uniform(rng, 0.1, 2)
    phase, wavy = rng.uniform(0, 1), rng.random() < 0.4

    def height(x: Lengths, y: Lengths) -> Lengths:
        place = x / period + phase
        if wavy:
            return (depth / 2 * np.cos(2 * np.pi * place)).astype(np.float32)
        return np.where(place - np.floor(place) < duty, np.float32(0), np.float32(-depth))

    return height


def _fall(distance: Lengths, radius: float) -> Lengths:
    """Return the height of a circle below its top at a distance from it; a straight wall below its equator."""
    square = radius**2 - distance**2
    return where(square > 0, np.sqrt(np.maximum(square, 0)) - radius)
