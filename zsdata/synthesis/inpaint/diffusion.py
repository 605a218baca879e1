"""Diffusion inpainting: holes filled by a latent diffusion model in the diffusers format (paper, section "Image Inpainting").

Inference is the paper's: the warped image with its holes at 0 goes to latent space, noise is denoised beside it and beside the mask under
the empty prompt without guidance, and the decoded image fills the holes. In one point it differs from the published code, whose mask goes
to latent size by nearest neighbour: here a cell is known only if every pixel in it is.
"""

from __future__ import annotations

import inspect
import logging
import math
import sys
from collections.abc import Sequence
from copy import deepcopy
from typing import Any, NamedTuple
from zlib import crc32

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from zsdata.synthesis.inpaint.diffusion_parts import CELL_PX, LATENT_CHANNELS, at_commit, check_configurations, load_diffusion_parts
from zsdata.synthesis.inpaint.options import DiffusionNetwork
from zsdata.synthesis.inpaint.schedulers import make_scheduler
from zsdata.synthesis.micro_batch import (
    AUTO_SHARE,
    GIB,
    LARGEST_AUTO,
    MicroBatch,
    WarmUp,
    free_bytes,
    largest_micro_batch,
    measure,
    out_of_memory,
    to_device,
    weight_bytes,
)
from zsdata.synthesis.precision import choose_dtype

logger = logging.getLogger("zsdata")

AUTOENCODER_BATCH = 4  # images; at full resolution they keep a GPU busy, and more would take most of the memory
TRIAL_STEPS = 2  # of a warm-up: all steps take the same memory, and some schedulers do more from the second one on
MANY = sys.maxsize  # more memory than there is


