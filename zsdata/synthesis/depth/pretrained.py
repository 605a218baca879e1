"""Depth from a network in the transformers format: Depth Anything V2 and its relatives."""

from __future__ import annotations

import json
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

# Networks that predict metric depth, whatever their configuration says; all others predict inverse depth unless it says "metric".
METRIC_DEPTH_MODELS = ("depth_pro", "glpn", "zoedepth")
SMALLEST_DEPTH_M = 1e-3


class PretrainedDepth:
    """A depth-estimation network of transformers, with the pre-processing that its folder states.

    Photos are resized so that their short side is the network's own input size, keeping the aspect, to whole patches; normalised; and the
    prediction is brought back to the photo's size. Metric depth is inverted.

    Args:
        name: a Hub id, such as "depth-anything/Depth-Anything-V2-Small-hf" (Apache-2.0), or a local folder.
        device: where the network is put.

    Raises:
        ImportError: transformers is not installed.
        OSError: nothing is found under that name.
    """

    def __init__(self, name: str, device: str | torch.device = "cpu") -> None:
        try:
            from transformers import AutoModelForDepthEstimation
            from transformers.utils.hub import cached_file
        except ImportError as error:
            raise ImportError(f'depth="{name}" needs transformers: pip install "zsdata[depth]"') from error
        self._network = AutoModelForDepthEstimation.from_pretrained(name).to(device).eval().requires_grad_(False)
        with open(str(cached_file(name, "preprocessor_config.json")), encoding="utf-8") as file:
            preprocessing: dict[str, Any] = json.load(file)
        size = preprocessing.get("size", 518)
        self._short_side_px = int(size if isinstance(size, int) else min(size.values()))
        config = self._network.config
        backbone = getattr(config, "backbone_config", None)
        self._multiple_px = int(
            preprocessing.get("ensure_multiple_of") or getattr(config, "patch_size", None) or getattr(backbone, "patch_size", None) or 32
        )
        self._mean = torch.tensor(preprocessing.get("image_mean", [0.485, 0.456, 0.406]), device=device).view(1, 3, 1, 1)
        self._std = torch.tensor(preprocessing.get("image_std", [0.229, 0.224, 0.225]), device=device).view(1, 3, 1, 1)
        self._metric = config.model_type in METRIC_DEPTH_MODELS or getattr(config, "depth_estimation_type", "relative") == "metric"

    @torch.inference_mode()
    def __call__(self, images: Tensor) -> Tensor:
        """Inverse depth of `images`.

        Args:
            images: float32 [B, 3, H, W], RGB 0..255.

        Returns:
            float32 [B, 1, H, W], larger is nearer, on the device of `images`.
        """
        height, width = images.shape[-2:]
        scale = self._short_side_px / min(height, width)
        size = [max(1, round(side * scale / self._multiple_px)) * self._multiple_px for side in (height, width)]
        pixels = F.interpolate(images.to(self._mean.device), size, mode="bicubic", antialias=True, align_corners=False).clamp(0, 255)
        predicted = self._network(pixel_values=(pixels / 255 - self._mean) / self._std).predicted_depth.unsqueeze(1).float()
        if self._metric:
            predicted = 1 / predicted.clamp(min=SMALLEST_DEPTH_M)
        return F.interpolate(predicted, (height, width), mode="bilinear", align_corners=False).to(images.device)
