"""Image sources: what the user names, found, weighed and put in order."""

from __future__ import annotations

import hashlib
import json
import logging
import math
import os
import sys
from bisect import bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from zsdata.plan import EpochPlan, quotas_for
from zsdata.source.archive import Problem
from zsdata.source.manifest import Manifest, build_manifest
from zsdata.source.urls import shown_url
from zsdata.synthesis.depth.options import STORED

logger = logging.getLogger("zsdata")


@dataclass(frozen=True)
class ImageSource:
    """Tars of photos under one weight.

    Args:
        urls: a path or url, a pattern with braces ("shards/{000..099}.tar") or wildcards, or a list of such.
        weight: share of the samples relative to the other sources; None weighs as many photos as it has.
    """

    urls: str | os.PathLike[str] | Sequence[str | os.PathLike[str]]
    weight: float | None = None


def parse_sources(specs: Sequence[str]) -> list[str] | dict[str, ImageSource]:
    """Sources as a command line names them: urls, or NAME=URL and NAME=URL@WEIGHT ("indoor=in.tar@0.7").

    A name has no "/", so "./year=2020/a.tar" has none, and neither has a path that exists. What follows the last "@" is a weight if it is
    a number, and part of the url otherwise.

    Raises:
        ValueError: a name without a url, a name given twice, or names for some only.
    """
    named = [_split_name(spec) for spec in specs]
    if all(name is None for name, _ in named):
        return list(specs)
    sources: dict[str, ImageSource] = {}
    for name, rest in named:
        urls, weight = _split_weight(rest)
        if not name or not urls or name in sources:
            shown = shown_url(rest) if name is None else f"{name}={shown_url(rest)}"
            raise ValueError(
                f"a named source is NAME=URL or NAME=URL@WEIGHT, each name once, and all sources have one or none; got {shown!r}"
            )
        sources[name] = ImageSource(urls, weight=weight)
    return sources


def _split_name(spec: str) -> tuple[str | None, str]:
    """NAME and the rest of NAME=URL; None and all of a url without a name."""
    name, equals, rest = spec.partition("=")
    return (name, rest) if equals and "/" not in name and not os.path.exists(spec) else (None, spec)


def _split_weight(text: str) -> tuple[str, float | None]:
    """URL and WEIGHT of URL@WEIGHT; all of it and None where no number is at its end."""
    urls, at, weight = text.rpartition("@")
    try:
        return (urls, float(weight)) if at else (text, None)
    except ValueError:  # the "@" is the url's
        return text, None


@dataclass(frozen=True)
class SourceSet:
    """The sources that are in use together, and the plan of their epochs."""

    names: tuple[str, ...]
    manifests: tuple[Manifest, ...]
    plan: EpochPlan


