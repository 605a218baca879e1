"""What workers hand over: pairs up to their holes, or, where depth is the training device's work, all that is needed to make them there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from torch import Tensor

from zsdata.faults import BadPhoto
from zsdata.meter import Meter
from zsdata.quality import QualityGate
from zsdata.synthesis.depth.maps import DepthMaps
from zsdata.synthesis.indices import count_true
from zsdata.synthesis.synthesizer import SynthesisConfig, synthesize
from zsdata.synthesis.view import View


@dataclass(frozen=True)
class Prepared:
    """A pair before inpainting, as it crosses the process border: images uint8, masks bool.

    One sample has no batch axis and one `meta`; `stack` makes a batch of them. `right`, `inpaint` and the context reach INPAINT_CONTEXT_PX
    columns beyond the crop's right edge. `right` is 0 in its holes; `right_disparity` and `background` are there where the inpainter needs
    them. `rows` says for each sample of a batch which row of the tensors it is: samples that share a pair (`reuse`) share a row.
    """

    left: Tensor
    right: Tensor
    disparity: Tensor
    confidence: Tensor
    nonocclusion: Tensor
    inpaint: Tensor
    context: dict[str, Tensor]
    meta: Any
    seconds: dict[str, float] = field(default_factory=dict)
    rows: list[int] = field(default_factory=list)

    @staticmethod
    def stack(samples: Sequence[Prepared]) -> Prepared:
        """Single samples to one batch, in order."""
        firsts, rows = _distinct(samples)
        tensors = {
            name: torch.stack([getattr(sample, name) for sample in firsts])
            for name in ("left", "right", "disparity", "confidence", "nonocclusion", "inpaint")
        }
        context = {name: torch.stack([sample.context[name] for sample in firsts]) for name in firsts[0].context}
        return Prepared(**tensors, context=context, rows=rows, **_together(samples))

    def pin_memory(self) -> Prepared:
        """The same in page-locked memory (called by torch's DataLoader)."""
        values = {name: value.pin_memory() if isinstance(value, Tensor) else value for name, value in vars(self).items()}
        return Prepared(**{**values, "context": {name: value.pin_memory() for name, value in self.context.items()}})


@dataclass(frozen=True)
class Draft:
    """A pair before its depth is known, or before it is used.

    Attributes:
        identity: of the photo: its manifest's digest and its number there.
        photo: uint8 [1, 3, h, w], the whole photo, or what the depth network's `prepare` made of it; None where its depth is known.
        depth: of at least the rows that the view shows; None where it is still to be estimated.
        digest: names the photo in the depth cache; "" without one.
        left: uint8 [3, height, width], the view, margin included.
        view, scale: as `synthesize` takes them.
        context: `background`, uint8, where the inpainter needs it.
    """

    identity: tuple[str, int]
    photo: Tensor | None
    depth: DepthMaps | None
    digest: str
    left: Tensor
    view: View
    scale: float
    context: dict[str, Tensor]
    meta: Any
    seconds: dict[str, float] = field(default_factory=dict)

    @staticmethod
    def stack(samples: Sequence[Draft]) -> Drafts:
        """Single drafts to one batch, in order."""
        firsts, rows = _distinct(samples)
        return Drafts(firsts, rows=rows, **_together(samples))

    def pin_memory(self) -> Draft:
        """The same in page-locked memory."""
        depth = self.depth and self.depth._replace(
            inverse_depth=self.depth.inverse_depth.pin_memory(), confidence=self.depth.confidence.pin_memory()
        )
        return replace(
            self,
            photo=None if self.photo is None else self.photo.pin_memory(),
            depth=depth,
            left=self.left.pin_memory(),
            context={name: value.pin_memory() for name, value in self.context.items()},
        )


@dataclass(frozen=True)
class Drafts:
    """A batch of drafts: the distinct ones, and for each sample which of them it is."""

    drafts: list[Draft]
    meta: list[dict[str, Any]]
    seconds: dict[str, float]
    rows: list[int]

    def pin_memory(self) -> Drafts:
        """The same in page-locked memory (called by torch's DataLoader)."""
        return replace(self, drafts=[draft.pin_memory() for draft in self.drafts])


def stack(samples: Sequence[Any]) -> Prepared | Drafts:
    """Single samples or drafts, as one worker hands them over, to one batch."""
    return type(samples[0]).stack(samples)


def make(draft: Draft, depth: DepthMaps, needs: Sequence[str], config: SynthesisConfig, gate: QualityGate, meter: Meter) -> Prepared:
    """The pair of a draft, on the device of the draft's tensors and `depth`.

    Raises:
        BadPhoto: where the gate refuses it.
    """
    made = synthesize(draft.left.unsqueeze(0), depth, draft.view, draft.scale, config, meter)
    width = draft.view.width - draft.view.margin
    context = dict(draft.context)
    if "right_disparity" in needs:
        context["right_disparity"] = made.right_disparity[0].contiguous()
    hole = made.inpaint_mask[..., :width]
    disparity, nonocclusion = made.disparity[0].contiguous(), made.nonocclusion_mask[0].contiguous()
    least, largest = torch.stack((disparity.amin(), disparity.amax())).tolist()  # on a GPU one wait for both
    consistency = float(depth.consistency[0])
    hole_share = count_true(hole) / hole.numel()
    reason = gate.refuses(
        hole_share=hole_share,
        visible_share=count_true(nonocclusion) / nonocclusion.numel(),
        disparity_range_px=largest - least,
        drawn_px=draft.scale * depth.inverse_depth.shape[-1] * draft.view.scale_x,
        flip_consistency=consistency,
    )
    if reason is not None:
        raise BadPhoto(reason)
    meta = {
        **draft.meta,
        "largest_disparity_px": largest,
        "flip_consistency": round(consistency, 6),
        "hole_share": hole_share,
    }
    return Prepared(
        left=draft.left[..., :width].contiguous(),
        right=made.right[0].contiguous(),
        disparity=disparity,
        confidence=made.confidence[0].contiguous(),
        nonocclusion=nonocclusion,
        inpaint=made.inpaint_mask[0].contiguous(),
        context=context,
        meta=meta,
        seconds=draft.seconds,
    )


def _distinct(samples: Sequence[Any]) -> tuple[list[Any], list[int]]:
    """The samples of different pairs, and for each sample its place among these."""
    places: dict[int, int] = {}
    rows = [places.setdefault(id(sample.left), len(places)) for sample in samples]
    return [samples[rows.index(place)] for place in range(len(places))], rows


def _together(samples: Sequence[Any]) -> dict[str, Any]:
    meter = Meter()
    for sample in samples:
        meter.add(sample.seconds)
    return {
        "meta": [sample.meta for sample in samples],
        "seconds": meter.seconds,
    }
