"""What a stream's pairs are like, source by source: how large their disparities, how much is hidden, how well label and images agree."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from zsdata.metrics import reconstruction_error
from zsdata.sample import StereoBatch
from zsdata.stream import ZeroStereoStream


@dataclass(frozen=True, kw_only=True)
class SourceStatistics:
    """Means over the pairs of one source; of `mean_px` and `max_px` see the paper's table "Disparity statistics results based on ADS".

    Attributes:
        pairs: how many were looked at.
        mean_px, max_px: the mean disparity over all pixels of all pairs, and the largest one.
        mean_share, max_share: the same as shares of the pair's width.
        hidden: share of the left pixels that the right image does not show.
        invented: share of the right pixels that no left pixel shows.
        flip_consistency: how much of the depth survives mirroring the photo, 0..1.
        abs_err, ssim, photometric: how well the left image is reconstructed from the right one, over whole images (see
            `zsdata.metrics.reconstruction_error`).
    """

    pairs: int
    mean_px: float
    max_px: float
    mean_share: float
    max_share: float
    hidden: float
    invented: float
    flip_consistency: float
    abs_err: float
    ssim: float
    photometric: float


def source_statistics(stream: ZeroStereoStream, pairs: int, progress: Callable[[], object] = lambda: None) -> dict[str, SourceStatistics]:
    """Statistics of the stream's next pairs, by source; sources that none of them comes from are left out.

    Args:
        stream: best with `size=None` and `AugmentConfig.none()`: then the figures are those of whole photos, as the paper has them.
        pairs: how many to look at, at most those left of the epoch.
        progress: called after each pair.
    """
    found: dict[str, list[dict[str, float]]] = {}
    for _, pair in zip(range(pairs), stream, strict=False):
        found.setdefault(pair.meta["source"], []).append(_figures(pair))
        progress()
    return {name: _summary(rows) for name, rows in sorted(found.items())}


def _figures(pair: StereoBatch) -> dict[str, float]:
    width = pair.disparity.shape[-1]
    quality = reconstruction_error(pair.left_clean[None], pair.right_clean[None], pair.disparity[None])
    return {
        "pixels": pair.disparity.numel(),
        "mean_px": float(pair.disparity.double().mean()),
        "max_px": float(pair.disparity.max()),
        "mean_share": float(pair.disparity.double().mean()) / width,
        "max_share": float(pair.disparity.max()) / width,
        "hidden": 1 - float(pair.masks.nonocclusion.double().mean()),
        "invented": float(pair.masks.inpaint.double().mean()),
        "flip_consistency": pair.meta["flip_consistency"],
        "abs_err": float(quality.abs_err),
        "ssim": float(quality.ssim),
        "photometric": float(quality.photometric),
    }


def _summary(rows: list[dict[str, float]]) -> SourceStatistics:
    means = {name: sum(row[name] for row in rows) / len(rows) for name in rows[0] if name != "pixels"}
    pixels = sum(row["pixels"] for row in rows)
    return SourceStatistics(
        pairs=len(rows),
        **{
            **means,
            "mean_px": sum(row["mean_px"] * row["pixels"] for row in rows) / pixels,
            "max_px": max(row["max_px"] for row in rows),
            "max_share": max(row["max_share"] for row in rows),
        },
    )
