"""Backward warp: the left view, looked up in the right image."""

from __future__ import annotations

import torch
from torch import Tensor


def backward_warp(image: Tensor, disparity: Tensor, mode: str = "bilinear", padding: str = "border") -> Tensor:
    """Samples `image` of the right view at (x - d, y) for every left pixel (x, y).

    The columns are computed in pixels and gathered, so that a whole-numbered disparity copies values bit by bit.
    Differentiable in `image` and, with "bilinear", in `disparity` (zero where the column is clamped to the border).

    Args:
        image: [B, C, H, W], right view. Floating point for "bilinear"; any dtype, bool masks too, for "nearest".
        disparity: [B, 1, H, W] floating point, pixels, left view, positive to the left. May be negative.
        mode: "bilinear" between two columns, or "nearest" (a column half way goes to the even neighbour).
        padding: what lies beside the image: "border" repeats its first and last column, "zeros" is 0 (False).
            The ZeroStereo loss warps images with "border" and masks with "zeros".
    Returns:
        [B, C, H, W] in the dtype of `image`. A NaN disparity gives NaN with "bilinear", the first column with "nearest" and
        "border", and 0 (False) with "nearest" and "zeros".
    Raises:
        ValueError, TypeError: a shape, dtype, mode or padding other than the above.
    """
    _check(image, disparity, mode, padding)
    width = image.shape[-1]
    exact = torch.promote_types(disparity.dtype, torch.float32)  # half precision cannot count the columns of a wide image
    x = torch.arange(width, device=disparity.device, dtype=exact) - disparity.to(exact)
    # Beyond one column outside there is nothing more to see; the clamp also makes infinite disparities harmless.
    x = x.clamp(0, width - 1) if padding == "border" else x.clamp(-1, width)

    def column(index: Tensor) -> Tensor:
        values = image.gather(3, index.long().clamp(0, width - 1).expand(-1, image.shape[1], -1, -1))
        if padding == "border":
            return values
        inside = (index >= 0) & (index < width)
        return torch.where(inside, values, torch.zeros((), dtype=image.dtype, device=image.device))

    if mode == "nearest":
        return column(x.round())
    before = x.detach().floor()
    return torch.lerp(column(before), column(before + 1), (x - before).to(image.dtype))


def _check(image: Tensor, disparity: Tensor, mode: str, padding: str) -> None:
    if mode not in ("bilinear", "nearest"):
        raise ValueError(f'mode is "bilinear" or "nearest"; got {mode!r}')
    if padding not in ("border", "zeros"):
        raise ValueError(f'padding is "border" or "zeros"; got {padding!r}')
    if image.ndim != 4 or disparity.shape != (image.shape[0], 1, *image.shape[2:]):
        raise ValueError(
            f"backward_warp takes an image [B, C, H, W] and a disparity [B, 1, H, W]; got {list(image.shape)} and {list(disparity.shape)}"
        )
    if not disparity.is_floating_point():
        raise TypeError(f"disparity is floating point, in pixels; got {disparity.dtype}")
    if mode == "bilinear" and not image.is_floating_point():
        raise TypeError(f'a {image.dtype} image cannot be interpolated; use mode="nearest" or convert it to float')
