"""Which example is number i of step s: a function of (seed, s, i), the data and nothing else; faults are replaced and counted."""

from __future__ import annotations

import hashlib
import json
import logging
import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from trainers.inpaint_data.examples import Draw, Example, from_photo, from_stereo
from trainers.inpaint_data.layouts import StereoFolder
from trainers.inpaint_data.tars import StereoTars
from zsdata.faults import BadPhoto, BadShard, NoUsablePhoto, failed
from zsdata.hub import hub_models
from zsdata.meter import Meter
from zsdata.plan import Choice, EpochPlan
from zsdata.position import Position
from zsdata.seeding import rng
from zsdata.source.depth_map import decode_depth
from zsdata.source.manifest import Manifest
from zsdata.source.photo import PhotoFile
from zsdata.sources import check_depth_maps
from zsdata.stream import DEPTH_CACHE_BYTES
from zsdata.synthesis.depth import DepthEstimator, DepthNetwork, as_network, load_depth
from zsdata.synthesis.depth.builtin import warn_once
from zsdata.synthesis.depth.cache import DepthCache, photo_digest
from zsdata.synthesis.depth.identity import depth_identity, pinned
from zsdata.synthesis.depth.maps import NEAREST, depth_maps
from zsdata.synthesis.depth.options import STORED
from zsdata.synthesis.depth.pretrained import preprocessing_of
from zsdata.synthesis.disparity import AdaptiveDisparity
from zsdata.synthesis.synthesizer import SynthesisConfig, estimate_depth
from zsdata.worker import MOST_SPARES, SHORTEST_SIDE_PX, single_thread, store_depth

logger = logging.getLogger("zsdata")


class Source(Protocol):
    """Something that examples can be made of, by number."""

    @property
    def digest(self) -> str: ...

    @property
    def models(self) -> dict[str, str]:
        """Those of the Hub that take part: "owner/name@commit" by what they are used for."""
        ...

    def __len__(self) -> int: ...

    def place(self, index: int) -> tuple[str, str]:
        """Where it lies, and its name there."""
        ...

    def make(self, index: int, size: tuple[int, int], draw: Draw) -> Example:
        """Raises BadPhoto or BadShard where it cannot be used."""
        ...


@dataclass(frozen=True)
class StereoSource:
    """Examples of stereo pairs with their true disparity."""

    pairs: StereoFolder | StereoTars

    @property
    def digest(self) -> str:
        return self.pairs.digest

    @property
    def models(self) -> dict[str, str]:
        return {}

    def __len__(self) -> int:
        return len(self.pairs)

    def place(self, index: int) -> tuple[str, str]:
        return self.pairs.place(index)

    def make(self, index: int, size: tuple[int, int], draw: Draw) -> Example:
        with Meter().stage("read"):  # may wait for a disk or a server
            frame = self.pairs.read(index)
        with Meter().stage("example"):
            return from_stereo(frame, size, draw)


