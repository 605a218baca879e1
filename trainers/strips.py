"""Images that do not fit into the memory, matched in strips of rows that overlap.

The views are rectified: a point and its match lie in one row, so that strips of whole rows lose no match at any disparity; tiles cut by
columns would. What a strip lacks is the rows above and below: those next to a cut are thrown away, and where two strips are left they
are blended. A matcher that looks at the whole image (an instance norm does) sees the strip alone, and differs a little.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

Predict = Callable[[Tensor, Tensor], Tensor]

CUT_ROWS = 32  # next to a cut: the network's padding shows there
BLEND_ROWS = 64
OVERLAP_ROWS = 2 * CUT_ROWS + BLEND_ROWS
LEAST_ROWS = 2 * OVERLAP_ROWS


def in_strips(predict: Predict, rows: int) -> Predict:
    """`predict` for images of any height, called with at most `rows` rows at a time.

    Raises:
        ValueError: fewer rows than an overlap needs.
    """
    if rows < LEAST_ROWS:
        raise ValueError(f"strips overlap by {OVERLAP_ROWS} rows and are at least {LEAST_ROWS} rows high; got {rows}")

    def predict_strips(left: Tensor, right: Tensor) -> Tensor:
        height = left.shape[-2]
        if height <= rows:
            return predict(left, right)
        weighted, weights = 0.0, torch.zeros(height, 1, device=left.device)
        for start in _starts(height, rows):
            strip = slice(start, start + rows)
            weight = _weight(rows, at_top=start == 0, at_bottom=start + rows == height).to(left.device)[:, None]
            prediction = predict(left[..., strip, :], right[..., strip, :]).float()
            weighted = weighted + torch.nn.functional.pad(weight * prediction, (0, 0, start, height - start - rows))
            weights[strip] += weight
        return weighted / weights

    return predict_strips


def _starts(height: int, rows: int) -> list[int]:
    """The first row of each strip: as few strips as the overlap allows, evenly spread, all as high as each other."""
    steps = -(-(height - rows) // (rows - OVERLAP_ROWS))
    return [step * (height - rows) // steps for step in range(steps + 1)]


def _weight(rows: int, at_top: bool, at_bottom: bool) -> Tensor:
    """How much each row of a strip counts: 0 next to a cut, then rising to 1; 1 towards the image's own border."""
    row = torch.arange(rows, dtype=torch.float32)
    weight = torch.ones(rows)
    for distance, border in ((row, at_top), (rows - 1 - row, at_bottom)):
        if not border:
            weight = torch.minimum(weight, ((distance - CUT_ROWS + 1) / BLEND_ROWS).clamp(0, 1))
    return weight
