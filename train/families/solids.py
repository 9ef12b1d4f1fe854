"""Everyday solids under the pad: coins, nuts, screws, buttons, keys, caps, studs and the like."""

from collections.abc import Callable

import numpy as np

from train.families.shape import Height, Lengths, log_uniform, raised, where


def solid(rng: np.random.Generator) -> Height:
    """Draw one of the solids with random dimensions."""
    return _SOLIDS[int(rng.integers(len(_SOLIDS)))](rng)


def _coin(rng: np.random.Generator) -> Height:
    radius, rim = rng.uniform(6, 13), rng.uniform(0.6, 1.8)
    sunk, bust = rng.uniform(0.05, 0.2), rng.uniform(2, 5)

    def height(x: Lengths, y: Lengths) -> Lengths:
        away = np.hypot(x, y)
        face = np.where((away > radius - rim) | (np.hypot(x / 0.8, y) < bust), 0, -sunk)
        return where(away < radius, face)

    return height


def _washer(rng: np.random.Generator) -> Height:
    outer = rng.uniform(3, 10)
    inner = outer * rng.uniform(0.35, 0.65)
    return lambda x, y: raised((np.hypot(x, y) < outer) & (np.hypot(x, y) > inner), 1.0)


def _nut(rng: np.random.Generator) -> Height:
    flats, hole = rng.uniform(3, 7), rng.uniform(0.4, 0.6)

    def height(x: Lengths, y: Lengths) -> Lengths:
        away = np.hypot(x, y)
        return raised((_polygon_distance(x, y, 6) < flats) & (away > hole * flats), 2.0)

    return height


def _screw(rng: np.random.Generator) -> Height:
    radius, width, crossed = rng.uniform(3, 7), rng.uniform(0.8, 1.6), rng.random() < 0.5
    bulge = log_uniform(rng, 8, 100)

    def height(x: Lengths, y: Lengths) -> Lengths:
        away = np.hypot(x, y)
        cut = (abs(x) < width / 2) & ((abs(y) < 0.7 * radius) | (not crossed))
        if crossed:
            cut |= (abs(y) < width / 2) & (abs(x) < 0.7 * radius)
        return where((away < radius) & ~cut, -away * away / (2 * bulge))

    return height


def _button(rng: np.random.Generator) -> Height:
    radius, hole, apart = rng.uniform(4, 9), rng.uniform(0.6, 1.1), rng.uniform(1.2, 2.0)
    holes, rim = int(rng.choice([2, 4])), rng.uniform(0.1, 0.4)

    def height(x: Lengths, y: Lengths) -> Lengths:
        away = np.hypot(x, y)
        pierced = np.hypot(abs(x) - apart, y if holes == 2 else abs(y) - apart) < hole
        return where((away < radius) & ~pierced, np.where(away > 0.75 * radius, 0.0, -rim))

    return height


def _key(rng: np.random.Generator) -> Height:
    half, length = rng.uniform(2.5, 4.5), 30.0
    teeth = rng.uniform(0.2, 0.9, 9) * half
    groove = rng.uniform(0.5, 1.2)

    def height(x: Lengths, y: Lengths) -> Lengths:
        tooth = teeth[np.clip((y / 2.5 + 4).astype(int), 0, 8)]
        inside = (x > -half) & (x < tooth) & (abs(y) < length)
        return where(inside, np.where(abs(x + 0.4 * half) < groove / 2, -0.4, 0.0))

    return height


def _cap(rng: np.random.Generator) -> Height:
    radius, teeth, deep = rng.uniform(8, 16), int(rng.integers(30, 90)), rng.uniform(0.2, 0.6)

    def height(x: Lengths, y: Lengths) -> Lengths:
        turn = np.arcsin(np.clip(x / radius, -1, 1))
        ribbed = radius * np.cos(turn) - radius + deep / 2 * np.cos(teeth * turn)
        return where((abs(x) < 0.9 * radius) & (abs(y) < 7), ribbed)

    return height


def _studs(rng: np.random.Generator) -> Height:
    pitch = rng.uniform(4, 9)
    radius = pitch * rng.uniform(0.2, 0.36)

    def height(x: Lengths, y: Lengths) -> Lengths:
        place_x, place_y = x - pitch * np.round(x / pitch), y - pitch * np.round(y / pitch)
        return raised(np.hypot(place_x, place_y) < radius, 1.6)

    return height


def _thread(rng: np.random.Generator) -> Height:
    radius, pitch = rng.uniform(3, 12), rng.uniform(0.8, 3)

    def height(x: Lengths, y: Lengths) -> Lengths:
        lead = y / pitch + np.arcsin(np.clip(x / radius, -1, 1)) / (2 * np.pi)
        groove = 0.6 * pitch * abs(lead - np.floor(lead) - 0.5)
        return where(abs(x) < radius, np.sqrt(np.maximum(radius**2 - x * x, 0)) - radius - groove)

    return height


def _gear(rng: np.random.Generator) -> Height:
    radius, teeth, hole = rng.uniform(5, 11), int(rng.integers(8, 24)), rng.uniform(0.15, 0.4)

    def height(x: Lengths, y: Lengths) -> Lengths:
        away = np.hypot(x, y)
        outer = radius * (1 + 0.1 * np.sign(np.cos(teeth * np.arctan2(y, x))))
        return raised((away < outer) & (away > hole * radius), 2.0)

    return height


def _pen(rng: np.random.Generator) -> Height:
    radius, sides, clip = rng.uniform(3, 6), int(rng.choice([0, 6])), rng.random() < 0.4

    def height(x: Lengths, y: Lengths) -> Lengths:
        body = np.sqrt(np.maximum(radius**2 - x * x, 0)) - radius
        if sides:  # a pencil lies on one of its flats
            body = -np.maximum(abs(x) - 0.5 * radius, 0) * np.sqrt(3)
        body = np.where((abs(x) < 1.2) & clip & (y > -3), 0.8, body)
        return where(abs(x) < radius, body)

    return height


def _plug(rng: np.random.Generator) -> Height:
    apart, wide, long = rng.uniform(2.5, 8), rng.uniform(0.8, 1.8), rng.uniform(2, 7)
    pins = int(rng.choice([2, 3]))

    def height(x: Lengths, y: Lengths) -> Lengths:
        inside = (abs(abs(x) - apart) < wide) & (abs(y) < long / 2)
        return raised(inside | ((np.hypot(x, y - apart) < wide) & (pins == 3)), 3.0)

    return height


def _polygon_distance(x: Lengths, y: Lengths, sides: int) -> Lengths:
    """Return the distance from the centre to the side of a regular polygon through each place."""
    sector = 2 * np.pi / sides
    turn = np.arctan2(y, x)
    return np.hypot(x, y) * np.cos(turn - sector * np.round(turn / sector))


_SOLIDS: list[Callable[[np.random.Generator], Height]] = [
    *(_coin, _washer, _nut, _screw, _button, _key, _cap, _studs, _thread, _gear, _pen, _plug),
]
