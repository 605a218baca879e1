"""What a camera does to a picture: exposure, optics, sensor, colour, as batched tensor functions.

Every function takes images as float32 [N, 3, H, W], 0..255, and parameters with one row per image, and returns new images of the same
shape and range on the same device. Nothing is drawn here, and nothing is written into an argument. The arithmetic is per pixel, or
sums whole numbers exactly, so an image comes out bit-identical whatever it is batched with and however many threads work on it.

kornia gives the luma. Its other operations were weighed and left, each for a reason:

* `adjust_hue` goes through a full HSV image: eight times the time of `rotate_hue`, more than all the rest of the augmentation together;
* `adjust_contrast_with_mean_subtraction` takes the mean by a float sum, whose value depends on the order of the sum;
* `adjust_gamma` calls `pow`, whose last bit differs between the vectorised part of a tensor and its tail;
* `gaussian_blur2d` is a convolution on a GPU, in TF32 by default: it would move pixels by a tenth of a grey level;
* `remap` and `warp_affine` go through normalised coordinates, so that a shift by whole pixels is not exact;
* the random noise and erasing modules draw from the global generator.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence

import torch
import torch.nn.functional as F
from kornia.color import rgb_to_grayscale
from torch import Tensor


def shift_rows(images: Tensor, shift_px: Tensor) -> Tensor:
    """Row y of the result is row y + shift_px of the image; the border row repeats. `shift_px`: int64 [N]."""
    N, C, H, W = images.shape
    rows = torch.arange(H, device=images.device)
    source = (rows + shift_px[:, None]).clamp(0, H - 1)  # [N, H]
    plane = torch.arange(N * C, device=images.device).view(N, C, 1) * H
    return images.reshape(N * C * H, W).index_select(0, (plane + source[:, None]).flatten()).view(N, C, H, W)


def misalign_rows(images: Tensor, offset_px: Tensor, edge_x_px: Tensor, edge_y_px: Tensor) -> Tensor:
    """The vertical part of a rectification error: pixel (x, y) of the result is (x, y + dy) of the image, linear along y.

    dy = offset_px + edge_x_px * (x - cx) / cx + edge_y_px * (y - cy) / cy, with (cx, cy) the middle of the image. The second term is a
    rotation or vertical shear, the third a difference in vertical scale; both are given in pixels at the edge. The horizontal part of a
    rotation is left out: it would be a change of the disparity, and the label would be wrong.

    Args:
        offset_px, edge_x_px, edge_y_px: [N]. The border row repeats.
    """
    H, W = images.shape[-2:]

    def from_middle(length: int) -> Tensor:  # -1 at the first pixel, 1 at the last
        middle = (length - 1) / 2
        return (torch.arange(length, device=images.device, dtype=images.dtype) - middle) / max(middle, 1)

    horizontal = edge_x_px[:, None] * from_middle(W)
    vertical = offset_px[:, None] + edge_y_px[:, None] * from_middle(H)
    dy = horizontal[:, None, None, :] + vertical[:, None, :, None]  # [N, 1, H, W]
    whole = dy.floor()
    upper = torch.arange(H, device=images.device).view(1, 1, H, 1) + whole.long()
    part = dy - whole
    above, below = (images.gather(2, row.clamp(0, H - 1).expand_as(images)) for row in (upper, upper + 1))
    return (above * (1 - part)).add_(below * part).clamp_(0, 255)


def expose(images: Tensor, gain: Tensor, falloff: Tensor, centre: Tensor) -> Tensor:
    """Gain per channel and vignetting: value * gain * (1 - falloff * r^2), with r = 1 half a diagonal away from the optical centre.

    Args:
        gain: [N, 3].
        falloff: [N], the share of light lost at r = 1; 0 is a lens without vignetting.
        centre: [N, 2], (x, y) of the optical centre from the middle of the image, in half diagonals.
    """
    H, W = images.shape[-2:]
    radius = max(math.hypot(H, W) / 2, 1)
    x = (torch.arange(W, device=images.device, dtype=images.dtype) - (W - 1) / 2) / radius - centre[:, :1]
    y = (torch.arange(H, device=images.device, dtype=images.dtype) - (H - 1) / 2) / radius - centre[:, 1:]
    lost = (x * x)[:, None, None, :] + (y * y)[:, None, :, None]
    light = (1 - falloff.view(-1, 1, 1, 1) * lost).clamp_(min=0)
    return (images * gain[:, :, None, None]).mul_(light).clamp_(0, 255)


def gaussian_half_kernels(sigmas_px: Sequence[float]) -> Tensor:
    """One row of weights per sigma, from the centre outward, cut at three sigma: float32 [N, radius + 1] for `blur`, on the CPU.

    Rows of a smaller sigma end in zeros, which add nothing, so a row's blur does not depend on its neighbours' radius.
    """
    radius = math.ceil(3 * max(sigmas_px))
    kernels = []
    for sigma in sigmas_px:
        near = max(sigma, 1e-3)  # below this the kernel is a single pixel
        weights = [math.exp(-((k / near) ** 2) / 2) if k <= math.ceil(3 * sigma) else 0.0 for k in range(radius + 1)]
        total = weights[0] + 2 * sum(weights[1:])
        kernels.append([weight / total for weight in weights])
    return torch.tensor(kernels, dtype=torch.float32)


def blur(images: Tensor, half_kernels: Tensor) -> Tensor:
    """Separable symmetric blur; `half_kernels`: [N, radius + 1], see `gaussian_half_kernels`. The border pixel repeats."""
    radius = half_kernels.shape[1] - 1
    for axis, padding in ((-1, (radius, radius, 0, 0)), (-2, (0, 0, radius, radius))):
        size = images.shape[axis]
        padded = F.pad(images, padding, mode="replicate")
        blurred = images * half_kernels[:, 0].view(-1, 1, 1, 1)
        for k in range(1, radius + 1):
            both_sides = padded.narrow(axis, radius - k, size) + padded.narrow(axis, radius + k, size)
            blurred += both_sides.mul_(half_kernels[:, k].view(-1, 1, 1, 1))
        images = blurred
    return images.clamp_(0, 255)  # the weights' rounding may leave the range by one unit in the last place


@functools.cache
def _normal_quantiles(device: torch.device) -> Tensor:
    """The standard normal at 65,536 equally likely quantiles: +-4.3 at the ends, so that 16 random bits name a normal number."""
    probability = (torch.arange(65536, dtype=torch.float64) + 0.5) / 65536
    return torch.special.ndtri(probability).float().to(device)


def _signed(bits: int) -> int:
    return bits - 2**64 if bits >= 2**63 else bits


def white_noise(keys: Tensor, height: int, width: int) -> Tensor:
    """Standard normal numbers [N, 3, H, W] on the keys' device, a function of the key and the pixel alone. `keys`: int64 [N].

    A counter-based generator (the SplitMix64 finaliser, Steele et al. 2014) in whole numbers, hence the same on every device;
    a pixel's 64 bits give its three channels 16 bits each. Drawing on the host and copying would take longer, on a CPU already.
    """
    bits = torch.arange(1, height * width + 1, device=keys.device) * _signed(0x9E3779B97F4A7C15) + keys[:, None]
    for shift, factor in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB), (31, 1)):
        bits ^= (bits >> shift) & (2 ** (64 - shift) - 1)  # >> keeps the sign; the mask makes the shift a logical one
        bits *= _signed(factor)
    channels = torch.stack([(bits >> (16 * channel)) & 0xFFFF for channel in range(3)], dim=1)
    return _normal_quantiles(keys.device).index_select(0, channels.flatten()).view(-1, 3, height, width)


def add_noise(images: Tensor, keys: Tensor, std: Tensor) -> Tensor:
    """White Gaussian noise of `std` grey levels [N], independent between pixels and channels; `keys` as in `white_noise`."""
    noise = white_noise(keys, *images.shape[-2:])
    return noise.mul_(std.view(-1, 1, 1, 1)).add_(images).clamp_(0, 255)


def _exact_mean(planes: Tensor) -> Tensor:
    """The mean of the rounded values over H and W, float64.

    Whole numbers below 2^24 are exact in float32, so the order in which a row is summed does not matter (up to a width of 65,000).
    """
    return planes.round().sum(-1).double().sum(-1) / (planes.shape[-1] * planes.shape[-2])


def mean_colour(images: Tensor) -> Tensor:
    """float32 [N, 3]."""
    return _exact_mean(images).float()


def mean_luma(images: Tensor) -> Tensor:
    """float32 [N]: what contrast is scaled about."""
    return _exact_mean(rgb_to_grayscale(images)).float()[:, 0]


def scale_brightness(images: Tensor, factor: Tensor) -> Tensor:
    """value * factor. `factor`: [N]."""
    return (images * factor.view(-1, 1, 1, 1)).clamp_(0, 255)


def scale_contrast(images: Tensor, factor: Tensor, pivot: Tensor) -> Tensor:
    """The distance from `pivot` [N], most often the mean luma, times `factor` [N]."""
    pivot = pivot.view(-1, 1, 1, 1)
    return (images - pivot).mul_(factor.view(-1, 1, 1, 1)).add_(pivot).clamp_(0, 255)


def scale_saturation(images: Tensor, factor: Tensor) -> Tensor:
    """The distance from the pixel's own grey times `factor` [N]; 0 is a grey image."""
    grey = rgb_to_grayscale(images)
    return (images - grey).mul_(factor.view(-1, 1, 1, 1)).add_(grey).clamp_(0, 255)


