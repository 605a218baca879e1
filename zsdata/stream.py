"""ZeroStereoStream: photos in tars, named once; stereo pairs out, for as long as a matcher trains."""

from __future__ import annotations

import hashlib
import json
import logging
import math
import os
import sys
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import asdict, replace
from importlib.metadata import version
from typing import Any, Literal

import torch
from torch.utils.data import IterableDataset, get_worker_info

from zsdata.augment import AugmentConfig
from zsdata.faults import FailureBudget, FaultLog
from zsdata.finish import Finisher, Synthesis
from zsdata.hub import hub_models
from zsdata.launch import launched_as
from zsdata.licences import fetch_cards, model_records, require_commercial, warn_of_unknown_licences
from zsdata.loader import SAMPLE_TIMEOUT_SECONDS, StereoLoader
from zsdata.meter import Meter
from zsdata.position import Position
from zsdata.prepared import Draft, Prepared, stack
from zsdata.progress import Progress
from zsdata.quality import QualityGate
from zsdata.sample import StereoBatch
from zsdata.source.shard_cache import ShardCache
from zsdata.sources import Schedule
from zsdata.synthesis.depth import DepthEstimator, DepthNetwork, as_network, depth_name, load_depth
from zsdata.synthesis.depth.builtin import warn_once
from zsdata.synthesis.depth.cache import DepthCache
from zsdata.synthesis.depth.identity import depth_identity, pinned
from zsdata.synthesis.depth.options import STORED
from zsdata.synthesis.depth.pretrained import preprocessing_of
from zsdata.synthesis.disparity import AdaptiveDisparity, UniformDisparity
from zsdata.synthesis.inpaint import DiffusionNetwork, Inpainter, as_pipeline, checked_pipeline, load_inpainter
from zsdata.synthesis.micro_batch import say_warm_up
from zsdata.synthesis.synthesizer import SynthesisConfig
from zsdata.synthesis.view import ViewConfig
from zsdata.worker import Recipe, Worker

logger = logging.getLogger("zsdata")

SMALLEST_CROP_PX = 32
MOST_SAMPLES_OF_ONE = 100_000  # views of a photo, or uses of a pair; more is a slip
DEPTH_PLACEMENTS = ("auto", "worker", "device")
SHARD_CACHE_BYTES = 100_000_000_000
# A revision is a name for a commit, and it is the commit that counts.
CHANGES_NO_PICTURE = ("compile", "micro_batch", "memory_gib", "revision", "autoencoder_revision")
WARM_UP_PHOTOS = 16  # whose sizes tell what networks on the device are made ready for
DEPTH_CACHE_BYTES = 50_000_000_000  # about 50,000 photos of 480x640