class DiffusionInpainter:
    """An inpainter made of a diffusers-format inpainting pipeline: ZeroStereo's fine-tuned model or any Stable Diffusion inpainting model.

    A sample's result depends on its image, mask and noise, not on the samples beside it: on the CPU bit by bit, on a GPU up to rounding.

    Args:
        network: which pipeline, and how it is run.
        device: where the networks are put.

    Attributes:
        network, device: as given.
        pinned: the network at the commit that it was loaded from.
        steps, dtype, scheduler: what was chosen: denoising steps, the networks' torch.dtype, the scheduler's class name.
        micro_batch: how many samples go through the U-Net at once (`.size`), and how often that had to be lowered (`.lowered`).

    Raises:
        ImportError: the "diffusion" extra is not installed.
        OSError, ValueError: what `load_diffusion_parts` and `make_scheduler` raise.
        MemoryError: the networks do not fit into the device's memory.
    """

    def __init__(self, network: DiffusionNetwork, device: str | torch.device = "cpu") -> None:
        self.network, self.steps = network, network.steps
        self.device = torch.device(device)
        self.dtype = choose_dtype(network.dtype, self.device)
        self.pinned, self._scheduler = checked(network)
        parts = load_diffusion_parts(self.pinned, self.dtype)
        self.scheduler = type(self._scheduler).__name__
        cure = 'lower memory elsewhere, take a smaller crop, dtype="bf16" or "fp16", or a tiny autoencoder; fewer steps would not help'
        self._unet, self._autoencoder = (part.to(memory_format=torch.channels_last) for part in (parts.unet, parts.autoencoder))
        to_device((self._unet, self._autoencoder), self.device, "diffusion inpainting", cure)
        self._prompt = parts.prompt.to(self.device)
        self._timesteps = self._scheduler.timesteps.to(self.device)  # kept, because a GPU waits for whatever is brought there
        if network.compile:
            mode = network.compile if isinstance(network.compile, str) else None
            for module in (self._unet, self._autoencoder.encoder, self._autoencoder.decoder):
                module.compile(mode=mode)
        asked = 1 if network.micro_batch == "auto" else network.micro_batch
        self.micro_batch = MicroBatch("diffusion inpainting", asked, self.device, cure)
        self._auto = network.micro_batch == "auto" and self.device.type != "cpu"
        self._found: _Found | None = None
        self._compiled_for: set[int] = set()  # numbers of samples that compiled networks have seen

    def __reduce__(self) -> tuple[Any, ...]:
        """Another process loads it anew: weights would travel as hundreds of files of shared memory, and round otherwise there."""
        return type(self), (self.pinned, self.device)

    def __call__(self, right: Tensor, inpaint_mask: Tensor, generators: Sequence[np.random.Generator]) -> Tensor:
        """`right` with its holes filled.

        Args:
            right: float32 [B, 3, H, W], RGB 0..255; what stands in its holes is not looked at.
            inpaint_mask: bool [B, 1, H, W], True in the holes.
            generators: one per sample; each gives its sample's noise.

        Returns:
            float32 [B, 3, H, W], 0..255, on the device of `right`: the model's pixels in the holes, the known pixels exactly as they were.

        Raises:
            ValueError: for other shapes or dtypes.
            MemoryError: the device's memory does not suffice for one sample; the message says what to lower.
        """
        _check(right, inpaint_mask)
        if len(generators) != len(right):
            raise ValueError(f"one generator per sample: {len(right)} samples, {len(generators)} generators")
        if not len(right):
            return right.clone()
        shape = _latent_shape(right)
        noise = torch.from_numpy(np.stack([generator.standard_normal(shape, dtype=np.float32) for generator in generators]))
        return torch.where(inpaint_mask, self.inpaint_from_noise(right, inpaint_mask, noise), right)

    def inpaint_from_noise(self, right: Tensor, inpaint_mask: Tensor, noise: Tensor) -> Tensor:
        """The image that the model decodes, known pixels and all, before it is blended with `right`: I_d in the paper.

        Deterministic: schedulers that add noise on the way (LCM, TCD, ancestral ones) draw it from a seed that the sample's `noise` gives.

        Args:
            right: float32 [B, 3, H, W], RGB 0..255; what stands in its holes is not looked at.
            inpaint_mask: bool [B, 1, H, W], True in the holes.
            noise: float32 [B, 4, ceil(H / 8), ceil(W / 8)], standard normal.

        Returns:
            float32 [B, 3, H, W], 0..255, on the device of `right`.

        Raises:
            ValueError, MemoryError: as `__call__`.
        """
        _check(right, inpaint_mask)
        expected = (len(right), *_latent_shape(right))
        if noise.shape != expected:
            raise ValueError(f"noise must be {list(expected)} for images of {list(right.shape)}; got {list(noise.shape)}")
        self._find_micro_batch((right.shape[-2], right.shape[-1]), len(right))

        def work(part: slice) -> Tensor:
            count, rows = part.stop - part.start, part
            if self._filled_up(count) > count:
                rows = torch.arange(part.start, part.start + self._filled_up(count)).clamp(max=part.stop - 1)
            return self._inpaint(right[rows], inpaint_mask[rows], noise[rows])[:count]

        made = self.micro_batch.run(work, len(right), self._filled_up)
        return torch.cat([right.new_empty(0, *right.shape[1:]), *(part.to(right.device) for part in made)])

    def warm_up(self, size: tuple[int, int], samples: int | None = None) -> WarmUp:
        """Runs the networks on empty images of this (height, width); finds the micro-batch where it is "auto"; says what memory it takes.

        Args:
            size: height and width of the images.
            samples: the most that will come at once; None is not known.

        Raises:
            MemoryError: the device's memory does not suffice for one sample.
        """
        spent = self._find_micro_batch(size, LARGEST_AUTO if samples is None else samples)
        total = self.micro_batch.size if samples is None else samples
        # Once is enough for all parts, which have one size.
        peak, seconds = self.micro_batch.measure(
            lambda: self.micro_batch.run(lambda part: self._try(part.stop - part.start, size), self.micro_batch.evenly(total))
        )
        at_once = self.micro_batch.evenly(total)
        self._compiled_for.add(at_once)
        weights = weight_bytes(self._unet, self._autoencoder)
        what = f"inpainting {self.network.name} at {size[0]}x{size[1]}, {self.dtype}"
        return WarmUp(what, at_once, None if peak is None else peak + weights, weights, spent + seconds)

    def _find_micro_batch(self, size: tuple[int, int], wanted: int) -> float:
        """Where the micro-batch is "auto", finds the largest within the budget, at most `wanted`, for images of this (height, width),
        unless it is known; the seconds that it took."""
        wanted = min(wanted, LARGEST_AUTO)
        if not self._auto or not wanted or (self._found is not None and self._found.holds_for(size, wanted)):
            return 0.0
        if self._found is not None:  # what is found holds for all that was asked before, too
            size, wanted = max(size, self._found.size, key=math.prod), max(wanted, self._found.wanted)
        weights = weight_bytes(self._unet, self._autoencoder)
        allowed = self.network.memory_gib
        budget = int(AUTO_SHARE * free_bytes(self.device)) if allowed is None else int(allowed * GIB) - weights
        spent = 0.0

        def peak_bytes(samples: int) -> int:
            nonlocal spent
            try:
                peak, seconds = measure(lambda: self._try(samples, size), self.device)
            except RuntimeError as error:
                if not out_of_memory(error):
                    raise
                return 0 if samples == 1 else MANY  # of one sample, the run that follows says it
            spent += seconds
            if samples == 1 and allowed is not None and peak is not None and peak > budget:
                logger.warning("memory_gib=%g cannot be held: one sample and the weights take %.2f GiB", allowed, (weights + peak) / GIB)
            return peak or 0

        with torch.compiler.set_stance("force_eager"):  # it would compile for every number that is tried
            largest = largest_micro_batch(peak_bytes, budget, wanted)
        self._found = _Found(size, wanted, largest)
        self.micro_batch.choose(largest)
        return spent

    def _filled_up(self, count: int) -> int:
        """How many samples the networks get for `count` of them: compiled ones are not compiled anew for what they hold already."""
        if not self.network.compile:
            return count
        rows = min((known for known in self._compiled_for if count <= known <= self.micro_batch.size), default=count)
        self._compiled_for.add(rows)
        return rows

    def _try(self, samples: int, size: tuple[int, int]) -> None:
        right = torch.zeros(samples, 3, *size, device=self.device)
        inpaint_mask = torch.ones(samples, 1, *size, dtype=torch.bool, device=self.device)
        self._inpaint(right, inpaint_mask, torch.zeros(samples, *_latent_shape(right)), TRIAL_STEPS)

    @torch.no_grad()
    def _inpaint(self, right: Tensor, inpaint_mask: Tensor, noise: Tensor, most_steps: int | None = None) -> Tensor:
        height, width = right.shape[-2:]
        generators = [torch.Generator().manual_seed(crc32(sample.numpy().tobytes())) for sample in noise.float().cpu()]
        right, inpaint_mask, noise = (tensor.to(self.device) for tensor in (right, inpaint_mask, noise.float()))
        # An autocast of the training loop around the loader must not change the pictures.
        with torch.autocast(self.device.type, enabled=False):
            masked = (right.float() / 127.5 - 1).masked_fill(inpaint_mask, 0)
            masked = F.pad(masked, (0, -width % CELL_PX, 0, -height % CELL_PX), mode="replicate")
            latents = self._denoise(noise, latent_mask(inpaint_mask), self._encode(masked), generators, most_steps)
            decoded = self._decode(latents)
        return (decoded[..., :height, :width].clamp(-1, 1) + 1) * 127.5

    def _encode(self, images: Tensor) -> Tensor:
        """Images in -1..1 to latents: the mean of the encoder's distribution."""
        latents = []
        for part in images.to(self.dtype).split(AUTOENCODER_BATCH):
            self._begin()
            encoded = self._autoencoder.encode(part)
            # A tiny autoencoder has no distribution.
            latents.append((encoded.latent_dist.mean if hasattr(encoded, "latent_dist") else encoded.latents).clone())
        return torch.cat(latents) * self._autoencoder.config.scaling_factor

    def _decode(self, latents: Tensor) -> Tensor:
        """Latents to float32 images in about -1..1."""
        latents, images = latents.to(self.dtype) / self._autoencoder.config.scaling_factor, []
        for part in latents.split(AUTOENCODER_BATCH):
            self._begin()
            images.append(self._autoencoder.decode(part).sample.to(torch.float32, copy=True))
        return torch.cat(images)

    def _begin(self) -> None:
        """Before each call of a network: with CUDA graphs, what one returned is overwritten from here on, so all of it is copied."""
        if self.network.compile:
            torch.compiler.cudagraph_mark_step_begin()

    def _denoise(
        self, noise: Tensor, mask: Tensor, masked_latents: Tensor, generators: list[torch.Generator], most_steps: int | None
    ) -> Tensor:
        scheduler, dtype = deepcopy(self._scheduler), self.dtype  # a scheduler remembers what it has seen; each run begins with a fresh one
        options = {"generator": generators} if "generator" in inspect.signature(scheduler.step).parameters else {}
        prompt = self._prompt.expand(len(noise), -1, -1)
        beside = torch.cat([mask.to(dtype), masked_latents.to(dtype)], dim=1)
        latents = noise * scheduler.init_noise_sigma
        timesteps = scheduler.timesteps[:most_steps], self._timesteps[:most_steps]
        for timestep, timestep_on_device in zip(*timesteps, strict=True):
            noisy = torch.cat([scheduler.scale_model_input(latents, timestep).to(dtype), beside], dim=1)
            self._begin()
            predicted = self._unet(noisy, timestep_on_device, encoder_hidden_states=prompt).sample.to(torch.float32, copy=True)
            latents = scheduler.step(predicted, timestep, latents, **options).prev_sample
        return latents