class PhotoSource:
    """Examples of single photos. The depth estimator is loaded at the first one, in the process that uses it.

    Args:
        manifest: of the tars that hold the photos.
        depth: as `load_depth` takes it; or "stored", the maps beside the photos.
        scale: draws how far apart the cameras stand.
        depth_cache: a folder that keeps the depth of every photo, so that it is estimated once and not in every epoch. Shared with streams
            that weigh their labels by confidence, so depth of the mirrored photo is estimated and kept with it.

    Raises:
        ValueError: "stored", and no photo has a map, or a cache is asked to keep the maps a second time.
        ImportError, OSError, ValueError: a network that cannot be loaded.
    """

    def __init__(
        self,
        manifest: Manifest,
        depth: str | DepthNetwork | DepthEstimator,
        scale: AdaptiveDisparity,
        depth_cache: str | os.PathLike[str] | None = None,
    ) -> None:
        if depth == STORED and depth_cache is not None:
            raise ValueError(f'depth "{STORED}" is read from the tars, and a depth cache would keep it a second time; leave the cache out')
        self._manifest, self._scale = manifest, scale
        self._depth: DepthEstimator | None = None
        if manifest.problems:
            first = manifest.problems[0]
            logger.warning(
                "%d faults in the tars of photos, the first: %s: %s", len(manifest.problems), first.key or first.shard, first.reason
            )
        self._preprocessing = preprocessing_of(depth)  # what cannot be loaded fails here, and not in a worker
        network = as_network(depth)
        self._name = depth = depth if network is None else pinned(network)
        if depth == STORED:
            check_depth_maps("photos", manifest)
        elif depth == "builtin":
            warn_once()  # here, and not in every worker
        self._cache: DepthCache | None = None
        if depth_cache is not None:
            self._cache = DepthCache(depth_cache, DEPTH_CACHE_BYTES, f"{depth_identity(depth)}, flip confidence")  # as a stream calls it

    @property
    def digest(self) -> str:
        depth: Any = self._name
        if isinstance(depth, DepthNetwork):
            depth = [depth.name, depth.resolution, depth.predicts, depth.dtype]
        elif callable(depth):
            depth = getattr(depth, "__qualname__", type(depth).__qualname__)
        return hashlib.sha256(json.dumps([self._manifest.digest, depth, asdict(self._scale)]).encode()).hexdigest()

    @property
    def models(self) -> dict[str, str]:
        return hub_models(self._name)

    def __len__(self) -> int:
        return len(self._manifest)

    def place(self, index: int) -> tuple[str, str]:
        member = self._manifest.member(index)
        return member.shard_url, member.key

    def make(self, index: int, size: tuple[int, int], draw: Draw) -> Example:
        with Meter().stage("read"):
            stored = self._manifest.read_depth(index) if self._name == STORED else None
            data = self._manifest.read(index)
        with Meter().stage("example"):
            return self._make(data, stored, size, draw)

    def _make(self, data: bytes, stored: bytes | None, size: tuple[int, int], draw: Draw) -> Example:
        file = PhotoFile(data)
        width, height, _ = file.header
        if min(height, width) < SHORTEST_SIDE_PX:
            raise BadPhoto(f"too small: a side shorter than {SHORTEST_SIDE_PX} px: {width}x{height}")
        if self._preprocessing is not None and (refused := self._preprocessing.refuses(height, width)) is not None:
            raise BadPhoto(refused)
        photo = file.decode()
        if stored is not None:
            depth = depth_maps(torch.from_numpy(decode_depth(stored, file.header))[None, None], None).inverse_depth
        else:
            depth = self._estimated(photo, data)
        return from_photo(photo, depth.float() / NEAREST, self._scale, size, draw)

    def _estimated(self, photo: np.ndarray, data: bytes) -> Tensor:
        """Inverse depth as whole numbers, which come out of the cache as they went in."""
        cache, digest = self._cache, ""
        if cache is not None:
            digest = photo_digest(data)
            cached = cache.load(digest)
            if cached is not None and cached.size == photo.shape[:2]:
                return torch.from_numpy(cached.inverse_depth)[None, None]
        if self._depth is None:
            with Meter().stage("load"):  # may wait for a download
                self._depth = load_depth(self._name)
        image = torch.from_numpy(photo).permute(2, 0, 1)[None].to(torch.float32, memory_format=torch.contiguous_format)
        with torch.inference_mode():
            depth = estimate_depth(self._depth, image, SynthesisConfig(flip_confidence=cache is not None))
        if cache is not None:
            store_depth(cache, digest, depth)
        return depth.inverse_depth


