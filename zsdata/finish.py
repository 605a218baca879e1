"""The finish: what the training device does to a batch that the workers prepared. Holes are filled, then both images are augmented.

Where depth is the device's work too, it first makes the pairs: the same functions as in the workers, on the device.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from torch import Tensor

from zsdata.augment import AugmentConfig, augment
from zsdata.faults import BadPhoto
from zsdata.meter import Meter
from zsdata.prepared import Draft, Drafts, Prepared, make
from zsdata.sample import Masks, StereoBatch
from zsdata.seeding import rng
from zsdata.synthesis.depth import DepthEstimator
from zsdata.synthesis.depth.maps import DepthMaps
from zsdata.synthesis.inpaint import Inpainter, fill
from zsdata.synthesis.micro_batch import WarmUp
from zsdata.synthesis.synthesizer import INPAINT_CONTEXT_PX, estimate_depth, predict_depth
from zsdata.worker import Recipe, Worker, naming, single_thread, store_depth


@dataclass(frozen=True)
class Synthesis:
    """Depth and warp on the device: drafts to prepared pairs."""

    depth: DepthEstimator | None  # None: every draft has its depth
    recipe: Recipe
    worker: Worker  # of the same recipe: draws what stands in for a pair that the quality gate refuses
    _last: dict[tuple[str, int], DepthMaps] = field(default_factory=dict)  # of the last photo: its next view may begin the next batch

    def __call__(self, drafts: Drafts, device: torch.device, meter: Meter) -> Prepared:
        """The pairs of a batch of drafts, on the device; a photo's depth is estimated once, however many views follow one another."""
        drawn = list(drafts.drafts)
        made: dict[int, Prepared] = {}
        known = dict(self._last)
        while len(made) < len(drawn):
            missing = {place: draft for place, draft in enumerate(drawn) if place not in made}
            with meter.stage("depth"):
                unknown = {draft.identity: draft for draft in missing.values() if draft.depth is None and draft.identity not in known}
                known.update(self._estimate(unknown, device))
            for place, draft in missing.items():
                depth = draft.depth if draft.depth is not None else known[draft.identity]
                try:
                    made[place] = self._make(draft, depth, device, meter)
                except BadPhoto as fault:
                    drawn[place] = self.worker.instead(draft, fault.reason)
        self._last.clear()
        self._last.update({photo: depth for photo, depth in known.items() if photo == drawn[-1].identity})
        pairs = Prepared.stack([made[place] for place in range(len(drawn))])
        meta = [{**pairs.meta[row], "index": sample["index"]} for row, sample in zip(drafts.rows, drafts.meta, strict=True)]
        return replace(pairs, meta=meta, seconds=drafts.seconds, rows=drafts.rows)

    def warm_up(self, photos: Sequence[tuple[int, int]], samples: int) -> Any:
        """Of the depth estimator, which has one, for so many photos at once: of the photo with most pixels, and of the one that is largest
        to the network, which sees a narrow one enlarged. What the one that takes more memory says."""
        depth: Any = self.depth
        preprocessing = self.recipe.preprocessing

        def seen_pixels(photo: tuple[int, int]) -> int:
            return math.prod(photo if preprocessing is None else preprocessing.input_size(*photo))

        said = [depth.warm_up(photo, samples) for photo in {max(photos, key=math.prod), max(photos, key=seen_pixels)}]
        return max(said, key=lambda one: getattr(one, "peak_bytes", None) or 0)

    def _make(self, draft: Draft, depth: DepthMaps, device: torch.device, meter: Meter) -> Prepared:
        inverse_depth, confidence = (values.to(device, non_blocking=True) for values in (depth.inverse_depth, depth.confidence))
        depth = depth._replace(inverse_depth=inverse_depth, confidence=confidence)
        draft = replace(draft, left=draft.left.to(device, non_blocking=True))
        with naming(draft.meta):
            return make(draft, depth, self.recipe.inpainter_needs, self.recipe.synthesis, self.recipe.gate, meter)

    @torch.no_grad()
    def _estimate(self, drafts: dict[tuple[str, int], Draft], device: torch.device) -> dict[tuple[str, int], DepthMaps]:
        """Depth of the photos of these drafts: by a network, whose first half the workers did, all in one go; otherwise one by one."""
        if self.depth is None:
            return {}
        config = self.recipe.synthesis
        photos = [draft.photo.to(device, non_blocking=True) for draft in drafts.values() if draft.photo is not None]
        if self.recipe.preprocessing is not None:
            with _naming_photos(drafts.values()):
                maps = predict_depth(self.depth, photos, [tuple(draft.meta["photo_size"]) for draft in drafts.values()], config)
        else:
            maps = (estimate_depth(self.depth, photo.float(), config) for photo in photos)
        found = []
        for draft in drafts.values():
            with naming(draft.meta):
                found.append(next(maps))
        if self.recipe.depth_cache is not None:
            for draft, depth in zip(drafts.values(), found, strict=True):
                store_depth(self.recipe.depth_cache, draft.digest, depth)
        return dict(zip(drafts, found, strict=True))


