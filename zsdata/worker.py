"""The worker: one index on the CPU, from the photo's bytes to all that the training device needs."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor

from zsdata.faults import BadPhoto, BadShard, NoUsablePhoto, failed
from zsdata.meter import Meter
from zsdata.plan import Choice
from zsdata.prepared import Draft, Prepared, make
from zsdata.quality import QualityGate
from zsdata.seeding import rng
from zsdata.source.depth_map import decode_depth
from zsdata.source.photo import PhotoFile, decode_rgb
from zsdata.source.shard_cache import ShardCache
from zsdata.sources import Schedule, SourceSet
from zsdata.synthesis.depth import DepthEstimator, DepthNetwork, load_depth
from zsdata.synthesis.depth.cache import DepthCache, photo_digest
from zsdata.synthesis.depth.maps import DepthMaps, depth_maps
from zsdata.synthesis.depth.options import STORED
from zsdata.synthesis.depth.preprocessing import Preprocessing
from zsdata.synthesis.disparity import AdaptiveDisparity, UniformDisparity
from zsdata.synthesis.synthesizer import INPAINT_CONTEXT_PX, SynthesisConfig, estimate_depth
from zsdata.synthesis.view import ViewConfig, draw_view, view_photo, whole_view

SHORTEST_SIDE_PX = 32  # a photo with a shorter side shows no scene
MOST_SPARES = 100  # tried for one sample before the source is called unusable

Rejected = tuple[str, str, str, str]  # source, shard, key, reason of a photo that could not be used


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """All that a sample depends on but its epoch and index; travels to the workers."""

    seed: int
    size: tuple[int, int] | None  # None: each photo whole, at its own size
    schedule: Schedule
    depth: str | DepthNetwork | DepthEstimator | None  # None: an estimator of the device's own
    preprocessing: Preprocessing | None  # of a depth network, by its name or loaded
    depth_cache: DepthCache | None
    disparity: AdaptiveDisparity | UniformDisparity
    view: ViewConfig
    synthesis: SynthesisConfig
    inpainter_needs: tuple[str, ...]
    gate: QualityGate
    shard_cache: ShardCache | None
    reuse: int  # samples, one after another, that are one pair with augmentations of their own
    depth_on_device: bool = False  # workers hand over drafts, and whoever owns the device makes the pairs


class _Photo:
    """A photo as far as it has been needed: its pixels and its depth are found once, however many views are drawn from it."""

    def __init__(self, data: bytes, stored_depth: bytes | None) -> None:
        self.data = data
        self.stored_depth = stored_depth
        self._file = PhotoFile(data)
        self.header = self._file.header
        width, height, _ = self.header
        if min(width, height) < SHORTEST_SIDE_PX:
            raise BadPhoto(f"too small: a side shorter than {SHORTEST_SIDE_PX} px: {width}x{height}")
        self.size = height, width
        self.depth: DepthMaps | None = None
        self._pixels: dict[int, np.ndarray] = {}

    def pixels(self, reduction: int = 1) -> np.ndarray:
        """uint8 [H, W, 3], RGB; a JPEG at one part in `reduction` of each side."""
        if reduction not in self._pixels:
            self._pixels[reduction] = self._file.decode(reduction)
        return self._pixels[reduction]


class Worker:
    """Makes pairs, one index at a time, on the CPU. The depth estimator is loaded at the first call, in the process that uses it."""

    def __init__(self, recipe: Recipe) -> None:
        self._recipe = recipe
        self._depth: DepthEstimator | None = None
        self._last: tuple[tuple[str, int], _Photo] | None = None  # the photo whose next view comes next
        self._last_pair: tuple[tuple[SourceSet, int, int], Prepared | Draft] | None = None

    def prepare(self, epoch: int, index: int) -> Prepared | Draft:
        """Sample `index` of `epoch` up to the holes; a photo that cannot be used is replaced by the sample's next spare.

        With depth on the device it is a draft of that.

        Raises:
            NoUsablePhoto: when no spare can be used either, with the reasons.
            SampleFailed, RuntimeError: when a step fails, with the sample named.
        """
        sources = self._recipe.schedule.at(epoch)
        pair = index - index % self._recipe.reuse
        if self._last_pair is not None and self._last_pair[0] == (sources, epoch, pair):
            made = self._last_pair[1]
            return replace(made, meta={**made.meta, "index": index}, seconds={})
        with single_thread():
            made = self._first_usable(sources, epoch, index, pair)
        if self._recipe.reuse > 1:
            self._last_pair = ((sources, epoch, pair), made)
        return made

    def photo_sizes(self, epoch: int, most: int) -> list[tuple[int, int]]:
        """(height, width) of the first photos of an epoch, without those that cannot be used."""
        sources = self._recipe.schedule.at(epoch)
        step, sizes = sources.plan.samples_per_photo, []
        for index in range(0, min(most * step, sources.plan.epoch_size), step):
            choice = sources.plan.choose(epoch, index)
            try:
                sizes.append(self._open(sources, choice, Meter()).size)
            except (BadPhoto, BadShard):  # counted when its turn comes
                continue
        self._last = None  # a worker that is sent to another process takes no photo along
        return sizes

    def instead(self, draft: Draft, reason: str) -> Draft:
        """What stands in for a draft whose pair, made elsewhere, was refused for `reason`; raises as `prepare`."""
        meta = draft.meta
        rejected = [*map(tuple, meta["replaced"]), (meta["source"], meta["shard"], meta["key"], reason)]
        sources = self._recipe.schedule.at(meta["epoch"])
        with single_thread():
            made = self._first_usable(sources, meta["epoch"], meta["index"], meta["pair"], rejected)
        assert isinstance(made, Draft)  # pairs are made elsewhere
        return made

    def _first_usable(self, sources: SourceSet, epoch: int, index: int, pair: int, rejected: Sequence[Rejected] = ()) -> Prepared | Draft:
        """The sample's first choice, or the first of its spares that is not refused; `rejected` are those that were tried already."""
        rejected = list(rejected)
        choice: Choice | None = sources.plan.choose(epoch, index) if not rejected else sources.plan.spare(epoch, index, len(rejected) - 1)
        while choice is not None and len(rejected) <= MOST_SPARES:
            member = sources.manifests[choice.source].member(choice.member)
            meta = {
                "seed": self._recipe.seed,
                "epoch": epoch,
                "index": index,
                "pair": pair,
                "source": sources.names[choice.source],
                "shard": member.shard_url,
                "key": member.key,
            }
            try:
                with naming(meta):
                    return self._make(self._draft(sources, choice, meta, rejected))
            except (BadPhoto, BadShard) as fault:
                rejected.append((meta["source"], member.shard_url, member.key, fault.reason))
            choice = sources.plan.spare(epoch, index, len(rejected) - 1)
        last = "; ".join(f"{key} in {shard}: {reason}" for _, shard, key, reason in rejected[-3:])
        raise NoUsablePhoto(
            f'no usable photo for sample {index} of epoch {epoch}: {len(rejected)} of source "{rejected[0][0]}" were refused, '
            f"the last ones: {last}. `zsdata verify` lists what is wrong with its shards."
        )

    def _make(self, draft: Draft) -> Prepared | Draft:
        recipe, meter = self._recipe, Meter()
        if draft.depth is None or recipe.depth_on_device:
            return draft
        made = make(draft, draft.depth, recipe.inpainter_needs, recipe.synthesis, recipe.gate, meter)
        meter.add(draft.seconds)
        return replace(made, seconds=meter.seconds)

    def _draft(self, sources: SourceSet, choice: Choice, meta: dict[str, Any], rejected: list[Rejected]) -> Draft:
        recipe, meter = self._recipe, Meter()
        spare = f" {len(rejected)}" if rejected else ""  # draws anew: it may be what was drawn that was refused

        def draw(purpose: str) -> np.random.Generator:
            return rng(recipe.seed, meta["epoch"], meta["pair"], purpose + spare)

        photo = self._open(sources, choice, meter)
        width = photo.size[1] if recipe.size is None else recipe.view.taken_width(photo.size[1], recipe.size[1])
        scale = recipe.disparity.draw_scale(draw("disparity"), width)
        if recipe.size is None:
            view = whole_view(photo.size)
        else:
            view = draw_view(photo.size, recipe.size, draw("view"), recipe.view, scale)
        with meter.stage("decode"):
            pixels = photo.pixels(view.reduction)
        with meter.stage("view"):
            left = _planes(view_photo(pixels, view, photo.size[0] // pixels.shape[0]))
        with meter.stage("depth"):
            digest = photo_digest(photo.data) if recipe.depth_cache is not None else ""
            depth = self._depth_of(photo, digest, view.rows)
        context = {}
        if "background" in recipe.inpainter_needs:
            with meter.stage("background"):
                size = view.height, view.width - view.margin
                context["background"] = _planes(self._background(sources, choice, draw("background"), photo, size))
        meta = {
            **meta,
            "photo_size": list(photo.size),
            "window": list(view.window),
            "mirror": view.mirror,
            "scale_x": view.scale_x,
            "disparity_scale": scale,
            "replaced": [list(reject) for reject in rejected],  # photos that could not be used: source, shard, key, reason
        }
        unseen = None
        if depth is None:
            with meter.stage("prepare"):
                unseen = self._for_the_device(photo)
        identity = sources.manifests[choice.source].digest, choice.member
        return Draft(identity, unseen, depth, digest, left, view, scale, context, meta, meter.seconds)

    def _for_the_device(self, photo: _Photo) -> Tensor:
        pixels = _planes(photo.pixels()).unsqueeze(0)
        return pixels if self._recipe.preprocessing is None else self._recipe.preprocessing.prepare(pixels)

    def _open(self, sources: SourceSet, choice: Choice, meter: Meter) -> _Photo:
        manifest = sources.manifests[choice.source]
        key = manifest.digest, choice.member
        if self._last is not None and self._last[0] == key:
            return self._last[1]
        with meter.stage("read"):  # depth first: where there is none, nothing else is read
            stored_depth = manifest.read_depth(choice.member, self._recipe.shard_cache) if self._recipe.depth == STORED else None
            data = manifest.read(choice.member, self._recipe.shard_cache)
        with meter.stage("decode"):
            photo = _Photo(data, stored_depth)
        preprocessing = self._recipe.preprocessing
        refused = None if preprocessing is None else preprocessing.refuses(*photo.size)
        if refused is not None:
            raise BadPhoto(refused)
        self._last = (key, photo) if sources.plan.samples_per_photo > 1 else None
        return photo

    def _depth_of(self, photo: _Photo, digest: str, rows: tuple[int, int]) -> DepthMaps | None:
        """Depth of at least these rows: what is known of the photo already, or stored, cached, or estimated now, or None: by the device."""
        if photo.depth is not None:
            return photo.depth
        if photo.stored_depth is not None:
            photo.depth = depth_maps(torch.from_numpy(decode_depth(photo.stored_depth, photo.header))[None, None], None)
            return photo.depth
        cache = self._recipe.depth_cache
        cached = cache.load(digest, rows) if cache is not None else None
        if cached is not None and cached.size == photo.size:
            inverse_depth, confidence = (torch.from_numpy(values)[None, None] for values in (cached.inverse_depth, cached.confidence))
            return DepthMaps(inverse_depth, confidence, torch.tensor([cached.consistency], dtype=torch.float64), cached.first_row)
        if self._recipe.depth_on_device:
            return None
        if self._depth is None:
            assert self._recipe.depth is not None  # only the device has none to give
            with Meter().stage("load"):  # may wait for a download
                self._depth = load_depth(self._recipe.depth)
        with torch.inference_mode():
            photo.depth = estimate_depth(self._depth, _planes(photo.pixels()).unsqueeze(0).float(), self._recipe.synthesis)
        if cache is not None:
            store_depth(cache, digest, photo.depth)
        return photo.depth

    def _background(
        self, sources: SourceSet, choice: Choice, generator: np.random.Generator, photo: _Photo, size: tuple[int, int]
    ) -> np.ndarray:
        """Another photo of the source at the size of the right view; the photo itself where the source has no other that can be read."""
        pixels: np.ndarray | None = None
        manifest = sources.manifests[choice.source]
        for _ in range(3):
            other = int(generator.integers(len(manifest)))
            if other == choice.member:
                continue
            try:
                pixels = decode_rgb(manifest.read(other, self._recipe.shard_cache))
                break
            except (BadPhoto, BadShard):  # counted when its own turn comes
                continue
        height, width = size
        return cv2.resize(photo.pixels() if pixels is None else pixels, (width + INPAINT_CONTEXT_PX, height), interpolation=cv2.INTER_AREA)


def _planes(photo: np.ndarray) -> Tensor:
    """uint8 [H, W, 3] to uint8 [3, H, W]."""
    planes = np.empty((3, *photo.shape[:2]), np.uint8)
    cv2.split(photo, [planes[0], planes[1], planes[2]])
    return torch.from_numpy(planes)


def store_depth(cache: DepthCache, digest: str, depth: DepthMaps) -> None:
    """Keeps the depth of one whole photo."""
    inverse_depth, confidence = (values[0, 0].cpu().numpy() for values in (depth.inverse_depth, depth.confidence))
    cache.store(digest, inverse_depth, confidence, float(depth.consistency[0]))


@contextmanager
def naming(meta: dict[str, Any]) -> Iterator[None]:
    """Errors other than those of photos and shards say which sample they are about."""
    try:
        yield
    except (BadPhoto, BadShard):
        raise
    except Exception as error:
        place = f'source "{meta["source"]}", "{meta["key"]}" in {meta["shard"]}'
        raise failed(f"sample {meta['index']} of epoch {meta['epoch']} ({place})", error) from error


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
