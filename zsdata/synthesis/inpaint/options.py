"""Which diffusion model fills the holes, and how it is run: the stream's `inpaint` argument where a name alone does not say enough."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from zsdata.field_types import check_types
from zsdata.synthesis.model_name import split_revision
from zsdata.synthesis.precision import check_dtype

COMPILE_MODES = ("default", "reduce-overhead", "max-autotune", "max-autotune-no-cudagraphs")


@dataclass(frozen=True)
class DiffusionNetwork:
    """An inpainting pipeline in the diffusers format; plain values, so that it goes into digests. `load_inpainter` makes it a callable.

    Args:
        name: a Hub id, such as "sd2-community/stable-diffusion-2-inpainting", or a local folder (U-Net of 9 input channels, VAE, scheduler,
            text encoder, tokenizer; weights in safetensors). "owner/name@revision" gives both; so with `autoencoder`.
        steps: denoising steps, T in the paper.
        scheduler: "ddim" (the paper's), "dpm++", "euler", "lcm", "tcd", or a scheduler class of diffusers by name. It takes the noise
            schedule from the pipeline's own scheduler configuration, and the spacing of its timesteps, except that one to three steps
            begin where the noise is ("trailing"). LCM and TCD want a U-Net that was distilled for few steps.
        subfolder: where in the repository or folder the pipeline lies: "StereoGen" in the paper's "Windsrain/ZeroStereo".
        revision: branch, tag or commit of a Hub id.
        autoencoder: a Hub id or folder of another autoencoder in the same latent space, such as the tiny "madebyollin/taesd".
        autoencoder_revision: branch, tag or commit of that Hub id.
        dtype: of the networks: "float32", "bf16" or "fp16". None is float32 on the CPU; on CUDA bf16 where the GPU has it, else fp16. The
            denoised latent itself is kept in float32.
        compile: whether the networks go through `torch.compile`; or its mode, of which "reduce-overhead" uses CUDA graphs.
        micro_batch: samples at once on a GPU, or "auto": the largest that fits, found once at warm-up. On the CPU it is one. It changes
            speed and memory, and of the pictures only the rounding on a GPU.
        memory_gib: how much device memory "auto" may take, weights and all; None is half of what is free at warm-up, beside the weights.

    Raises:
        ValueError: an option has no such value.
    """

    name: str
    steps: int = 50
    scheduler: str = "ddim"
    subfolder: str = ""
    revision: str | None = None
    autoencoder: str | None = None
    autoencoder_revision: str | None = None
    dtype: str | None = None
    compile: bool | str = False
    micro_batch: int | Literal["auto"] = "auto"
    memory_gib: float | None = None

    def __post_init__(self) -> None:
        check_types(self)
        for of, at in (("name", "revision"), ("autoencoder", "autoencoder_revision")):
            if (name := getattr(self, of)) is not None:
                for field, value in zip((of, at), split_revision(name, getattr(self, at)), strict=True):
                    object.__setattr__(self, field, value)  # frozen for others
        if self.autoencoder is None and self.autoencoder_revision is not None:
            raise ValueError(f"autoencoder_revision belongs to an autoencoder, and none is named; got {self.autoencoder_revision!r}")
        if self.steps < 1:
            raise ValueError(f"steps is 1 or more; got {self.steps}")
        if self.micro_batch != "auto" and (isinstance(self.micro_batch, str) or self.micro_batch < 1):
            raise ValueError(f'micro_batch is 1 or more, or "auto"; got {self.micro_batch!r}')
        if isinstance(self.compile, str) and self.compile not in COMPILE_MODES:
            raise ValueError(f"compile is True, False or one of {', '.join(COMPILE_MODES)}; got {self.compile!r}")
        if self.memory_gib is not None and self.memory_gib <= 0:
            raise ValueError(f"memory_gib is more than 0; got {self.memory_gib}")
        check_dtype(self.dtype)