class ZeroStereoStream(IterableDataset):
    """An endless, reproducible stream of stereo pairs made from single photos (ZeroStereo, ICCV 2025).

    Sample i of epoch e is a function of (seed, e, i), the photos and these arguments, and of nothing else: not of the number of workers or
    ranks, the batch size, or what was drawn before. Iterating the stream itself gives the finished pairs of one epoch on the CPU, and of
    the next one when iterated again; `loader` gives finished batches on a device, made ahead by worker processes.

    Inside a torch DataLoader with workers each worker makes its share of the samples. There, torch copies the stream to new workers for
    every epoch, so say which epoch it is: `stream.set_epoch(epoch)`; with `persistent_workers=True` the workers count for themselves, and
    a loop that is broken off ends its epoch. Such a loader knows nothing of ranks, and `state_dict` nothing of its place: `loader` does.

    Args:
        sources: tars of photos: a path, url or pattern ("shards/{000..099}.tar"), a list of such, named and weighted sources
            ({"indoor": ImageSource("in.tar", weight=0.7), "street": ImageSource("out.tar", weight=0.3)}), or any of these by the epoch
            from which they are used ({0: "first.tar", 5: "second.tar"}).
        size: (height, width) of the pairs, in pixels; None gives every pair its photo's own size: the whole photo as it is.
        depth: "builtin", a Hub id or folder in the transformers format, a `DepthNetwork` with options, or a callable (see `load_depth`);
            or "stored": the maps beside the photos, KEY.depth.npy or KEY.depth.png (see `zsdata.source.depth_map`). Their labels have
            confidence 1, as nothing is known of the mirrored photo; a photo without one is refused.
        inpaint: "builtin", "background", a Hub id or folder in the diffusers format, a `DiffusionNetwork` with options, or a callable (see
            `load_inpainter`).
        disparity: how far apart the cameras stand: AdaptiveDisparity (the paper's) or UniformDisparity (MfS-Stereo's).
        seed: an integer >= 0.
        epoch_size: samples per epoch; None is one exact pass over the photos, whatever their sources' weights.
        views_per_image: samples that are made from one photo, one after another: each a view, disparity and augmentation of its own. The
            photo is decoded, and its depth estimated, once for all of them, and the pairs of a batch resemble each other more.
        reuse: samples that share one pair, one after another, each with an augmentation of its own: for inpainters that are slower than
            the training. A multiple of it makes the best batch size.
        depth_placement: "worker": depth is estimated by the loader's workers, on the CPU; "device": workers stop after decoding, and the
            loader estimates and warps on its device; "auto": on the device for a network whose loader has a GPU, or that was loaded onto
            one, in the workers otherwise. Plain iteration and `replay` do everything on the CPU.
        depth_resolution: the short side of a depth network's input in pixels, or "native", the photo's own size; None is the network's own.
        commercial_safe: refuses models that are known to be for non-commercial use alone, and warns of those whose licence is not known, as
            of stored depth.
        depth_cache: a folder that keeps the depth of every photo, so that a slow estimator is paid once per photo and not once per epoch.
            Any number of workers, ranks and runs may share it.
        depth_cache_bytes: the most that the folder may hold; 3 bytes per pixel of each photo. A full cache keeps what it has.
        shard_cache: a folder that keeps what was read from shards behind a url; shared as `depth_cache` is.
        shard_cache_bytes: the most that it may hold.
        quality: which pairs are refused and replaced: too many holes, flat depth, and the like.
        view, synthesis, augmentation: configurations of these steps; `AugmentConfig.none()` leaves the pairs as they are.
        budget: how many photos may be refused before the run stops.

    Raises:
        ValueError, TypeError, FileNotFoundError: at once, for an argument that cannot work.
        ImportError, OSError: the packages for a network are not installed, or nothing is found under its name.
    """

    def __init__(
        self,
        sources: Any,
        *,
        size: tuple[int, int] | None = (384, 512),
        depth: str | os.PathLike[str] | DepthNetwork | DepthEstimator = "builtin",
        inpaint: str | os.PathLike[str] | DiffusionNetwork | Inpainter = "builtin",
        disparity: AdaptiveDisparity | UniformDisparity | None = None,
        seed: int = 0,
        epoch_size: int | None = None,
        views_per_image: int = 1,
        reuse: int = 1,
        depth_placement: str = "auto",
        depth_resolution: int | Literal["native"] | None = None,
        commercial_safe: bool = False,
        depth_cache: str | os.PathLike[str] | None = None,
        depth_cache_bytes: int = DEPTH_CACHE_BYTES,
        view: ViewConfig | None = None,
        synthesis: SynthesisConfig | None = None,
        augmentation: AugmentConfig | None = None,
        shard_cache: str | os.PathLike[str] | None = None,
        shard_cache_bytes: int = SHARD_CACHE_BYTES,
        quality: QualityGate | None = None,
        budget: FailureBudget | None = None,
    ) -> None:
        super().__init__()
        if isinstance(seed, bool) or not isinstance(seed, int) or seed < 0:
            raise ValueError(f"seed is an integer >= 0; got {seed!r}")
        if size is not None and not (
            isinstance(size, (tuple, list)) and len(size) == 2 and all(isinstance(side, int) and side >= SMALLEST_CROP_PX for side in size)
        ):
            raise ValueError(f"size is (height, width) in pixels, each {SMALLEST_CROP_PX} or more, or None for whole photos; got {size!r}")
        for name, count in (("views_per_image", views_per_image), ("reuse", reuse)):
            if isinstance(count, bool) or not isinstance(count, int) or not 1 <= count <= MOST_SAMPLES_OF_ONE:
                raise ValueError(f"{name} is an integer, 1 or more and at most {MOST_SAMPLES_OF_ONE:,}; got {count!r}")
        if depth_placement not in DEPTH_PLACEMENTS:
            raise ValueError(f"depth_placement is one of {', '.join(DEPTH_PLACEMENTS)}; got {depth_placement!r}")
        place = getattr(depth, "device", None)  # of a network that is loaded already
        self._depth_elsewhere = isinstance(place, torch.device) and place.type != "cpu"
        if depth_placement == "worker" and self._depth_elsewhere:
            raise ValueError(
                f'depth_placement="worker" estimates depth on the CPU, and the network that was given is on {place}; load it onto the CPU '
                '(load_depth(..., device="cpu")), give its name instead, or say depth_placement="device"'
            )
        self._depth_placement = depth_placement
        self._views_per_image = views_per_image
        self._samples_per_photo = views_per_image * reuse
        depth = depth if callable(depth) or isinstance(depth, DepthNetwork) else depth_name(depth)
        self._schedule = Schedule(sources, seed, epoch_size, self._samples_per_photo, stored_depth=depth == STORED)
        self._revision = 0
        self._told_problems = 0
        self._tell_problems()
        self._inpaint = inpaint if callable(inpaint) or isinstance(inpaint, DiffusionNetwork) else os.fspath(inpaint)
        self._augmentation = augmentation if augmentation is not None else AugmentConfig()
        self._budget = budget if budget is not None else FailureBudget()
        pipeline = as_pipeline(self._inpaint)
        inpainter = load_inpainter(self._inpaint) if pipeline is None else None
        if depth == STORED and depth_cache is not None:
            raise ValueError(
                f'depth="{STORED}" is read from the shards, and depth_cache would keep it a second time; leave depth_cache out '
                "(shard_cache keeps what was read from a url)"
            )
        if depth_resolution is not None:
            if not isinstance(depth, str) or depth in ("builtin", STORED):
                raise ValueError(f"depth_resolution belongs to a network given by name or folder; depth is {_name_of(depth, None)!r}")
            depth = DepthNetwork(depth, resolution=depth_resolution)
        if commercial_safe:  # before anything is downloaded
            for argument, step in {"depth": depth, "inpaint": self._inpaint}.items():
                require_commercial(step, argument)
        self._depth = depth
        preprocessing = preprocessing_of(depth)
        network = as_network(depth)
        self._pinned_depth = depth = depth if network is None else pinned(network)
        self._pinned_inpaint = self._inpaint if pipeline is None else checked_pipeline(pipeline)
        fetch_cards(self._pinned_depth, self._pinned_inpaint)
        if commercial_safe:  # once more, of the commits that are used
            for argument, step in {"depth": self._pinned_depth, "inpaint": self._pinned_inpaint}.items():
                require_commercial(step, argument)
                warn_of_unknown_licences(step, argument)
        synthesis = synthesis if synthesis is not None else SynthesisConfig()
        self._recipe = Recipe(
            seed=seed,
            size=None if size is None else (int(size[0]), int(size[1])),
            schedule=self._schedule,
            depth=self._pinned_depth,
            preprocessing=preprocessing,
            depth_cache=_open_cache(depth_cache, depth_cache_bytes, depth, synthesis),
            disparity=disparity if disparity is not None else AdaptiveDisparity(),
            view=view if view is not None else ViewConfig(),
            synthesis=synthesis,
            inpainter_needs=tuple(getattr(inpainter, "needs", ())),
            gate=quality if quality is not None else QualityGate(),
            shard_cache=None if shard_cache is None else ShardCache(shard_cache, shard_cache_bytes),
            reuse=reuse,
        )
        if self._pinned_depth == "builtin":
            warn_once()  # here, and not in every worker
        self._worker = Worker(self._recipe)
        self._cpu_finisher: Finisher | None = None
        self._faults = FaultLog(self._budget)
        self._meter = Meter()
        self._epoch = 0
        self._samples = 0
        self._loop_is_open = False  # over a DataLoader worker's share

    def __len__(self) -> int:
        """Samples in the epoch that comes next."""
        return self.epoch_size(self._epoch)

    def epoch_size(self, epoch: int) -> int:
        """Samples in `epoch`."""
        return self._schedule.at(epoch).plan.epoch_size

    def __iter__(self) -> Iterator[StereoBatch]:
        """The finished pairs of an epoch, on the CPU, without a batch axis; from where the last loop stopped."""
        info = get_worker_info()
        if info is None:
            if self._samples >= self.epoch_size(self._epoch):  # the last loop was broken off at its last pair
                self._epoch, self._samples = self._epoch + 1, 0
            return self._pairs(0, 1)
        if self._loop_is_open:  # pairs are fetched ahead, so the workers stand at different places, or one of them in the next epoch
            self._epoch, self._samples = self._epoch + 1, 0
        self._loop_is_open = True
        return self._pairs(info.id, info.num_workers)

    def _pairs(self, share: int, shares: int) -> Iterator[StereoBatch]:
        epoch = self._epoch
        for index in range(self._samples, self.epoch_size(epoch)):
            if index // self._samples_per_photo % shares != share:  # what is made from one photo stays together
                continue
            pair = self._make(epoch, index)
            self._samples = index + 1
            yield pair
            if self._epoch != epoch:
                return  # another loop or a set_epoch has moved the stream on
        self._epoch, self._samples = epoch + 1, 0
        self._loop_is_open = False

    def set_epoch(self, epoch: int) -> None:
        """The next loop over the stream gives this epoch, from its first sample."""
        if epoch < 0:
            raise ValueError(f"an epoch is 0 or more; got {epoch}")
        self._epoch, self._samples = epoch, 0
        self._loop_is_open = False

    def set_sources(self, sources: Any, *, epoch: int) -> None:
        """Uses other sources from `epoch` on; loaders follow by themselves. A torch `DataLoader`'s workers do when they are started anew,
        so not with `persistent_workers=True`.

        A state saved afterwards belongs to the stream with this swap in it: before resuming, swap again or give the schedule
        {0: ..., epoch: ...} from the start.
        """
        if epoch < 1:
            raise ValueError(f"sources can be swapped from epoch 1 on; got {epoch}. For epoch 0 give them to the stream itself.")
        self._schedule.swap(epoch, sources)
        self._revision += 1
        self._tell_problems()

    def replay(self, epoch: int, index: int) -> StereoBatch:
        """One sample again, just as training saw it: a finished pair on the CPU; `meta` says where it came from."""
        if epoch < 0:
            raise IndexError(f"an epoch is 0 or more; got {epoch}")
        return self._finish(self._worker.prepare(epoch, index))

    def loader(
        self,
        batch_size: int,
        *,
        num_workers: int = 0,
        device: str | torch.device = "cpu",
        rank: int | None = None,
        world_size: int | None = None,
        micro_batch: int | None = None,
        multiprocessing_context: str | None = None,
        timeout_seconds: float = SAMPLE_TIMEOUT_SECONDS,
        rejected: str | os.PathLike[str] | None = None,
    ) -> StereoLoader:
        """Finished batches on `device`, made ahead by `num_workers` processes.

        Args:
            batch_size: pairs per batch and rank.
            num_workers: processes on the CPU; 0 makes the pairs in this one.
            device: where the batches are finished and given out.
            rank, world_size: which share of every global batch this process is given. None asks torch.distributed, or the launcher that
                started it (torchrun, accelerate launch); without either it is all of them.
            micro_batch: pairs that are inpainted at once; changes memory and speed, and the pictures by no more than rounding. None: all
                that have holes, or as many as a diffusion network finds to fit into the device's memory.
            multiprocessing_context: "fork", "forkserver" or "spawn"; None is Python's own choice.
            timeout_seconds: the most that a worker may take over one sample before it counts as hung. One that is killed, ends, is stopped
                or sleeps is noticed within 10 s; only an endless loop, which looks like work, is given this long.
            rejected: a file that gets a line of JSON for every photo that was refused: source, shard, key, reason, epoch, index. It is
                appended to, and ranks may share it.
        """
        if micro_batch is not None and (isinstance(micro_batch, bool) or not isinstance(micro_batch, int) or micro_batch < 1):
            raise ValueError(f"micro_batch is an integer, 1 or more; got {micro_batch!r}")
        if self._recipe.size is None and batch_size != 1:
            raise ValueError(f"whole photos (size=None) differ in size and come one at a time: batch_size is 1; got {batch_size}")
        device = torch.device(device)
        if device.type == "cuda" and (device.index or 0) >= (gpus := torch.cuda.device_count()):
            raise ValueError(f'device="{device}", but PyTorch sees {gpus} GPU{"" if gpus == 1 else "s"} here; device="cpu" needs none')
        if device.type == "cuda" and device.index is None:  # which one that is may differ later, and in another thread
            device = torch.device("cuda", torch.cuda.current_device())
        if (rank is None) != (world_size is None):
            raise ValueError(f"rank and world_size are given together or not at all; got rank={rank}, world_size={world_size}")
        rank, world_size = launched_as() if rank is None or world_size is None else (rank, world_size)
        on_device = self._depth_placement == "device"
        if self._depth_placement == "auto":
            on_device = self._depth_elsewhere or (device.type != "cpu" and as_network(self._pinned_depth) is not None)
        finisher = self._finisher(device, micro_batch, on_device)
        if device.type != "cpu":
            self._warm_up(finisher, device, batch_size, aloud=rank == 0)
        return StereoLoader(
            worker=self._drafter() if on_device else self._worker,
            finisher=finisher,
            place=lambda: self._place(0, 0),
            revision=lambda: self._revision,
            epoch_size=self.epoch_size,
            budget=self._budget,
            problems=self._count_problems,
            batch_size=batch_size,
            num_workers=num_workers,
            rank=rank,
            world_size=world_size,
            multiprocessing_context=multiprocessing_context,
            timeout_seconds=timeout_seconds,
            rejected=rejected,
        )

    def state_dict(self) -> dict[str, Any]:
        """The place of the loop over the stream itself; a loader has its own."""
        return self._place(self._epoch, self._samples).to_state()

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Goes to the place that `state_dict` (of the stream or of a loader) named.

        Raises:
            ValueError: for a state of another stream; it names the field that differs.
        """
        place = Position.from_state(state, self._place(0, 0), self.epoch_size)
        self._epoch, self._samples = place.epoch, place.samples
        self._loop_is_open = False

    def stats(self) -> dict[str, Any]:
        """What the loop over the stream itself has seen, as `StereoLoader.stats` says it."""
        return {
            "pairs": self._faults.made,
            "rejected": dict(self._faults.by_reason),
            "examples": list(self._faults.examples),
            "shard_problems": dict(self._count_problems()),
            "seconds": dict(self._meter.seconds),
        }

    def provenance(self) -> dict[str, Any]:
        """What the pairs are made with, to be kept with whatever is trained on them: plain JSON values.

        The version, the seed, the digests of the photos and of the configuration, and of every model its id, revision and licence, as far
        as they are known.
        """
        place = self._place(0, 0)
        return {
            "zsdata": version("zsdata"),
            "seed": place.seed,
            "manifest": place.manifest,
            "configuration": place.configuration,
            "depth": model_records(self._pinned_depth),
            "inpaint": model_records(self._pinned_inpaint),
        }

    def _count_problems(self) -> Counter[str]:
        """Faults of the shards themselves, by reason."""
        return Counter(problem.reason.split(":")[0] for problem in self._schedule.problems)

    def _tell_problems(self) -> None:
        """Says what is wrong with shards that have been opened since the last time."""
        new = self._schedule.problems[self._told_problems :]
        self._told_problems += len(new)
        if new:
            reasons = Counter(problem.reason.split(":")[0] for problem in new)
            logger.warning(
                "%d fault%s in the shards (%s), the first: %s; `zsdata verify` lists them",
                len(new),
                "" if len(new) == 1 else "s",
                ", ".join(f"{reason}: {count}" for reason, count in reasons.most_common()),
                new[0],
            )

    def _make(self, epoch: int, index: int) -> StereoBatch:
        prepared = self._worker.prepare(epoch, index)
        self._meter.add(prepared.seconds)
        meta = prepared.meta
        first = meta["index"] == meta["pair"]  # of the samples that share a pair, and what it stands in for
        self._faults.add(1, [tuple(reject) for reject in meta["replaced"]] if first else [])
        return self._finish(prepared)

    def _finish(self, prepared: Prepared | Draft) -> StereoBatch:
        if self._cpu_finisher is None:
            self._cpu_finisher = self._finisher(torch.device("cpu"), micro_batch=1)
        return self._cpu_finisher(stack([prepared]), self._meter)[0]

    def _finisher(self, device: torch.device, micro_batch: int | None, depth_on_device: bool = False) -> Finisher:
        recipe = self._recipe
        synthesis = None
        if depth_on_device:
            estimator = None if self._pinned_depth == STORED else load_depth(self._pinned_depth, device)
            synthesis = Synthesis(estimator, recipe, self._drafter())
        return Finisher(load_inpainter(self._pinned_inpaint, device), self._augmentation, micro_batch, device, synthesis, recipe.reuse)

    def _warm_up(self, finisher: Finisher, device: torch.device, batch_size: int, aloud: bool) -> None:
        """Makes the networks on the device ready for batches like the first ones."""
        size = self._recipe.size
        see_whole_photos = [] if finisher.synthesis is None else [finisher.synthesis.depth]
        if size is None:
            see_whole_photos.append(finisher.inpainter)
        photos = []
        if any(hasattr(step, "warm_up") for step in see_whole_photos):
            photos = self._worker.photo_sizes(self._epoch, WARM_UP_PHOTOS)
            if not photos:
                return  # not one of them can be used, as the first batch will say
            size = size or max(photos, key=math.prod)
        if size is None:
            return  # nothing that is to get ready
        ready = finisher.warm_up(size, photos, batch_size)
        if ready and aloud:
            Progress.write(say_warm_up(ready, device, len(photos)), file=sys.stderr)

    def _drafter(self) -> Worker:
        """Prepares all but depth; an estimator that was given loaded does not travel to processes that have no use for it."""
        depth = None if callable(self._pinned_depth) else self._pinned_depth
        return Worker(replace(self._recipe, depth=depth, depth_on_device=True))

    def _place(self, epoch: int, samples: int) -> Position:
        recipe = self._recipe
        configuration = {
            "size": recipe.size,
            "views_per_image": self._views_per_image,
            "reuse": recipe.reuse,
            "depth": _name_of(self._depth, as_network(self._depth)),
            "inpaint": _name_of(self._inpaint, as_pipeline(self._inpaint)),
            "disparity": [type(recipe.disparity).__name__, asdict(recipe.disparity)],
            "view": asdict(recipe.view),
            "synthesis": asdict(recipe.synthesis),
            "quality": asdict(recipe.gate),
            "augmentation": asdict(self._augmentation),
        }
        digest = hashlib.sha256(json.dumps(configuration, sort_keys=True).encode()).hexdigest()
        return Position(
            seed=recipe.seed,
            epoch=epoch,
            samples=samples,
            manifest=self._schedule.digest,
            configuration=digest,
            models=hub_models(self._pinned_depth, self._pinned_inpaint),
        )


def _open_cache(
    folder: str | os.PathLike[str] | None, max_bytes: int, depth: str | DepthNetwork | DepthEstimator, synthesis: SynthesisConfig
) -> DepthCache | None:
    if folder is None:
        return None
    confidence = "flip confidence" if synthesis.flip_confidence else "no confidence"
    return DepthCache(folder, max_bytes, f"{depth_identity(depth)}, {confidence}")


def _name_of(step: Any, network: DepthNetwork | DiffusionNetwork | None) -> Any:
    """What a step is called in the configuration's digest: what changes its pictures, and nothing else.

    Args:
        network: of a step that is one by name.
    """
    network = network or getattr(step, "network", None)
    if isinstance(network, DepthNetwork | DiffusionNetwork):
        return {name: value for name, value in asdict(network).items() if name not in CHANGES_NO_PICTURE}
    return step if isinstance(step, str) else f"{type(step).__module__}.{getattr(step, '__qualname__', type(step).__qualname__)}"