def rotate_hue(images: Tensor, turns: Tensor) -> Tensor:
    """Turns the HSV hue, value and chroma kept. `turns`: [N], 1/3 makes red green; a grey pixel stays as it is."""
    red, green, blue = images.unbind(1)
    value = images.amax(1)
    chroma = value - images.amin(1)
    # Masks of 1 and 0, between which `lerp` chooses exactly: on the CPU `where` takes up to twenty times as long.
    compared = (value, red), (value, green), (chroma, 0)
    is_red, is_green, is_grey = (torch.eq(one, other, out=torch.empty_like(value)) for one, other in compared)
    hue = torch.lerp(torch.lerp(red - green, blue - red, is_green), green - blue, is_red)
    hue /= chroma + is_grey
    # Sextants from red: red is the largest within 1 of 0, green within 1 of 2, blue within 1 of 4.
    hue += (4 - 2 * is_green).mul_(1 - is_red)
    hue += 6 * turns.view(-1, 1, 1)
    hue -= (hue / 6).floor_().mul_(6)
    # How far a channel is below the value, in chromas: red about sextant 3, green anywhere but about 2, blue but about 4.
    lows = (hue - 3).abs_().neg_().add_(2), (hue - 2).abs_().sub_(1), (hue - 4).abs_().sub_(1)
    result = torch.empty_like(images)
    for channel, low in enumerate(lows):
        torch.sub(value, low.clamp_(0, 1).mul_(chroma), out=result[:, channel])
    return result.clamp_(0, 255)


