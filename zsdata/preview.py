"""The contact sheet: pairs as a person looks at them, one row each."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from torch import Tensor

from zsdata.sample import StereoBatch

COLUMNS = (  # title, what its colours mean
    ("left", "as the matcher sees it"),
    ("right", "as the matcher sees it"),
    ("disparity", "left view"),
    ("confidence", "left view; black is 0, white is 1"),
    ("masks.nonocclusion", "left view; orange: hidden in the right"),
    ("masks.inpaint", "right view; magenta: invented"),
)
NARROWEST_COLUMN_PX = 400  # room for the captions of small pairs
COLUMN_PER_TEXT_HEIGHT = 30  # so that the text grows with the pictures and stays readable when a sheet is scaled down to a screen
PAPER, FRAME, INK, PALE_INK = (255, 255, 255), (190, 190, 190), (32, 32, 32), (100, 100, 100)  # RGB, as all colours here
HIDDEN, INVENTED = (255, 110, 0), (235, 0, 200)
TINT = 0.7  # opacity of a marked pixel: the picture shows through


def contact_sheet(pairs: Sequence[StereoBatch]) -> np.ndarray:
    """One row per pair: left, right, disparity, confidence and both masks, with where the sample came from.

    The pictures are the pairs' own pixels, not scaled. Disparity is coloured from the smallest to the largest of its pair (blue is far, red
    near, black is no label), confidence from black (0) to white (1).

    Args:
        pairs: single pairs, without a batch axis, all of one size; on any device.
    Returns:
        uint8 [H, W, 3], RGB.
    """
    if not pairs:
        raise ValueError("a contact sheet needs at least one pair, got none")
    sizes = {tuple(pair.left.shape) for pair in pairs}
    if len(sizes) > 1 or len(min(sizes)) != 3:
        raise ValueError(f"a contact sheet takes single pairs [3, H, W] of one size; got {sorted(sizes)}")
    layout = _Layout(width=pairs[0].left.shape[-1])
    return np.concatenate([layout.titles(), *(layout.row(pair.to("cpu")) for pair in pairs)])


class _Layout:
    """Where things stand on the sheet, in pixels."""

    def __init__(self, width: int) -> None:
        self.column = max(width, NARROWEST_COLUMN_PX)
        self.text = round(self.column / COLUMN_PER_TEXT_HEIGHT)  # height of a capital letter
        self.line = round(1.9 * self.text)
        self.gap = self.text
        self.sheet_width = self.gap + len(COLUMNS) * (self.column + self.gap)

    def left_edge(self, column: int) -> int:
        return self.gap + column * (self.column + self.gap)

    def paper(self, height: int) -> np.ndarray:
        return np.full((height, self.sheet_width, 3), PAPER, np.uint8)

    def titles(self) -> np.ndarray:
        strip = self.paper(2 * self.gap + 2 * self.line)
        for column, (title, meaning) in enumerate(COLUMNS):
            self.write(strip, title, self.left_edge(column), self.gap, self.column, bold=True)
            self.write(strip, meaning, self.left_edge(column), self.gap + self.line, self.column, ink=PALE_INK)
        return strip

    def row(self, pair: StereoBatch) -> np.ndarray:
        """The sample's identity, its pictures, and a caption below each."""
        head = self.paper(self.gap // 2 + self.line)
        self.write(head, _identity(pair.meta), self.gap, self.gap // 2, self.sheet_width - 2 * self.gap)
        tiles = _pictures(pair)
        height = tiles[0].shape[0]
        body = self.paper(height + self.gap // 2 + self.line + self.gap)
        for column, (tile, caption) in enumerate(zip(tiles, _captions(pair), strict=True)):
            x = self.left_edge(column)
            width = tile.shape[1]
            body[:height, [x - 1, x + width]] = FRAME
            body[height, x - 1 : x + width + 1] = FRAME
            head[-1, x - 1 : x + width + 1] = FRAME
            body[:height, x : x + width] = tile
            self.write(body, caption, x, height + self.gap // 2, self.column, ink=PALE_INK)
        return np.concatenate([head, body])

    def write(
        self, image: np.ndarray, text: str, x: int, y: int, width: int, *, bold: bool = False, ink: tuple[int, int, int] = INK
    ) -> None:
        """One line of text, its capitals' tops at y; made smaller where it would be wider than `width`."""
        font = cv2.FONT_HERSHEY_DUPLEX if bold else cv2.FONT_HERSHEY_SIMPLEX
        text = text.encode("ascii", "backslashreplace").decode()  # OpenCV's fonts have no more
        (_, height_at_1), _ = cv2.getTextSize("H", font, 1.0, 1)
        scale = self.text / height_at_1
        (text_width, _), _ = cv2.getTextSize(text, font, scale, 1)
        scale *= min(1.0, width / max(1, text_width))
        cv2.putText(image, text, (x, y + self.text), font, scale, ink, 1, cv2.LINE_AA)


def _pictures(pair: StereoBatch) -> list[np.ndarray]:
    left, right = _rgb(pair.left), _rgb(pair.right)
    return [
        left,
        right,
        _colored(pair.disparity[0].numpy(), pair.masks.valid[0].numpy()),
        _rgb(pair.confidence.expand(3, -1, -1) * 255),
        _tinted(_rgb(pair.left_clean), ~pair.masks.nonocclusion[0].numpy(), HIDDEN),
        _tinted(_rgb(pair.right_clean), pair.masks.inpaint[0].numpy(), INVENTED),
    ]


def _captions(pair: StereoBatch) -> list[str]:
    disparity = pair.disparity[pair.masks.valid]
    reach = f"{disparity.min():.1f} (blue) to {disparity.max():.1f} px (red)" if disparity.numel() else "no label"
    height, width = pair.meta["photo_size"]
    return [
        f"of a photo of {width} x {height} px" + (", mirrored" if pair.meta["mirror"] else ""),
        f"shift up to {100 * pair.meta['disparity_scale']:.1f} % of the photo's width",
        reach,
        f"mean {pair.confidence.mean():.2f}; flip consistency {pair.meta['flip_consistency']:.3f}",
        f"{_share(~pair.masks.nonocclusion)} hidden",
        f"{_share(pair.masks.inpaint)} invented",
    ]


def _identity(meta: dict) -> str:
    return (
        f"{meta['source']}: {meta['key']} in {meta['shard'].rpartition('/')[2]}   "
        f"epoch {meta['epoch']}, index {meta['index']}, seed {meta['seed']}"
    )


def _share(mask: Tensor) -> str:
    return f"{100 * mask.count_nonzero().item() / mask.numel():.1f} %"


def _rgb(image: Tensor) -> np.ndarray:
    """float32 [3, H, W] 0..255 to uint8 [H, W, 3]."""
    return (image + 0.5).clamp(0, 255).byte().permute(1, 2, 0).numpy()


def _colored(disparity: np.ndarray, valid: np.ndarray) -> np.ndarray:
    low, high = (disparity[valid].min(), disparity[valid].max()) if valid.any() else (0, 1)
    level = np.clip((disparity - low) / max(high - low, 1e-6) * 255, 0, 255).astype(np.uint8)
    colored = cv2.applyColorMap(level, cv2.COLORMAP_TURBO)[..., ::-1].copy()
    colored[~valid] = 0
    return colored


def _tinted(image: np.ndarray, marked: np.ndarray, color: tuple[int, int, int]) -> np.ndarray:
    """The picture in grey, so that no colour of its own looks like the mark."""
    tinted = cv2.cvtColor(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), cv2.COLOR_GRAY2RGB)
    tinted[marked] = ((1 - TINT) * tinted[marked] + TINT * np.array(color) + 0.5).astype(np.uint8)
    return tinted
