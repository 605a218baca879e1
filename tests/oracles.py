"""Slow, plain references: what the fast functions must agree with, written from the definitions and sharing no code with them."""

from __future__ import annotations

import math

import numpy as np


def surfaces(disparity: np.ndarray) -> list[tuple[int, int]]:
    """First and last pixel of each run of neighbours whose disparities differ by at most 1 px."""
    runs, first = [], 0
    for x in range(1, len(disparity) + 1):
        if x == len(disparity) or not abs(disparity[x] - disparity[x - 1]) <= 1:
            runs.append((first, x - 1))
            first = x
    return runs


def disparity_at(disparity: np.ndarray, run: tuple[int, int], u: int) -> float | None:
    """The disparity of one surface where it covers right column u (its nearest point, where it is seen edge-on), else None."""
    first, last = run
    landing = {x: x - disparity[x] for x in range(first, last + 1)}
    found = []
    if landing[first] - 0.5 <= u <= landing[first]:
        found.append(disparity[first])
    if landing[last] <= u <= landing[last] + 0.5:
        found.append(disparity[last])
    for x in range(first, last):
        a, b = landing[x], landing[x + 1]
        if a <= u <= b:
            share = (u - a) / (b - a) if b > a else 1.0
            found.append(disparity[x] + share * (disparity[x + 1] - disparity[x]))
    return max(found, default=None)


def warp_row(disparity: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """One row: (hole, right disparity, non-occlusion), in float64."""
    disparity = disparity.astype(np.float64)
    width = len(disparity)
    runs = surfaces(disparity)
    right = np.full(width, -np.inf)
    for u in range(width):
        for run in runs:
            d = disparity_at(disparity, run, u)
            if d is not None:
                right[u] = max(right[u], d)
    hole = np.isinf(right)
    visible = np.zeros(width, bool)
    for x in range(width):
        u = round(x - disparity[x])  # half to even
        visible[x] = 0 <= u < width and not hole[u] and abs(right[u] - disparity[x]) <= 1
    return hole, np.where(hole, 0.0, right), visible


def nearest_sharp(disparity: np.ndarray, edge: np.ndarray) -> np.ndarray:
    """Every edge value replaced by the nearest other one: smallest distance, then nearest row, then the row above, then the left one."""
    height, width = disparity.shape
    free = [(y, x) for y in range(height) for x in range(width) if not edge[y, x]]
    result = disparity.copy()
    if free:
        for y in range(height):
            for x in range(width):
                if edge[y, x]:
                    best = min(free, key=lambda p: ((p[0] - y) ** 2 + (p[1] - x) ** 2, abs(p[0] - y), p[0] - y, p[1] - x))
                    result[y, x] = disparity[best]
    return result


def cubic(p: list[float], t: float) -> float:
    """At t between p[1] and p[2]: the line between them, less t (1 - t) times that between the second differences; by powers of t."""
    first, second = p[0] - 2 * p[1] + p[2], p[1] - 2 * p[2] + p[3]
    return p[1] + (p[2] - p[1] - first) * t + (2 * first - second) * t**2 + (second - first) * t**3


def is_permutation(values: list[int]) -> bool:
    return sorted(values) == list(range(len(values))) and not math.isnan(sum(values))
