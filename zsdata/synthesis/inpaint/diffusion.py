"""Diffusion inpainting: holes filled by a latent diffusion model in the diffusers format (paper, section "Image Inpainting").

Inference is the paper's: the warped image with its holes at 0 goes to latent space, noise is denoised beside it and beside the mask under
the empty prompt without guidance, and the decoded image fills the holes. In one point it differs from the published code, whose mask goes
to latent size by nearest neighbour: here a cell is known only if every pixel in it is.
"""

from __future__ import annotations

import inspect
import warnings
from collections.abc import Mapping, Sequence
from copy import deepcopy
from typing import Any
from zlib import crc32

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from zsdata.synthesis.inpaint.diffusion_parts import CELL_PX, LATENT_CHANNELS, load_diffusion_parts

# Short names of the schedulers that people use; any other scheduler of diffusers goes by its class name.
SCHEDULERS = {
    "ddim": "DDIMScheduler",
    "dpmsolver++": "DPMSolverMultistepScheduler",
    "euler": "EulerDiscreteScheduler",
    "lcm": "LCMScheduler",
    "tcd": "TCDScheduler",
}
DTYPES = {"float32": torch.float32, "bf16": torch.bfloat16, "bfloat16": torch.bfloat16, "fp16": torch.float16, "float16": torch.float16}


