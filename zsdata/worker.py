"""The worker: one index on the CPU, from the photo's bytes to all that the training device needs."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor

from zsdata.faults import BadPhoto, BadShard, NoUsablePhoto
from zsdata.meter import Meter
from zsdata.plan import Choice
from zsdata.seeding import rng
from zsdata.source.photo import decode_rgb, probe_size
from zsdata.sources import Schedule, SourceSet
from zsdata.synthesis.depth import DepthEstimator, load_depth
from zsdata.synthesis.depth.cache import DepthCache, photo_digest
from zsdata.synthesis.disparity import AdaptiveDisparity, UniformDisparity
from zsdata.synthesis.synthesizer import INPAINT_CONTEXT_PX, DepthMaps, SynthesisConfig, estimate_depth, synthesize
from zsdata.synthesis.view import ViewConfig, draw_view, view_photo, whole_view

SHORTEST_SIDE_PX = 32  # a photo with a shorter side shows no scene
MOST_SPARES = 100  # tried for one sample before the source is called unusable


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """All that a sample depends on but its epoch and index; travels to the workers."""

    seed: int
    size: tuple[int, int] | None  # None: each photo whole, at its own size
    schedule: Schedule
    depth: str | DepthEstimator
    depth_cache: DepthCache | None
    disparity: AdaptiveDisparity | UniformDisparity
    view: ViewConfig
    synthesis: SynthesisConfig
    inpainter_needs: tuple[str, ...]


@dataclass(frozen=True)
class Prepared:
    """A pair before inpainting, as it crosses the process border: images uint8, masks bool.

    One sample has no batch axis and one `meta`; `stack` makes a batch of them. `right`, `inpaint` and the context reach INPAINT_CONTEXT_PX
    columns beyond the crop's right edge. `right` is 0 in its holes; `right_disparity` and
    `background` are there where the inpainter needs them. `rejected` lists (source, shard, key, reason) of the photos that could not be
    used.
    """

    left: Tensor
    right: Tensor
    disparity: Tensor
    confidence: Tensor
    nonocclusion: Tensor
    inpaint: Tensor
    context: dict[str, Tensor]
    meta: Any
    rejected: list[tuple[str, str, str, str]] = field(default_factory=list)
    seconds: dict[str, float] = field(default_factory=dict)

    @staticmethod
    def stack(samples: list[Prepared]) -> Prepared:
        """Single samples to one batch, in order."""
        tensors = {
            name: torch.stack([getattr(sample, name) for sample in samples])
            for name in ("left", "right", "disparity", "confidence", "nonocclusion", "inpaint")
        }
        meter = Meter()
        for sample in samples:
            meter.add(sample.seconds)
        return Prepared(
            **tensors,
            context={name: torch.stack([sample.context[name] for sample in samples]) for name in samples[0].context},
            meta=[sample.meta for sample in samples],
            rejected=[reject for sample in samples for reject in sample.rejected],
            seconds=meter.seconds,
        )

    def pin_memory(self) -> Prepared:
        """The same in page-locked memory (called by torch's DataLoader)."""
        values = {name: value.pin_memory() if isinstance(value, Tensor) else value for name, value in vars(self).items()}
        return Prepared(**{**values, "context": {name: value.pin_memory() for name, value in self.context.items()}})


class _Photo:
    """A photo as far as it has been needed: its pixels and its depth are found once, however many views are drawn from it."""

    def __init__(self, data: bytes) -> None:
        self.data = data
        width, height = probe_size(data)
        if min(width, height) < SHORTEST_SIDE_PX:
            raise BadPhoto(f"too small: a side shorter than {SHORTEST_SIDE_PX} px: {width}x{height}")
        self.size = height, width
        self.depth: DepthMaps | None = None
        self._pixels: dict[int, np.ndarray] = {}

    def pixels(self, reduction: int = 1) -> np.ndarray:
        """uint8 [H, W, 3], RGB; a JPEG at one part in `reduction` of each side."""
        if reduction not in self._pixels:
            self._pixels[reduction] = decode_rgb(self.data, reduction)
        return self._pixels[reduction]


class Worker:
    """Makes pairs, one index at a time, on the CPU. The depth estimator is loaded at the first call, in the process that uses it."""

    def __init__(self, recipe: Recipe) -> None:
        self._recipe = recipe
        self._depth: DepthEstimator | None = None
        self._last: tuple[tuple[str, int], _Photo] | None = None  # the photo whose next view comes next

    def prepare(self, epoch: int, index: int) -> Prepared:
        """Sample `index` of `epoch` up to the holes; a photo that cannot be used is replaced by the sample's next spare.

        Raises:
            NoUsablePhoto: when no spare can be used either, with the reasons.
            RuntimeError: when a step fails, with the sample named.
        """
        sources = self._recipe.schedule.at(epoch)
        rejected: list[tuple[str, str, str, str]] = []
        choice: Choice | None = sources.plan.choose(epoch, index)
        with single_thread():
            while choice is not None and len(rejected) <= MOST_SPARES:
                member = sources.manifests[choice.source].member(choice.member)
                name = sources.names[choice.source]
                try:
                    return self._pair(sources, choice, epoch, index, rejected)
                except (BadPhoto, BadShard) as fault:
                    rejected.append((name, member.shard_url, member.key, fault.reason))
                except Exception as error:
                    raise RuntimeError(
                        f'sample {index} of epoch {epoch} (source "{name}", "{member.key}" in {member.shard_url}) failed: {error}'
                    ) from error
                choice = sources.plan.spare(epoch, index, len(rejected) - 1)
        last = "; ".join(f"{key} in {shard}: {reason}" for _, shard, key, reason in rejected[-3:])
        raise NoUsablePhoto(
            f'no usable photo for sample {index} of epoch {epoch}: {len(rejected)} of source "{rejected[0][0]}" were refused, '
            f"the last ones: {last}. `zsdata verify` lists what is wrong with its shards."
        )

    def _pair(self, sources: SourceSet, choice: Choice, epoch: int, index: int, rejected: list[tuple[str, str, str, str]]) -> Prepared:
        recipe, meter = self._recipe, Meter()
        manifest = sources.manifests[choice.source]
        photo = self._open(sources, choice, meter)
        scale = recipe.disparity.draw_scale(rng(recipe.seed, epoch, index, "disparity"), photo.size[1])
        if recipe.size is None:
            view = whole_view(photo.size)
        else:
            view = draw_view(photo.size, recipe.size, rng(recipe.seed, epoch, index, "view"), recipe.view, scale)
        with meter.stage("decode"):
            pixels = photo.pixels(view.reduction)
        with meter.stage("view"):
            left = view_photo(pixels, view, photo.size[0] // pixels.shape[0])
        with meter.stage("depth"):
            depth = self._depth_of(photo, view.rows)
        made = synthesize(_image(left), depth, view, scale, recipe.synthesis, meter)

        size = view.height, view.width - view.margin
        context = {}
        if "right_disparity" in recipe.inpainter_needs:
            context["right_disparity"] = made.right_disparity[0].contiguous()
        if "background" in recipe.inpainter_needs:
            with meter.stage("background"):
                context["background"] = (
                    torch.from_numpy(self._background(sources, choice, epoch, index, photo, size)).permute(2, 0, 1).contiguous()
                )
        member = manifest.member(choice.member)
        hole = made.inpaint_mask[..., : size[1]]
        meta = {
            "seed": recipe.seed,
            "epoch": epoch,
            "index": index,
            "source": sources.names[choice.source],
            "shard": member.shard_url,
            "key": member.key,
            "photo_size": list(photo.size),
            "window": list(view.window),
            "mirror": view.mirror,
            "scale_x": view.scale_x,
            "disparity_scale": scale,
            "largest_disparity_px": float(made.disparity.max()),
            "flip_consistency": round(float(depth.consistency[0]), 6),
            "replaced": [list(reject) for reject in rejected],  # photos that could not be used: source, shard, key, reason
            "hole_share": float(hole.count_nonzero()) / hole.numel(),
        }
        return Prepared(
            left=_planes(left[:, : size[1]]),
            right=_to_uint8(made.right),
            disparity=made.disparity[0].contiguous(),
            confidence=made.confidence[0].contiguous(),
            nonocclusion=made.nonocclusion_mask[0].contiguous(),
            inpaint=made.inpaint_mask[0].contiguous(),
            context=context,
            meta=meta,
            rejected=rejected,
            seconds=meter.seconds,
        )

    def _open(self, sources: SourceSet, choice: Choice, meter: Meter) -> _Photo:
        manifest = sources.manifests[choice.source]
        key = manifest.digest, choice.member
        if self._last is not None and self._last[0] == key:
            return self._last[1]
        with meter.stage("read"):
            data = manifest.read(choice.member)
        with meter.stage("decode"):
            photo = _Photo(data)
        self._last = (key, photo) if sources.plan.views_per_image > 1 else None
        return photo

    def _depth_of(self, photo: _Photo, rows: tuple[int, int]) -> DepthMaps:
        """Depth of at least these rows: what is known of the photo already, or cached, or estimated now."""
        if photo.depth is not None:
            return photo.depth
        cache = self._recipe.depth_cache
        digest = photo_digest(photo.data) if cache is not None else ""
        cached = cache.load(digest, rows) if cache is not None else None
        if cached is not None and cached.size == photo.size:
            inverse_depth, confidence = (torch.from_numpy(values)[None, None] for values in (cached.inverse_depth, cached.confidence))
            return DepthMaps(inverse_depth, confidence, torch.tensor([cached.consistency], dtype=torch.float64), cached.first_row)
        if self._depth is None:
            self._depth = load_depth(self._recipe.depth)
        with torch.inference_mode():
            photo.depth = estimate_depth(self._depth, _image(photo.pixels()), self._recipe.synthesis)
        if cache is not None:
            maps = photo.depth
            cache.store(digest, maps.inverse_depth[0, 0].numpy(), maps.confidence[0, 0].numpy(), float(maps.consistency[0]))
        return photo.depth

    def _background(self, sources: SourceSet, choice: Choice, epoch: int, index: int, photo: _Photo, size: tuple[int, int]) -> np.ndarray:
        """Another photo of the source at the size of the right view; the photo itself where the source has no other that can be read."""
        pixels: np.ndarray | None = None
        generator = rng(self._recipe.seed, epoch, index, "background")
        manifest = sources.manifests[choice.source]
        for _ in range(3):
            other = int(generator.integers(len(manifest)))
            if other == choice.member:
                continue
            try:
                pixels = decode_rgb(manifest.read(other))
                break
            except (BadPhoto, BadShard):  # counted when its own turn comes
                continue
        height, width = size
        return cv2.resize(photo.pixels() if pixels is None else pixels, (width + INPAINT_CONTEXT_PX, height), interpolation=cv2.INTER_AREA)


def _planes(photo: np.ndarray) -> Tensor:
    """uint8 [H, W, 3] to uint8 [3, H, W]."""
    return torch.from_numpy(np.stack(cv2.split(photo)))


def _image(photo: np.ndarray) -> Tensor:
    """uint8 [H, W, 3] to float32 [1, 3, H, W]."""
    return _planes(photo).unsqueeze(0).float()


def _to_uint8(image: Tensor) -> Tensor:
    """float [1, 3, H, W] 0..255 to uint8 [3, H, W], rounded."""
    return (image[0] + 0.5).int().to(torch.uint8)  # by way of int32: five times as fast


class _OpenCVAcrossFork:
    """Puts OpenCV's threads to rest while a process forks.

    A child inherits the pool without its threads, and hangs as soon as OpenCV uses or ends it. Without a pool there is nothing to wait for:
    the parent starts a new one when it needs it, and the child, a worker, keeps to one thread.
    """

    def __init__(self) -> None:
        self._threads = 1

    def before(self) -> None:
        self._threads = cv2.getNumThreads()
        cv2.setNumThreads(1)

    def after_in_parent(self) -> None:
        cv2.setNumThreads(self._threads)


_opencv_across_fork = _OpenCVAcrossFork()
os.register_at_fork(before=_opencv_across_fork.before, after_in_parent=_opencv_across_fork.after_in_parent)


@contextmanager
def single_thread() -> Iterator[None]:
    """One thread for torch and OpenCV, whatever the environment says: workers share the machine, and a sample must not depend on it."""
    threads, cv_threads = torch.get_num_threads(), cv2.getNumThreads()
    try:
        if threads != 1:
            torch.set_num_threads(1)
        if cv_threads != 1:
            cv2.setNumThreads(1)
        yield
    finally:
        if threads != 1:
            torch.set_num_threads(threads)
        if cv_threads != 1:
            cv2.setNumThreads(cv_threads)