class Schedule:
    """Which sources are in use in which epoch.

    Args:
        sources: as `ZeroStereoStream` takes them: urls, a list of urls, {name: ImageSource or urls}, or {first epoch: any of these}.
        seed, epoch_size: as `ZeroStereoStream` takes them.
        samples_per_photo: samples that are made from one photo, one after another.
        stored_depth: the photos' depth is read with them, so a source without any depth map is an error.
    """

    def __init__(self, sources: Any, seed: int, epoch_size: int | None, samples_per_photo: int = 1, *, stored_depth: bool = False) -> None:
        if epoch_size is not None and (
            isinstance(epoch_size, bool) or not isinstance(epoch_size, int) or not 1 <= epoch_size <= sys.maxsize
        ):
            raise ValueError(
                f"epoch_size is a number of samples, 1 to {sys.maxsize}, or None for one exact pass over the photos; got {epoch_size!r}"
            )
        self._seed = seed
        self._epoch_size = epoch_size
        self._samples_per_photo = samples_per_photo
        self._stored_depth = stored_depth
        self._manifests: dict[str, Manifest] = {}
        self._problems: dict[Problem, None] = {}  # each once, in the order in which they were found
        by_epoch = _by_epoch(sources)
        self._starts = sorted(by_epoch)
        self._sets = [self._open(by_epoch[start]) for start in self._starts]

    def at(self, epoch: int) -> SourceSet:
        """The sources of `epoch`."""
        return self._sets[bisect_right(self._starts, epoch) - 1]

    def swap(self, epoch: int, sources: Any) -> None:
        """Uses `sources` from `epoch` on; what was planned for later epochs is dropped."""
        if isinstance(sources, Mapping) and sources and all(isinstance(key, int) for key in sources):
            raise ValueError("set_sources takes the sources of the coming epochs; give a schedule {epoch: sources} to the stream itself")
        opened = self._open(sources)
        kept = [i for i, start in enumerate(self._starts) if start < epoch]
        self._starts = [*(self._starts[i] for i in kept), epoch]
        self._sets = [*(self._sets[i] for i in kept), opened]

    @property
    def problems(self) -> list[Problem]:
        """What was wrong with the shards, over all sources."""
        return list(self._problems)

    @property
    def digest(self) -> str:
        """Changes with any photo, source name, quota or epoch at which sources are swapped."""
        content = [
            (start, sources.names, sources.plan.quotas, sources.plan.epoch_size, [manifest.digest for manifest in sources.manifests])
            for start, sources in zip(self._starts, self._sets, strict=True)
        ]
        return hashlib.sha256(json.dumps(content).encode()).hexdigest()

    def _open(self, sources: Any) -> SourceSet:
        named = _by_name(sources)
        manifests = tuple(self._manifest(source.urls) for source in named.values())
        if self._stored_depth:
            for name, manifest in zip(named, manifests, strict=True):
                check_depth_maps(name, manifest)
        sizes = tuple(len(manifest) for manifest in manifests)
        if self._epoch_size is None and any(source.weight is not None for source in named.values()):
            logger.warning("without epoch_size an epoch is one pass over the photos and the sources' weights change nothing; set it")
        photos = None if self._epoch_size is None else math.ceil(self._epoch_size / self._samples_per_photo)
        quotas = quotas_for(sizes, [source.weight for source in named.values()], photos)
        for (name, source), quota in zip(named.items(), quotas, strict=True):
            if not quota and source.weight != 0:
                logger.warning(
                    'source "%s" gives no photo: its share is less than one of the %d that make an epoch; raise its weight or epoch_size',
                    name,
                    sum(quotas),
                )
        plan = EpochPlan(self._seed, tuple(named), sizes, quotas, self._samples_per_photo, self._epoch_size)
        return SourceSet(tuple(named), manifests, plan)

    def _manifest(self, urls: Any) -> Manifest:
        key = repr(urls)
        if key not in self._manifests or not self._manifests[key].is_current(urls):  # a folder may have grown since
            self._manifests[key] = manifest = build_manifest(urls)
            self._problems |= dict.fromkeys(manifest.problems)
        return self._manifests[key]


def check_depth_maps(name: str, manifest: Manifest) -> None:
    """Refuses a source without depth maps, and says so of one where some are missing."""
    photos, missing = len(manifest), len(manifest) - manifest.depth_maps
    if missing == photos:
        raise ValueError(
            f'depth="{STORED}", but not one of the {photos:,} photos of source "{name}" ({manifest.member(0).shard_url}, ...) has a depth '
            "map: add KEY.depth.npy or KEY.depth.png (16-bit grey) beside KEY.jpg, as `zsdata pack` does with files of these names, or "
            "let depth be estimated"
        )
    if missing:
        logger.warning('%d of the %d photos of source "%s" have no depth map and are refused when their turn comes', missing, photos, name)


def _by_epoch(sources: Any) -> dict[int, Any]:
    if not isinstance(sources, Mapping):
        return {0: sources}
    if not sources:
        raise ValueError("sources is empty; name at least one tar of photos")
    kinds = {type(key) for key in sources}
    if kinds == {str}:
        return {0: sources}
    if kinds != {int}:
        raise TypeError(f"the keys of sources are all names or all epochs; got {list(sources)}")
    if min(sources) != 0:
        raise ValueError(f"a schedule of sources begins with epoch 0; got epochs {sorted(sources)}")
    return dict(sources)


def _by_name(sources: Any) -> dict[str, ImageSource]:
    if not isinstance(sources, Mapping):
        sources = {"photos": sources}
        if isinstance(sources["photos"], Sequence) and any(isinstance(source, ImageSource) for source in sources["photos"]):
            raise TypeError('a list holds urls, and several ImageSource are named: {"indoor": ImageSource(...), "street": ...}')
    if not sources:
        raise ValueError("sources is empty; name at least one tar of photos")
    if not all(isinstance(name, str) for name in sources):
        raise TypeError(f"the sources of an epoch are named by strings; got {list(sources)}")
    return {name: source if isinstance(source, ImageSource) else ImageSource(source) for name, source in sources.items()}