class DiffusionInpainter:
    """An inpainter made of a diffusers-format inpainting pipeline: ZeroStereo's fine-tuned model or any Stable Diffusion inpainting model.

    A sample's result depends on its image, mask and noise, not on the samples beside it: on the CPU bit by bit, on a GPU up to rounding.

    Args:
        name: a Hub id or a local folder (U-Net of 9 input channels, VAE, scheduler, text encoder, tokenizer; safetensors).
        device: where the networks are put.
        steps: denoising steps, T in the paper.
        scheduler: "ddim" (the paper's), "dpmsolver++", "euler", "lcm", "tcd", or a scheduler class of diffusers by name. It takes the noise
            schedule from the pipeline's own scheduler configuration.
        autoencoder: a Hub id or folder of another autoencoder in the same latent space, such as a tiny one (`AutoencoderTiny`).
        dtype: of the networks: a torch.dtype or "float32", "bf16", "fp16". None is float32 on the CPU; on CUDA bfloat16 where the GPU has
            it, else float16. The denoised latent itself is kept in float32.
        compile: whether the U-Net goes through `torch.compile`.
        subfolder: where in the repository or folder the pipeline lies.
        revision: branch, tag or commit of a Hub id.

    The arguments stay readable as attributes of the same names, `dtype` and `scheduler` as what they came to.

    Raises:
        ImportError: the "diffusion" extra is not installed.
        OSError, ValueError: what `load_diffusion_parts` raises; a scheduler, dtype or number of steps that cannot be used.
    """

    def __init__(
        self,
        name: str,
        device: str | torch.device = "cpu",
        *,
        steps: int = 50,
        scheduler: str = "ddim",
        autoencoder: str | None = None,
        dtype: torch.dtype | str | None = None,
        compile: bool = False,
        subfolder: str = "",
        revision: str | None = None,
    ) -> None:
        if steps < 1:
            raise ValueError(f"steps is 1 or more; got {steps}")
        self.name, self.subfolder, self.revision, self.autoencoder, self.steps = name, subfolder, revision, autoencoder, steps
        self.device = torch.device(device)
        self.dtype = _dtype(dtype, self.device)
        parts = load_diffusion_parts(name, subfolder, revision, autoencoder, self.dtype)
        self._scheduler = _scheduler(scheduler, parts.scheduler_config, steps)
        self.scheduler = type(self._scheduler).__name__
        self._unet, self._autoencoder = (
            network.to(self.device, memory_format=torch.channels_last) for network in (parts.unet, parts.autoencoder)
        )
        self._prompt = parts.prompt.to(self.device)
        if compile:
            self._unet.compile()

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
            MemoryError: the device's memory does not suffice; the message says what to lower.
        """
        _check(right, inpaint_mask)
        if len(generators) != len(right):
            raise ValueError(f"one generator per sample: {len(right)} samples, {len(generators)} generators")
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
        try:
            # On the CPU one at a time: in a batch the order of sums, and with it the last bits, would depend on how many there are.
            size = 1 if self.device.type == "cpu" else max(len(right), 1)
            parts = zip(right.split(size), inpaint_mask.split(size), noise.split(size), strict=True)
            return torch.cat([self._decoded(*part) for part in parts]).to(right.device)
        except torch.OutOfMemoryError as error:
            B, _, H, W = right.shape
            fewer = f"lower micro_batch (now {B}), or " if B > 1 else ""
            raise MemoryError(
                f"{self.device} ran out of memory while inpainting {B} images of {H}x{W} in {self.dtype}: {fewer}take a smaller crop, "
                'dtype="bf16" or "fp16", or a tiny autoencoder; fewer steps would not help'
            ) from error

    @torch.no_grad()
    def _decoded(self, right: Tensor, inpaint_mask: Tensor, noise: Tensor) -> Tensor:
        height, width = right.shape[-2:]
        generators = [torch.Generator().manual_seed(crc32(sample.numpy().tobytes())) for sample in noise.float().cpu()]
        right, inpaint_mask, noise = (tensor.to(self.device) for tensor in (right, inpaint_mask, noise.float()))
        # An autocast of the training loop around the loader must not change the pictures.
        with torch.autocast(self.device.type, enabled=False):
            masked = (right.float() / 127.5 - 1).masked_fill(inpaint_mask, 0)
            masked = F.pad(masked, (0, -width % CELL_PX, 0, -height % CELL_PX), mode="replicate")
            latents = self._denoise(noise, latent_mask(inpaint_mask), self._encode(masked), generators)
            decoded = self._autoencoder.decode(latents.to(self.dtype) / self._autoencoder.config.scaling_factor).sample
        return (decoded[..., :height, :width].float().clamp(-1, 1) + 1) * 127.5

    def _encode(self, images: Tensor) -> Tensor:
        encoded = self._autoencoder.encode(images.to(self.dtype))
        latents = encoded.latent_dist.mean if hasattr(encoded, "latent_dist") else encoded.latents  # a tiny autoencoder has no distribution
        return latents * self._autoencoder.config.scaling_factor

    def _denoise(self, noise: Tensor, mask: Tensor, masked_latents: Tensor, generators: list[torch.Generator]) -> Tensor:
        scheduler, dtype = deepcopy(self._scheduler), self.dtype  # a scheduler remembers what it has seen; each run begins with a fresh one
        options = {"generator": generators} if "generator" in inspect.signature(scheduler.step).parameters else {}
        prompt = self._prompt.expand(len(noise), -1, -1)
        beside = torch.cat([mask.to(dtype), masked_latents.to(dtype)], dim=1)
        latents = noise * scheduler.init_noise_sigma
        for timestep, timestep_on_device in zip(scheduler.timesteps, scheduler.timesteps.to(self.device), strict=True):
            noisy = torch.cat([scheduler.scale_model_input(latents, timestep).to(dtype), beside], dim=1)
            predicted = self._unet(noisy, timestep_on_device, encoder_hidden_states=prompt).sample
            latents = scheduler.step(predicted.float(), timestep, latents, **options).prev_sample
        return latents


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


def _dtype(dtype: torch.dtype | str | None, device: torch.device) -> torch.dtype:
    if dtype is None:
        if device.type != "cuda":
            return torch.float32
        with torch.cuda.device(device):
            return torch.bfloat16 if torch.cuda.is_bf16_supported(including_emulation=False) else torch.float16
    named = DTYPES.get(dtype) if isinstance(dtype, str) else dtype
    if named is None or named not in DTYPES.values():
        raise ValueError(f"dtype is one of {', '.join(DTYPES)}; got {dtype}")
    return named


def _scheduler(name: str, config: Mapping[str, Any], steps: int) -> Any:
    """The named scheduler, set to `steps`, with the noise schedule of `config`, whatever scheduler that was saved by."""
    import diffusers

    class_name = SCHEDULERS.get(name, name)
    scheduler_class: Any = getattr(diffusers, class_name, None) if class_name.endswith("Scheduler") else None
    if scheduler_class is None:
        raise ValueError(f'scheduler is one of {", ".join(SCHEDULERS)} or a scheduler class of diffusers by name; got "{name}"')
    options = inspect.signature(scheduler_class.__init__).parameters
    step = inspect.signature(getattr(scheduler_class, "step", scheduler_class)).parameters
    inputs = [key for key, value in step.items() if value.default is value.empty]
    if "beta_schedule" not in options or inputs != ["self", "model_output", "timestep", "sample"]:
        raise ValueError(f'scheduler "{name}" is made for another kind of model: it does not denoise what this U-Net was trained on')
    # Latents are not bounded by -1..1, but some schedulers clip to it unless told otherwise.
    unclipped = {"clip_sample": False} if "clip_sample" in options else {}
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="__array", category=DeprecationWarning)  # what diffusers does to NumPy 2
        scheduler = scheduler_class.from_config({**unclipped, **config})
        scheduler.set_timesteps(steps)
    return scheduler
