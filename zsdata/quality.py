"""The quality gate: pairs that would teach nothing, or something wrong, whatever the photo is worth otherwise."""

from __future__ import annotations

from dataclasses import dataclass

from zsdata.field_types import check_types
from zsdata.synthesis.disparity import SMALLEST_DISPARITY_PX


@dataclass(frozen=True, kw_only=True)
class QualityGate:
    """When a pair is refused; its photo is then counted with the reason and replaced, as one that cannot be read.

    The defaults let 486 of 486 views of 243 natural photographs pass, with the built-in depth at 384x512: their worst are a hole share of
    a quarter, a visible share of two thirds, a depth range of 0.3 and a consistency of 0.9. What they refuse: strips such as 900x40 photos
    that are enlarged until the disparity leaves the crop, depth that is one plane, and estimators that see another scene in the mirror.
    Depth networks are not even shown strips: see `Preprocessing.refuses`.

    Attributes:
        max_hole_share: of the right view's pixels, the share that no left pixel shows and that would be invented. 1 lets all pass.
        min_visible_share: of the left view's pixels, the share that the right view shows and the photometric loss can hold on to.
        min_depth_range: between the nearest and the farthest point of the view, as a share of the range of the whole photo. Flatter than
            this, the right view is a shifted copy.
        min_flip_consistency: mean of 1 - |D - D'| before normalisation (paper, section "Training-Free Confidence Generation"); two
            unrelated maps come to about 2/3.
    """

    max_hole_share: float = 0.5
    min_visible_share: float = 0.25
    min_depth_range: float = 0.01
    min_flip_consistency: float = 0.7

    def __post_init__(self) -> None:
        check_types(self)
        for name in ("max_hole_share", "min_visible_share", "min_depth_range", "min_flip_consistency"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"{name} is a share in 0..1; got {getattr(self, name)}")

    def refuses(
        self, *, hole_share: float, visible_share: float, disparity_range_px: float, drawn_px: float, flip_consistency: float
    ) -> str | None:
        """Why a pair of these numbers is refused, as `BadPhoto` takes it, or None. A number that is NaN is refused too.

        Args:
            disparity_range_px: between the nearest and the farthest point of the view.
            drawn_px: the disparity that the nearest point of the whole photo has. It belongs to the sample, not to the photo: where it is
                next to nothing, every photo gives a flat label, and none is refused for it.
        """
        if not hole_share <= self.max_hole_share:
            return f"too many holes: {hole_share:.0%} of the right view would be invented"
        if not visible_share >= self.min_visible_share:
            return f"too little valid: the right view shows {visible_share:.0%} of the left one"
        if not disparity_range_px >= self.min_depth_range * drawn_px - SMALLEST_DISPARITY_PX:
            return f"flat depth: the disparities of the view differ by {disparity_range_px:.2f} of {drawn_px:.2f} px"
        if not flip_consistency >= self.min_flip_consistency:
            return f"depth changes in the mirror: a flip consistency of {flip_consistency:.2f}"
        return None
