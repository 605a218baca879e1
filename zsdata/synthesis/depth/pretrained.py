"""Depth from a network in the transformers format: Depth Anything V2 and its relatives.

The work has two halves that may run in two places: `prepare` resizes a photo on the CPU, `predict` runs the network on its device.
"""

from __future__ import annotations

import json
import math
import os
import re
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from typing import Any

import torch
from torch import Tensor

from zsdata.synthesis.depth import DepthEstimator, as_network
from zsdata.synthesis.depth.identity import pinned
from zsdata.synthesis.depth.maps import DepthMaps, depth_maps
from zsdata.synthesis.depth.model_folder import check_weights
from zsdata.synthesis.depth.options import DepthNetwork
from zsdata.synthesis.depth.preprocessing import Preprocessing, read_preprocessing
from zsdata.synthesis.micro_batch import MicroBatch, WarmUp, out_of_memory, to_device, weight_bytes
from zsdata.synthesis.precision import DTYPES, without_tf32

# What a network's prediction is, by the model_type of its configuration, which may say "metric" besides. Depth Pro's is inverse depth:
# transformers inverts it afterwards. CHMv2's is the height of trees seen from above: what is higher is nearer, as inverse depth has it.
INVERSE_DEPTH_MODELS = ("chmv2", "depth_anything", "depth_pro")
DEPTH_MODELS = ("glpn", "tipsv2_dpt", "zoedepth")
METRIC_DPT_BACKBONES = ("dinov2", "dinov2_with_registers")  # DPT heads on DINOv2 predict metres (NYU, KITTI); MiDaS's predict inverse depth

PROMPTED_MODELS = ("prompt_depth_anything",)  # without the depth that they ask for their nearest point is at 0: nothing to invert

SMALLEST_DEPTH_M = 1e-3
NEAREST_SHARE = 0.001  # of a photo's pixels may be nearer than the depth that is taken for its nearest point
HUB_ID = re.compile(r"[\w.-]+(/[\w.-]+)?")
# What makes depth of features, by the names that transformers' depth networks give it.
LAST_LAYERS = ("head", "relative_head", "metric_head", "features_to_depth", "decoder.head", "bin_regressor")
# DPT networks have these weights, published checkpoints do not, and nothing uses them: the first stage fuses nothing.
NEVER_USED = re.compile(r"fusion_stage\.layers\.0\.residual_layer1\.")


