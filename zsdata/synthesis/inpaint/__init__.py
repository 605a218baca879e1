"""Inpainters: from a name to a callable, and the loop that feeds it.

An inpainter is anything with `__call__(right, inpaint_mask, generators) -> right`: right is float32 [B, 3, H, W] RGB 0..255, inpaint_mask
bool [B, 1, H, W], True in the holes, and generators holds one numpy Generator per sample. One that wants to know more lists it in `needs`
and gets it by keyword: `right_disparity` (float32 [B, 1, H, W], 0 in holes) or `background` (another photo of the same source at the
crop's size, float32 [B, 3, H, W]). One that has to get ready has `warm_up(size, samples)` (see `DiffusionInpainter`).
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from zsdata.synthesis.inpaint.options import DiffusionNetwork

Inpainter = Callable[..., Tensor]

BUILT_IN = ("builtin", "background")


def load_inpainter(
    inpaint: str | os.PathLike[str] | DiffusionNetwork | Inpainter, device: str | torch.device = "cpu", **options: Any
) -> Inpainter:
    """Turns the stream's `inpaint` argument into a callable `inpaint(right, inpaint_mask, generators) -> right`.

    Args:
        inpaint: "builtin"; "background" (MfS-Stereo's: another photo, colours matched); a Hub id or a local folder in the diffusers
            format (needs the "diffusion" extra), or a `DiffusionNetwork` with options; or a callable, returned as it is.
        device: where a network is put; the built-in inpainters follow their input.
        options: of a pipeline given by name, those of `DiffusionNetwork`: `steps`, `scheduler`, `subfolder`, ...

    Raises:
        TypeError: options for something that takes none.
    """
    if isinstance(inpaint, DiffusionNetwork):
        if options:
            raise TypeError(f"a DiffusionNetwork has its options already; got {sorted(options)} beside it")
        return _diffusion(inpaint, device)
    if callable(inpaint):
        if options:
            raise TypeError(f"a callable inpainter takes no options; got {sorted(options)}")
        return inpaint
    name = os.fspath(inpaint)
    if name in BUILT_IN:
        if options:
            raise TypeError(f'inpaint="{name}" takes no options; got {sorted(options)}')
        if name == "builtin":
            from zsdata.synthesis.inpaint.builtin import BuiltinInpainter

            return BuiltinInpainter()
        from zsdata.synthesis.inpaint.background import RandomBackground

        return RandomBackground()
    return _diffusion(DiffusionNetwork(name, **options), device)


def as_pipeline(inpaint: str | os.PathLike[str] | DiffusionNetwork | Inpainter) -> DiffusionNetwork | None:
    """The pipeline behind the stream's `inpaint` argument, where that names one; None for built-in inpainters and callables."""
    if isinstance(inpaint, DiffusionNetwork):
        return inpaint
    if callable(inpaint) or os.fspath(inpaint) in BUILT_IN:
        return None
    return DiffusionNetwork(os.fspath(inpaint))


def checked_pipeline(network: DiffusionNetwork) -> DiffusionNetwork:
    """The pipeline at the commit that its name stands for; all is checked that can be without loading weights.

    Raises:
        ImportError: the "diffusion" extra is not installed.
        OSError, ValueError: it cannot be loaded, or not with these options.
    """
    from zsdata.synthesis.inpaint.diffusion import checked

    return checked(network)[0]


def _diffusion(network: DiffusionNetwork, device: str | torch.device) -> Inpainter:
    from zsdata.synthesis.inpaint.diffusion import DiffusionInpainter

    return DiffusionInpainter(network, device)


def fill(
    inpainter: Inpainter,
    right: Tensor,
    inpaint_mask: Tensor,
    generators: Sequence[np.random.Generator],
    context: Mapping[str, Tensor],
    micro_batch: int | None,
) -> Tensor:
    """`right` without holes: the inpainter's pixels in the holes, the known pixels as they are, `micro_batch` samples at a time.

    A sample without a hole does not reach the inpainter. `context` holds what the inpainter's `needs` name. With `micro_batch` None the
    inpainter gets all samples at once: one that knows what fits into memory divides them itself.

    Raises:
        ValueError: where the inpainter returns another shape, another device or values that are not finite.
    """
    filled = right.clone()
    with_holes = inpaint_mask.flatten(1).any(1).nonzero().flatten().tolist()
    at_once = max(1, len(with_holes)) if micro_batch is None else micro_batch
    for start in range(0, len(with_holes), at_once):
        places = with_holes[start : start + at_once]
        part = torch.tensor(places, device=right.device)
        expected = (len(places), *right.shape[1:])
        extra = {name: context[name][part] for name in getattr(inpainter, "needs", ())}
        made = inpainter(right[part], inpaint_mask[part], [generators[place] for place in places], **extra)
        if made.shape != expected:
            raise ValueError(f"the inpainter must return {list(expected)}; got {list(made.shape)}")
        if made.device != right.device:
            raise ValueError(f"the inpainter must return its images on {right.device}, where it gets them; got {made.device}")
        if not torch.isfinite(made).all():
            raise ValueError("the inpainter returned NaN or infinity; in half precision try bfloat16 or float32")
        filled[part] = torch.where(inpaint_mask[part], made.float().clamp(0, 255), right[part])
    return filled
