"""What every stereo matcher here has in common: its input, frozen batch norms, and prediction at any image size."""

from __future__ import annotations

from typing import Any, TypeVar

import torch
import torch.nn.functional as F
from torch import Tensor, nn

# Three pyramid levels below 1/4 resolution, or two below 1/8: what the published evaluation pads to.
SIZE_MULTIPLE_PX = 32

Self = TypeVar("Self", bound="Matcher")


class Matcher(nn.Module):
    """Base of the matchers: `forward(left, right, iterations, every_iteration)` is theirs, the rest is here.

    `forward` returns `(initial, sequence)`: positive disparities [B, 1, H, W] at full resolution, `initial` None where a matcher has
    none. With `every_iteration=False`, `initial` is None and the sequence only its last element.
    """

    PARTS: tuple[str, ...] = ()  # the functions that `compile_parts` compiles: each is called alike in every iteration and step

    def __init__(self) -> None:
        super().__init__()
        self.batch_norm_frozen = False

    def compile_parts(self, **options: Any) -> None:
        """Compiles the encoders and one update, not all the updates unrolled: a minute at the first step in place of many.

        It is for training at one size. `predict` goes on without, as it takes images of any size.

        Args:
            options: of `torch.compile`.
        """
        for name in self.PARTS:
            setattr(self, name, torch.compile(getattr(self, name), fullgraph=True, dynamic=False, **options))

    def use_channels_last(self) -> None:
        """Stores images and filters channel after channel, as tensor cores take them; the numbers change by rounding only."""
        for module in self.modules():
            if isinstance(module, (nn.Conv2d, nn.ConvTranspose2d)):
                module.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
            elif isinstance(module, (nn.Conv3d, nn.ConvTranspose3d)):
                module.to(memory_format=torch.channels_last_3d)  # type: ignore[call-overload]

    def freeze_bn(self) -> None:
        """Keeps the running statistics of every BatchNorm2d as they are, also after a later `train()`."""
        self.batch_norm_frozen = True
        self.train(self.training)

    def train(self: Self, mode: bool = True) -> Self:
        super().train(mode)
        if self.batch_norm_frozen:
            for module in self.modules():
                if isinstance(module, nn.BatchNorm2d):
                    module.eval()
        return self

    @torch.no_grad()
    def predict(self, left: Tensor, right: Tensor, iterations: int = 32) -> Tensor:
        """The last prediction for images of any size, in evaluation mode, which is left again afterwards.

        Args:
            left, right: RGB, 0..255, [B, 3, H, W]. Padded to a multiple of 32 by repeating the border, half on each side.
            iterations: how many updates.
        Returns:
            Disparity [B, 1, H, W], float32, pixels, positive.
        """
        check_images(left, right)
        height, width = left.shape[-2:]
        above, before = -height % SIZE_MULTIPLE_PX // 2, -width % SIZE_MULTIPLE_PX // 2
        below, after = -height % SIZE_MULTIPLE_PX - above, -width % SIZE_MULTIPLE_PX - before
        padded = [F.pad(image.float(), (before, after, above, below), mode="replicate") for image in (left, right)]
        was_training = self.training
        self.eval()
        try:
            with torch.compiler.set_stance("force_eager"):
                # Of the class: Accelerate puts mixed precision around the forward of an instance, and a score is not to depend on it.
                _, sequence = type(self).forward(self, *padded, iterations=iterations, every_iteration=False)
        finally:
            self.train(was_training)
        return sequence[-1][..., above : above + height, before : before + width].float()


def check_images(left: Tensor, right: Tensor) -> None:
    """Raises ValueError unless both are [B, 3, H, W] of one shape."""
    if left.ndim != 4 or left.shape[1] != 3 or left.shape != right.shape:
        raise ValueError(f"a matcher takes two RGB images [B, 3, H, W] of one size; got {list(left.shape)} and {list(right.shape)}")


def check_padded(left: Tensor, right: Tensor, least_width_px: int) -> None:
    """Raises ValueError unless both are images whose height and width are multiples of 32, and wide enough for the correlations."""
    check_images(left, right)
    height, width = left.shape[-2:]
    if height % SIZE_MULTIPLE_PX or width % SIZE_MULTIPLE_PX:
        raise ValueError(
            f"height and width must be multiples of {SIZE_MULTIPLE_PX}; got {height} x {width}: crop or pad the images, or use predict()"
        )
    if width < least_width_px:
        raise ValueError(f"this matcher needs images at least {least_width_px} px wide; got {width}")