class _Found(NamedTuple):
    """Which micro-batch is the largest within the budget."""

    size: tuple[int, int]  # height and width of the images that were tried
    wanted: int  # no more were tried at once
    largest: int

    def holds_for(self, size: tuple[int, int], wanted: int) -> bool:
        ended_by_memory = 2 * self.largest <= self.wanted  # numbers are doubled until one does not fit, or is not wanted
        return math.prod(size) <= math.prod(self.size) and (wanted <= self.wanted or ended_by_memory)


def checked(network: DiffusionNetwork) -> tuple[DiffusionNetwork, Any]:
    """The network at the commit that it stands for, and its scheduler; all is checked that can be without loading weights.

    Raises:
        ImportError, OSError, ValueError: as `DiffusionInpainter`.
    """
    network = at_commit(network)
    return network, make_scheduler(network.scheduler, check_configurations(network), network.steps)


def latent_mask(inpaint_mask: Tensor) -> Tensor:
    """The mask at latent size: a cell of 8x8 pixels is a hole as soon as one pixel in it is.

    Args:
        inpaint_mask: bool [B, 1, H, W], True in the holes; cells that jut out over the image count only the pixels inside.

    Returns:
        float32 [B, 1, ceil(H / 8), ceil(W / 8)], 1 in holes, 0 in known cells.
    """
    return F.max_pool2d(inpaint_mask.float(), CELL_PX, ceil_mode=True)


def _latent_shape(right: Tensor) -> tuple[int, int, int]:
    height, width = right.shape[-2:]
    return LATENT_CHANNELS, -(-height // CELL_PX), -(-width // CELL_PX)


def _check(right: Tensor, inpaint_mask: Tensor) -> None:
    if right.ndim != 4 or right.shape[1] != 3:
        raise ValueError(f"right must be [B, 3, H, W]; got {list(right.shape)}")
    if inpaint_mask.dtype != torch.bool or inpaint_mask.shape != (len(right), 1, *right.shape[-2:]):
        expected = [len(right), 1, *right.shape[-2:]]
        raise ValueError(f"inpaint_mask must be bool {expected}; got {inpaint_mask.dtype} {list(inpaint_mask.shape)}")
