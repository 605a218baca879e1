"""The scores of a disparity map, counted pixel by pixel in plain Python."""

from __future__ import annotations

import math

import numpy as np

NAMES = ("epe", "bad_0.5", "bad_1", "bad_2", "bad_3", "d1")


def plain_scores(prediction: np.ndarray, truth: np.ndarray, counted: np.ndarray | None = None) -> dict[str, float | int | None]:
    """Scores over the pixels that have a ground truth (finite and above 0) and, if given, where `counted` is True."""
    errors = []
    for y in range(truth.shape[0]):
        for x in range(truth.shape[1]):
            true = float(truth[y, x])
            if math.isfinite(true) and true > 0 and (counted is None or counted[y, x]):
                errors.append((abs(float(prediction[y, x]) - true), true))
    if not errors:
        return {"pixels": 0, **dict.fromkeys(NAMES)}
    bad = {f"bad_{limit:g}": sum(error > limit for error, _ in errors) / len(errors) for limit in (0.5, 1, 2, 3)}
    outliers = sum(error > 3 and error / true > 0.05 for error, true in errors)
    return {"pixels": len(errors), "epe": sum(error for error, _ in errors) / len(errors), **bad, "d1": outliers / len(errors)}


def plain_edges(disparity: np.ndarray, valid: np.ndarray, jump: float = 2.0, reach: int = 4, margin: int = 5) -> np.ndarray:
    """Where the scene has a depth edge: from each known pixel to the next known one in its row and in its column."""
    height, width = disparity.shape
    edges = np.zeros((height, width), bool)

    def mark(y: int, x: int) -> None:
        for row in range(max(0, y - margin), min(height, y + margin + 1)):
            for column in range(max(0, x - margin), min(width, x + margin + 1)):
                edges[row, column] = True

    for y in range(height):
        for x in range(width):
            if not valid[y, x]:
                continue
            for down, right in ((0, 1), (1, 0)):
                for step in range(1, reach + 1):
                    there = (y + step * down, x + step * right)
                    if there[0] >= height or there[1] >= width:
                        break
                    if valid[there]:
                        if abs(float(disparity[there]) - float(disparity[y, x])) > jump:
                            mark(y, x)
                            mark(*there)
                        break
    return edges