def apply_curve(images: Tensor, curves: Tensor) -> Tensor:
    """Tone curves: `curves` [N, 256] holds the result for 0, 1, ..., 255, linear in between."""
    lower = images.floor().clamp_(0, 254)
    index = lower.long()
    index += 256 * torch.arange(len(images), device=images.device).view(-1, 1, 1, 1)
    index, curves = index.flatten(), curves.flatten()
    dark, light = (values.index_select(0, index).view_as(images) for values in (curves, curves[1:]))
    part = torch.sub(images, lower, out=lower)
    return light.sub_(dark).mul_(part).add_(dark).clamp_(0, 255)


def to_grey(images: Tensor) -> Tensor:
    """The luma in all three channels."""
    return rgb_to_grayscale(images).clamp_(0, 255).repeat(1, 3, 1, 1)


def erase(images: Tensor, boxes: Tensor, colour: Tensor) -> Tensor:
    """Fills boxes with one colour: a thing that only one camera sees.

    Args:
        boxes: int64 [N, K, 4] as left, top, right, bottom; the last two are outside. Empty boxes erase nothing.
        colour: [N, 3].
    """
    H, W = images.shape[-2:]
    left, top, right, bottom = boxes[..., None].unbind(2)  # each [N, K, 1]
    x = torch.arange(W, device=images.device)
    y = torch.arange(H, device=images.device)
    columns = (x >= left) & (x < right)
    rows = (y >= top) & (y < bottom)
    erased = (rows[..., None] & columns[..., None, :]).any(1, keepdim=True)
    return torch.where(erased, colour[:, :, None, None], images)