@dataclass(frozen=True)
class ExampleBatch:
    """Examples as they cross the process border: images uint8 [B, 3, H, W], `inpaint_mask` bool [B, 1, H, W], True in holes.

    `requests` holds (step, index) of each, `meta` where it comes from; `rejected` lists (source, place, name, reason) of what could
    not be used. `right` is the truth; `warped` is 0 in its holes.
    """

    right: Tensor
    warped: Tensor
    inpaint_mask: Tensor
    requests: list[tuple[int, int]]
    meta: list[dict[str, Any]]  # epoch and index in it, source, shard (of pairs: their folder), key
    rejected: list[tuple[str, str, str, str]]

    @staticmethod
    def stack(examples: list[ExampleBatch]) -> ExampleBatch:
        """Several batches to one, in order."""
        return ExampleBatch(
            right=torch.cat([example.right for example in examples]),
            warped=torch.cat([example.warped for example in examples]),
            inpaint_mask=torch.cat([example.inpaint_mask for example in examples]),
            requests=[request for example in examples for request in example.requests],
            meta=[meta for example in examples for meta in example.meta],
            rejected=[reject for example in examples for reject in example.rejected],
        )


class Examples:
    """All examples of a training; (step, index of the step's batch) in, a batch of one out.

    Epoch after epoch goes through all sources in an order of its own; every pair and photo comes once in each.

    Args:
        sources: by name. A source keeps its order whatever stands beside it.
        size: (height, width) of the crops, in pixels.
        batch_size: examples of one step, over all ranks and accumulated batches.
    """

    def __init__(self, sources: Mapping[str, Source], size: tuple[int, int], seed: int, batch_size: int) -> None:
        sizes = tuple(len(source) for source in sources.values())
        self._sources, self.size, self._seed, self._batch_size = dict(sources), size, seed, batch_size
        self._plan = EpochPlan(seed, tuple(sources), sizes, sizes)

    def __len__(self) -> int:
        """Pairs and photos in all."""
        return self._plan.epoch_size

    def __getitem__(self, request: tuple[int, int]) -> ExampleBatch:
        """Raises NoUsablePhoto when no spare can be used either, SampleFailed or RuntimeError when a step fails, with the example named."""
        step, index = request
        epoch, place = self.place(step, index)
        draw = partial(rng, self._seed, step, index)
        rejected: list[tuple[str, str, str, str]] = []
        choice: Choice | None = self._plan.choose(epoch, place)
        with single_thread():
            while choice is not None and len(rejected) <= MOST_SPARES:
                name, source = list(self._sources.items())[choice.source]
                where = source.place(choice.member)
                try:
                    right, warped, inpaint_mask = source.make(choice.member, self.size, draw)
                    meta = {"epoch": epoch, "index": place, "source": name, "shard": where[0], "key": where[1]}
                    return ExampleBatch(_to_uint8(right), _to_uint8(warped), inpaint_mask, [request], [meta], rejected)
                except (BadPhoto, BadShard) as fault:
                    rejected.append((name, *where, fault.reason))
                except Exception as error:
                    raise failed(f'example {index} of step {step} ("{where[1]}" in {where[0]})', error) from error
                choice = self._plan.spare(epoch, place, len(rejected) - 1)
        last = "; ".join(f"{name} in {where}: {reason}" for _, where, name, reason in rejected[-3:])
        raise NoUsablePhoto(
            f"nothing usable for example {index} of step {step}: {len(rejected)} of {rejected[0][0]} were refused, the last ones: {last}"
        )

    def place(self, step: int, index: int) -> tuple[int, int]:
        """(epoch, place in it) of an example."""
        return divmod(step * self._batch_size + index, len(self))

    def sample(self, epoch: int, place: int) -> ExampleBatch:
        """As `examples[step, index]`, by its epoch and its place in it."""
        return self[divmod(epoch * len(self) + place, self._batch_size)]

    def position(self, step: int) -> Position:
        """The place before `step`: what a checkpoint keeps and checks."""
        epoch, place = self.place(step, 0)
        digests = [(name, len(source), source.digest) for name, source in self._sources.items()]
        return Position(
            seed=self._seed,
            epoch=epoch,
            samples=place,
            manifest=hashlib.sha256(json.dumps(digests).encode()).hexdigest(),
            configuration=hashlib.sha256(json.dumps([self.size, self._batch_size]).encode()).hexdigest(),
            models={use: model for source in self._sources.values() for use, model in source.models.items()},
        )


def _to_uint8(image: Tensor) -> Tensor:
    return (image + 0.5).to(torch.uint8)