class PretrainedDepth:
    """A depth-estimation network of transformers, with the pre-processing that its folder states.

    Photos are resized so that their short side has the network's own length (or the one asked for), keeping the aspect, to whole patches;
    normalised; and the prediction is brought back to the photo's size. Depth is inverted, after its nearest thousandth was set to one
    depth: a single pixel at 0 m would leave the rest of the photo flat. On the CPU a photo's result is the same bit for bit whatever it is
    estimated with; on a GPU up to rounding.

    Args:
        network: which one, and how it is run.
        device: where the network is put.

    Attributes:
        network, device: as given.
        pinned: the network at the commit that it was loaded from.

    Raises:
        ImportError: transformers is not installed.
        OSError: nothing is found under that name, or a folder lacks a file.
        ValueError: files are damaged or not those of a depth network, weights are missing, or it is not known how photos are prepared for
            this kind of network or what it predicts.
    """

    def __init__(self, network: DepthNetwork, device: str | torch.device = "cpu") -> None:
        self.network, self.device = network, torch.device(device)
        self.dtype = DTYPES[network.dtype]
        self.preprocessing = load_preprocessing(network)
        self.pinned = pinned(network)
        from transformers import AutoModelForDepthEstimation

        with _naming(network), torch.random.fork_rng(devices=[]):  # older transformers fill the weights with random numbers first
            loaded, report = AutoModelForDepthEstimation.from_pretrained(
                network.name, revision=self.pinned.revision, output_loading_info=True, ignore_mismatched_sizes=True
            )
        missing = sorted(key for key in report["missing_keys"] if not NEVER_USED.search(key))
        if missing:
            raise ValueError(f'depth="{network.name}" lacks {len(missing)} weights, "{missing[0]}" for one; download it again')
        other = sorted(key if isinstance(key, str) else key[0] for key in report["mismatched_keys"])
        if other:
            raise ValueError(
                f'depth="{network.name}" has {len(other)} weights of another shape than its config.json says, "{other[0]}" for one; '
                "download both again"
            )
        self._predicts_depth = _predicts(network, loaded.config) == "depth"
        self._network: Any = loaded.float().eval().requires_grad_(False)  # saved in half precision or not
        cure = "lower resolution, or take a smaller network or dtype"
        to_device((self._network,), self.device, "the depth network", cure)
        if self.device.type == "cuda":
            self._network.to(memory_format=torch.channels_last)
        if self.dtype != torch.float32:
            layers = dict(loaded.named_modules())
            for name in LAST_LAYERS:
                if name in layers:
                    _keep_in_float32(layers[name], self.device.type)
        if network.compile:
            self._network.compile()
        # A ZoeDepth of two domains, indoors and outdoors, chooses one for all images that it is given at once.
        alone = len(getattr(loaded.config, "bin_configurations", None) or ()) > 1
        self.micro_batch = MicroBatch("depth network", 1 if alone else network.micro_batch, self.device, cure)

    def __reduce__(self) -> tuple[Any, ...]:
        """Another process loads it anew: transformers and `compile` hang functions on a network that do not travel."""
        return type(self), (self.pinned, self.device)

    def prepare(self, images: Tensor) -> Tensor:
        """The first half: photos to the network's input.

        Args:
            images: uint8, or float in 0..255 (rounded to whole numbers first), [B, 3, H, W], RGB.

        Returns:
            uint8 [B, 3, h, w], small to send to another process. For the mirrored photo it is the mirror image.
        """
        return self.preprocessing.prepare(images)

    def predict(self, inputs: Sequence[Tensor], sizes: Sequence[tuple[int, int]]) -> Iterator[Tensor]:
        """The second half: inverse depth of prepared photos; those of one input size share micro-batches.

        Args:
            inputs: of each photo what `prepare` made of it, uint8 [1, 3, h, w], on any device.
            sizes: (height, width) of each photo.

        Returns:
            One float32 [1, 1, H, W] per photo, larger is nearer, on the network's device. The network has done its work when this returns;
            each map is brought to its photo's size when it is taken: those of a whole batch may not fit into memory at once.

        Raises:
            MemoryError: the device has not enough memory for one photo.
        """
        if len(inputs) != len(sizes):
            raise ValueError(f"one size per photo: {len(inputs)} inputs, {len(sizes)} sizes")
        return map(self._restore, self._predict(inputs), sizes)

    def predict_mirrored(self, inputs: Sequence[Tensor], sizes: Sequence[tuple[int, int]]) -> Iterator[tuple[Tensor, Tensor]]:
        """As `predict`, of every photo and of its mirror image, in the same micro-batches.

        Returns:
            Per photo its inverse depth and that of its mirror image, mirrored back: two float32 [1, 1, H, W].
        """
        both = [image for prepared in inputs for image in (prepared, prepared.flip(-1))]
        made = self.predict(both, [size for size in sizes for _ in range(2)])
        return ((one, mirrored.flip(-1)) for one, mirrored in zip(made, made, strict=True))

    @torch.inference_mode()
    def _predict(self, inputs: Sequence[Tensor]) -> list[Tensor]:
        """Inverse depth of prepared photos, at the size that the network gives it."""
        alike: dict[tuple[int, ...], list[int]] = defaultdict(list)
        for place, prepared in enumerate(inputs):
            alike[tuple(prepared.shape)].append(place)
        made: dict[int, Tensor] = {}
        for places in alike.values():
            together = torch.cat([inputs[place].to(self.device, non_blocking=True) for place in places])
            predicted = torch.cat(self.micro_batch.run(lambda part, together=together: self._run(together[part]), len(places)))
            made.update(zip(places, predicted.split(1), strict=True))
        return [made[place] for place in range(len(inputs))]

    @torch.inference_mode()
    def _restore(self, predicted: Tensor, size: tuple[int, int]) -> Tensor:
        try:
            return self.preprocessing.restore(predicted, size)
        except RuntimeError as error:
            if not out_of_memory(error):
                raise
            raise MemoryError(
                f"{self.device} has not enough memory for the depth of a photo of {size[1]}x{size[0]}: lower memory elsewhere, take "
                'smaller photos, or depth_placement="worker"'
            ) from error

    def __call__(self, images: Tensor) -> Tensor:
        """Inverse depth of `images`: both halves.

        Args:
            images: float32 [B, 3, H, W], RGB 0..255.

        Returns:
            float32 [B, 1, H, W], larger is nearer, on the device of `images`.
        """
        sizes = [(images.shape[-2], images.shape[-1])] * len(images)
        return torch.cat(list(self.predict(self.prepare(images).split(1), sizes))).to(images.device)

    def with_mirrored(self, images: Tensor) -> tuple[Tensor, Tensor]:
        """Inverse depth of `images` and of their mirror images, mirrored back, each as `__call__` returns it."""
        sizes = [(images.shape[-2], images.shape[-1])] * len(images)
        made = self.predict_mirrored(self.prepare(images).split(1), sizes)
        depth, mirrored = (torch.cat(maps).to(images.device) for maps in zip(*made, strict=True))
        return depth, mirrored

    def warm_up(self, size: tuple[int, int], samples: int | None = None) -> WarmUp:
        """Estimates depth of grey photos of this (height, width), and says how much memory that takes, the maps of all of them too.

        Args:
            size: height and width of the photos.
            samples: the most photos that will come at once, each with its mirror image; None is not known, and one micro-batch is tried.
        """
        photos = -(-self.micro_batch.size // 2) if samples is None else samples
        grey = self.prepare(torch.full((1, 3, *size), 127, dtype=torch.uint8))

        def work() -> list[DepthMaps]:
            return [depth_maps(*maps) for maps in self.predict_mirrored([grey] * photos, [size] * photos)]

        peak, seconds = self.micro_batch.measure(work)
        what = f"depth {self.network.name} at {grey.shape[-2]}x{grey.shape[-1]} for {photos} photos of {size[0]}x{size[1]}, {self.dtype}"
        weights = weight_bytes(self._network)
        at_once = self.micro_batch.evenly(2 * photos)
        return WarmUp(what, at_once, None if peak is None else peak + weights, weights, seconds)

    def _run(self, inputs: Tensor) -> Tensor:
        """uint8 [B, 3, h, w] on the device to inverse depth, float32 [B, 1, h', w']."""
        whole = self.dtype == torch.float32
        with without_tf32(self.device) if whole else nullcontext(), torch.autocast(self.device.type, self.dtype, enabled=not whole):
            predicted = self._network(pixel_values=self.preprocessing.normalise(inputs)).predicted_depth.unsqueeze(1).float()
        return _inverted(predicted) if self._predicts_depth else predicted


def _inverted(depth: Tensor) -> Tensor:
    """Depth [B, 1, h, w] to inverse depth; nothing is nearer than the depth that NEAREST_SHARE of its pixels, at least one, lie below."""
    pixels = depth.flatten(1)
    # Not by kthvalue, which torch's deterministic mode refuses on CUDA.
    lowest = pixels.topk(1 + math.ceil(NEAREST_SHARE * pixels.shape[1]), largest=False).values
    nearest = lowest[:, -1].clamp(min=SMALLEST_DEPTH_M)
    return 1 / depth.maximum(nearest.view(-1, 1, 1, 1))


def preprocessing_of(depth: str | os.PathLike[str] | DepthNetwork | DepthEstimator) -> Preprocessing | None:
    """How photos are prepared for the network behind a `depth` argument, named or loaded; None where there is none.

    Raises:
        ImportError, OSError, ValueError: as `PretrainedDepth`.
    """
    network = as_network(depth)
    if network is not None:
        return load_preprocessing(network)
    return depth.preprocessing if isinstance(depth, PretrainedDepth) else None


def load_preprocessing(network: DepthNetwork) -> Preprocessing:
    """How photos are prepared for a network: a few numbers that travel anywhere, read without loading the network's weights.

    Raises:
        ImportError, OSError, ValueError: as `PretrainedDepth`.
    """
    if not os.path.isdir(network.name) and not HUB_ID.fullmatch(network.name):
        raise FileNotFoundError(
            f'depth="{network.name}" is neither "builtin", "stored", a folder that is there, nor a Hub id ("owner/name")'
        )
    if os.path.isdir(network.name) and network.revision is not None:
        raise ValueError(
            f'depth="{network.name}" is a folder, which has no revisions; got revision={network.revision!r}. Leave revision out, or give '
            "the Hub id"
        )
    try:
        from transformers import MODEL_FOR_DEPTH_ESTIMATION_MAPPING, AutoConfig
        from transformers.utils.hub import cached_file
    except ImportError as error:
        raise ImportError(f'depth="{network.name}" needs transformers: pip install "zsdata[depth]"') from error
    with _naming(network):
        config = AutoConfig.from_pretrained(network.name, revision=network.revision)
        path = cached_file(network.name, "preprocessor_config.json", revision=network.revision)
    built_as = getattr(config, "architectures", None) or []
    for_depth = not built_as or any("Depth" in one or "Dense" in one for one in built_as)  # TIPSv2's may predict several things
    if not for_depth or type(config) not in MODEL_FOR_DEPTH_ESTIMATION_MAPPING:
        raise ValueError(
            f'depth="{network.name}" is no depth network: its config.json says {" ".join([config.model_type, *built_as])}; name one that '
            "transformers loads by AutoModelForDepthEstimation"
        )
    _predicts(network, config)
    if os.path.isdir(network.name):
        check_weights(network.name)
    with open(str(path), encoding="utf-8") as file:
        try:
            said = json.load(file)
        except ValueError as error:
            raise ValueError(f'depth="{network.name}": its preprocessor_config.json is no JSON ({error}); download it again') from error
    return read_preprocessing(network.name, said, config, network.resolution)


@contextmanager
def _naming(network: DepthNetwork) -> Iterator[None]:
    """Errors of transformers say which network they are about, and what can be done."""
    which = f'depth="{network.name}"' + ("" if network.revision is None else f', revision "{network.revision}",')
    try:
        yield
    except OSError as error:
        raise OSError(f"{which} cannot be loaded: {error}") from error
    except (ImportError, MemoryError):  # names the package that a network needs beside transformers; is no fault of the folder
        raise
    except Exception as error:  # what a damaged folder leads to is not foretold
        raise ValueError(
            f"{which} cannot be loaded: {error} Its files are damaged or of different networks: download them again; or this transformers "
            "does not know the network: upgrade it"
        ) from error


def _predicts(network: DepthNetwork, config: Any) -> str:
    """As told, or as its configuration (transformers) tells."""
    kind, name = config.model_type, network.name
    if kind in PROMPTED_MODELS:
        raise ValueError(
            f'depth="{name}" is a {kind} network, which wants a depth map beside the photo; take one that needs the photo alone, such as '
            '"depth-anything/Depth-Anything-V2-Small-hf"'
        )
    if network.predicts is not None:
        return network.predicts
    if kind in DEPTH_MODELS or getattr(config, "depth_estimation_type", "relative") == "metric":
        return "depth"
    if kind == "dpt":
        backbone = getattr(getattr(config, "backbone_config", None), "model_type", None)
        return "depth" if backbone in METRIC_DPT_BACKBONES else "inverse depth"
    if kind in INVERSE_DEPTH_MODELS:
        return "inverse depth"
    raise ValueError(
        f'depth="{name}" is a {kind} network, of which it is not known whether it predicts depth or inverse depth; say so: '
        f'DepthNetwork("{name}", predicts="depth") or predicts="inverse depth"'
    )


def _keep_in_float32(layers: torch.nn.Module, device_type: str) -> None:
    """Lets no autocast into these layers. What they return is depth: bfloat16 would leave 256 steps of it between 1 and 2."""
    forward = layers.forward

    def in_float32(*inputs: Any, **named: Any) -> Any:
        with torch.autocast(device_type, enabled=False):
            return forward(*_to_float32(inputs), **{name: _to_float32(value) for name, value in named.items()})

    layers.forward = in_float32


def _to_float32(value: Any) -> Any:
    if isinstance(value, Tensor) and value.is_floating_point():
        return value.float()
    if isinstance(value, list | tuple):
        return type(value)(_to_float32(item) for item in value)
    return value