@contextmanager
def _naming_photos(drafts: Iterable[Draft]) -> Iterator[None]:
    """Errors of work on many photos at once say which they are. One photo that memory does not hold is the device's affair."""
    try:
        yield
    except MemoryError:
        raise
    except Exception as error:
        listed = ", ".join(f'"{draft.meta["key"]}" in {draft.meta["shard"]}' for draft in drafts)
        raise RuntimeError(f"the depth network failed: {error} The photos that it was given: {listed}") from error


@dataclass(frozen=True)
class Finisher:
    """Prepared batches to finished ones, on one device. Nothing here depends on which samples share a batch."""

    inpainter: Inpainter
    augmentation: AugmentConfig
    micro_batch: int | None
    device: torch.device
    synthesis: Synthesis | None = None
    reuse: int = 1
    _last: dict[str, Any] = field(default_factory=dict)  # the pair that was filled last: its next sample may begin the next batch

    @property
    def micro_batch_lowered(self) -> int:
        """How often a network had to take fewer samples at once because memory ran out."""
        networks = [self.inpainter, None if self.synthesis is None else self.synthesis.depth]
        return sum(getattr(getattr(network, "micro_batch", None), "lowered", 0) for network in networks)

    def warm_up(self, size: tuple[int, int], photos: Sequence[tuple[int, int]], batch_size: int) -> list[WarmUp]:
        """Makes the networks ready for batches of crops of this size, of photos of those sizes, while training has memory and time to
        spare; what each of them says. Sizes are (height, width)."""
        height, width = size
        pairs = 1 + -(-(batch_size - 1) // self.reuse)  # the most distinct ones that a batch can have
        ready = list[Any]()
        if hasattr(self.inpainter, "warm_up"):
            ready.append(self.inpainter.warm_up((height, width + INPAINT_CONTEXT_PX), min(pairs, self.micro_batch or pairs)))
        if self.synthesis is not None and hasattr(self.synthesis.depth, "warm_up"):
            ready.append(self.synthesis.warm_up(photos, pairs))
        return [said for said in ready if isinstance(said, WarmUp)]

    @torch.no_grad()
    def __call__(self, prepared: Prepared | Drafts, meter: Meter) -> StereoBatch:
        """A batch of prepared samples (with a batch axis) to a StereoBatch on the device; its images and labels are new tensors.

        On the CPU one thread does it: the workers have the others, and no sum depends on how many there are."""
        with single_thread() if self.device.type == "cpu" else nullcontext():
            if isinstance(prepared, Drafts):
                assert self.synthesis is not None  # who asks for drafts says how to make pairs of them
                prepared = self.synthesis(prepared, self.device, meter)
            return self._finish(prepared, meter)

    def _finish(self, prepared: Prepared, meter: Meter) -> StereoBatch:
        with meter.stage("transfer"):
            left, right, disparity, confidence, nonocclusion, inpaint = (
                tensor.to(self.device, non_blocking=True)
                for tensor in (
                    prepared.left,
                    prepared.right,
                    prepared.disparity,
                    prepared.confidence,
                    prepared.nonocclusion,
                    prepared.inpaint,
                )
            )
            context = {name: tensor.to(self.device, non_blocking=True).float() for name, tensor in prepared.context.items()}
        with meter.stage("inpaint"):
            right = self._fill(right.float(), inpaint, prepared, context)
        width = left.shape[-1]  # the right view reaches further, for the inpainter's sake
        rows = prepared.rows
        left_clean, right_clean, inpaint, disparity, confidence, nonocclusion = (
            _spread(values[..., :width], rows) for values in (left.float(), right, inpaint, disparity, confidence, nonocclusion)
        )
        with meter.stage("augment"):
            generators = [rng(meta["seed"], meta["epoch"], meta["index"], "augment") for meta in prepared.meta]
            left, right = augment(left_clean, right_clean, generators, self.augmentation)
        masks = Masks(nonocclusion, inpaint, valid=disparity > 0)
        return StereoBatch(left, right, disparity, confidence, masks, left_clean, right_clean, prepared.meta)

    def _fill(self, right: Tensor, inpaint: Tensor, prepared: Prepared, context: dict[str, Tensor]) -> Tensor:
        """The right views without holes, one for each distinct pair."""
        metas = [prepared.meta[prepared.rows.index(row)] for row in range(len(right))]
        pairs = [{**meta, "index": meta["pair"]} for meta in metas]
        known = 1 if self._last.get("pair") == pairs[0] else 0
        generators = [rng(meta["seed"], meta["epoch"], meta["pair"], "inpaint") for meta in metas[known:]]
        context = {name: values[known:] for name, values in context.items()}
        filled = fill(self.inpainter, right[known:], inpaint[known:], generators, context, self.micro_batch)
        if known:
            filled = torch.cat([self._last["right"], filled])
        if self.reuse > 1:
            self._last.update(pair=pairs[-1], right=filled[-1:])
        return filled


def _spread(values: Tensor, rows: Sequence[int]) -> Tensor:
    """One row per sample, in memory of its own."""
    if list(rows) == list(range(len(values))):
        return values.contiguous()
    return values[torch.tensor(rows, device=values.device)].contiguous()
