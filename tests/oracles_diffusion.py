"""Diffusion inpainting, slow and plain: one image, the masks pixel by pixel, DDIM straight from its formulas in float64."""

from __future__ import annotations

import numpy as np
import torch


def latent_mask(inpaint_mask: np.ndarray) -> np.ndarray:
    """bool [H, W] -> bool [ceil(H / 8), ceil(W / 8)], True in cells with a hole pixel."""
    height, width = inpaint_mask.shape
    cells = np.zeros((-(-height // 8), -(-width // 8)), bool)
    for y in range(height):
        for x in range(width):
            if inpaint_mask[y, x]:
                cells[y // 8, x // 8] = True
    return cells


def ddim_inpaint(unet, vae, prompt, right: np.ndarray, inpaint_mask: np.ndarray, noise: np.ndarray, steps: int) -> np.ndarray:
    """The decoded image, float [3, H, W] 0..255, of right [3, H, W] 0..255, inpaint_mask bool [H, W] and noise [4, H / 8, W / 8].

    The noise schedule is Stable Diffusion's: 1000 steps, betas with evenly spaced square roots, "leading" time steps with offset 1.
    """
    height, width = inpaint_mask.shape
    masked = np.where(inpaint_mask, 0, right / 127.5 - 1)
    masked = np.pad(masked, ((0, 0), (0, -height % 8), (0, -width % 8)), mode="edge")
    latent = vae.encode(_tensor(masked)).latent_dist.mean[0].numpy() * vae.config.scaling_factor
    beside = np.concatenate([latent_mask(inpaint_mask)[None], latent])
    kept = np.cumprod(1 - np.linspace(0.00085**0.5, 0.012**0.5, 1000) ** 2)  # alpha bar
    stride = 1000 // steps
    x = noise.astype(np.float64)
    for k in reversed(range(steps)):
        t = k * stride + 1
        before = kept[t - stride] if t >= stride else kept[0]
        predicted = unet(_tensor(np.concatenate([x, beside])), t, encoder_hidden_states=prompt).sample[0].numpy().astype(np.float64)
        clean = (x - np.sqrt(1 - kept[t]) * predicted) / np.sqrt(kept[t])
        x = np.sqrt(before) * clean + np.sqrt(1 - before) * predicted
    decoded = vae.decode(_tensor(x / vae.config.scaling_factor)).sample[0].numpy()
    return (np.clip(decoded[:, :height, :width], -1, 1) + 1) / 2 * 255


def _tensor(array: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(array[None].astype(np.float32))
