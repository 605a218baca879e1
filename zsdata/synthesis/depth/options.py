"""Which depth network, and how it is run: the stream's `depth` argument where a name alone does not say enough."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from zsdata.field_types import check_types
from zsdata.synthesis.model_name import split_revision
from zsdata.synthesis.precision import check_dtype

STORED = "stored"  # the name of depth that lies beside the photos and is read with them
PREDICTIONS = ("inverse depth", "depth")


@dataclass(frozen=True)
class DepthNetwork:
    """A depth network of transformers; plain values, so that it travels to workers and into digests. `load_depth` makes it a callable.

    Args:
        name: a Hub id, such as "depth-anything/Depth-Anything-V2-Small-hf", or a local folder; "owner/name@revision" gives both.
        resolution: the short side of the network's input in pixels, rounded to whole patches; "native" is the photo's own size; None is
            the size that the network's folder states.
        revision: branch, tag or commit of a Hub id; a folder has none.
        predicts: "inverse depth" or "depth"; None tells by the network's configuration.
        dtype: of the computation: "float32", without TF32, so that labels do not depend on where depth is estimated; or "bf16" or "fp16"
            (autocast; the last layers stay in float32), which are faster on a GPU and change the labels.
        compile: whether the network goes through `torch.compile`; worth its time where most photos have the same size.
        micro_batch: images that a GPU takes at once, where their sizes allow; a photo with its mirror image is two.

    Raises:
        ValueError: an option has no such value.
    """

    name: str
    resolution: int | Literal["native"] | None = None
    revision: str | None = None
    predicts: Literal["inverse depth", "depth"] | None = None
    dtype: str = "float32"
    compile: bool = False
    micro_batch: int = 8

    def __post_init__(self) -> None:
        check_types(self)
        for field, value in zip(("name", "revision"), split_revision(self.name, self.revision), strict=True):
            object.__setattr__(self, field, value)  # frozen for others
        in_pixels = isinstance(self.resolution, int) and not isinstance(self.resolution, bool) and self.resolution >= 1
        if not (self.resolution is None or self.resolution == "native" or in_pixels):
            raise ValueError(f'resolution is the short side in pixels, "native" or None; got {self.resolution!r}')
        if self.predicts is not None and self.predicts not in PREDICTIONS:
            raise ValueError(f'predicts is one of "{PREDICTIONS[0]}", "{PREDICTIONS[1]}"; got {self.predicts!r}')
        if self.micro_batch < 1:
            raise ValueError(f"micro_batch is 1 or more; got {self.micro_batch}")
        check_dtype(self.dtype)
