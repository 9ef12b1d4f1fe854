"""Faces of solid bodies: larger than the pad or crossing it with an edge, a corner, a slot or a step."""

import numpy as np

from train.families.shape import Height, Lengths, log_uniform, where

SLOPE = float(np.tan(np.radians(3.0)))
"""Largest tilt of a face against the pad: three degrees."""


def flat(rng: np.random.Generator) -> Height:
    """Return a face larger than the pad."""
    return lambda x, y: np.zeros_like(x)


def block(rng: np.random.Generator) -> Height:
    """Draw a rectangle of 3 to 40 mm with rounded corners."""
    wide, long = log_uniform(rng, 3, 40) / 2, log_uniform(rng, 3, 40) / 2
    corner = rng.uniform(0, 0.5) * min(wide, long)

    def height(x: Lengths, y: Lengths) -> Lengths:
        over_x, over_y = np.maximum(abs(x) - wide + corner, 0), np.maximum(abs(y) - long + corner, 0)
        return where(over_x**2 + over_y**2 <= corner**2 + 1e-9, 0.0)

    return height


def edge(rng: np.random.Generator) -> Height:
    """Draw a half plane; half of the edges are rounded."""
    radius = float(rng.choice([0.0, log_uniform(rng, 0.3, 5.0)]))

    def height(x: Lengths, y: Lengths) -> Lengths:
        over = np.maximum(x + radius, 0)
        if not radius:
            return where(x <= 0, 0.0)
        return where(over <= radius, np.sqrt(np.maximum(radius**2 - over**2, 0)) - radius)

    return height


def corner(rng: np.random.Generator) -> Height:
    """Draw a corner of 50 to 150 degrees, convex or cut out."""
    half, cut = np.radians(rng.uniform(50, 150)) / 2, rng.random() < 0.3

    def height(x: Lengths, y: Lengths) -> Lengths:
        inside = abs(y) * np.cos(half) <= -x * np.sin(half)
        return where(~inside if cut else inside, 0.0)

    return height


def slot(rng: np.random.Generator) -> Height:
    """Draw a face with one or two parallel slots of 1 to 8 mm."""
    width, depth = log_uniform(rng, 1, 8), log_uniform(rng, 0.1, 5)
    second = rng.uniform(4, 12) if rng.random() < 0.4 else 1e3

    def height(x: Lengths, y: Lengths) -> Lengths:
        inside = (abs(x) < width / 2) | (abs(x - second) < width / 2)
        return np.where(inside, np.float32(-depth), np.float32(0))

    return height


def step(rng: np.random.Generator) -> Height:
    """Draw two faces side by side, one .05 to .5 mm lower."""
    drop = log_uniform(rng, 0.05, 0.5)
    return lambda x, y: np.where(x > 0, np.float32(-drop), np.float32(0))
