"""What the inpainting U-Net is asked: to predict the noise in a right image (paper, section "Fine-tuning Protocol")."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from trainers.inpaint_data.sources import ExampleBatch
from zsdata.seeding import rng
from zsdata.synthesis.inpaint.diffusion import latent_mask
from zsdata.synthesis.inpaint.diffusion_parts import CELL_PX, LATENT_CHANNELS, DiffusionParts


class NoisePrediction:
    """The frozen networks of a pipeline, and the loss of its U-Net.

    Noise and timestep of an example belong to (seed, step, index), so that a step's loss depends neither on ranks nor on micro-batches.

    Raises:
        ValueError: the pipeline's U-Net predicts something else than noise.
    """

    def __init__(self, parts: DiffusionParts, device: torch.device, seed: int) -> None:
        from diffusers import DDPMScheduler  # pyright: ignore[reportPrivateImportUsage]

        predicted = parts.scheduler_config.get("prediction_type", "epsilon")
        if predicted != "epsilon":
            raise ValueError(f"the pipeline's U-Net predicts {predicted}; this trainer teaches those that predict noise (epsilon)")
        self._autoencoder = parts.autoencoder.to(device)
        self._prompt = parts.prompt.to(device)
        self._schedule: Any = DDPMScheduler.from_config(dict(parts.scheduler_config))
        self._timesteps = int(self._schedule.config["num_train_timesteps"])
        self._device, self._seed = device, seed

    def loss(self, model: nn.Module, batch: ExampleBatch) -> Tensor:
        """Mean squared error of the predicted noise (paper, eq. of L_u) over the latents of the whole crop."""
        right, warped, inpaint_mask = (
            image.to(self._device, non_blocking=True) for image in (batch.right, batch.warped, batch.inpaint_mask)
        )
        noise, timesteps = (drawn.to(self._device, non_blocking=True) for drawn in self._draw(batch))
        with torch.no_grad():
            latents = self._encode(right.float() / 127.5 - 1)
            masked_latents = self._encode((warped.float() / 127.5 - 1).masked_fill(inpaint_mask, 0))
            noisy: Tensor = self._schedule.add_noise(latents, noise, timesteps)
            asked = torch.cat([noisy, latent_mask(inpaint_mask), masked_latents], dim=1)
        predicted = model(asked, timesteps, encoder_hidden_states=self._prompt.expand(len(asked), -1, -1)).sample
        return F.mse_loss(predicted.float(), noise)

    def _encode(self, images: Tensor) -> Tensor:
        """Latents of images in -1..1; the distribution's mean, as at inference."""
        encoded = self._autoencoder.encode(images)
        latents = encoded.latent_dist.mean if hasattr(encoded, "latent_dist") else encoded.latents  # a tiny autoencoder has no distribution
        return latents.float() * self._autoencoder.config.scaling_factor

    def _draw(self, batch: ExampleBatch) -> tuple[Tensor, Tensor]:
        height, width = batch.right.shape[-2:]
        shape = (LATENT_CHANNELS, height // CELL_PX, width // CELL_PX)
        noise = [rng(self._seed, *request, "noise").standard_normal(shape, dtype=np.float32) for request in batch.requests]
        timesteps = [int(rng(self._seed, *request, "timestep").integers(self._timesteps)) for request in batch.requests]
        return torch.from_numpy(np.stack(noise)), torch.tensor(timesteps)
