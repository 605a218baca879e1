"""Small depth networks with random weights, saved with their image processors by transformers itself, in the format of the real ones."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
import transformers as hf

STAGES = ["stage1", "stage2", "stage3", "stage4"]
NECK: dict[str, Any] = {"neck_hidden_sizes": [8, 16, 24, 32], "fusion_hidden_size": 16}
VIT: dict[str, Any] = {"hidden_size": 32, "num_hidden_layers": 4, "num_attention_heads": 2}
IMAGENET = {"image_mean": [0.485, 0.456, 0.406], "image_std": [0.229, 0.224, 0.225]}
IMAGENET_GREY_LEVELS = {"do_rescale": False, "image_mean": [123.675, 116.28, 103.53], "image_std": [58.395, 57.12, 57.375]}


def dinov2() -> Any:
    return hf.Dinov2Config(**VIT, mlp_ratio=2, image_size=70, patch_size=14, out_features=STAGES, reshape_hidden_states=False)


def beit() -> Any:
    return hf.BeitConfig(
        **VIT,
        intermediate_size=64,
        image_size=64,
        patch_size=16,
        out_features=STAGES,
        reshape_hidden_states=False,
        use_relative_position_bias=True,
    )


def depth_anything(**options: Any) -> Any:
    config = hf.DepthAnythingConfig(
        backbone_config=dinov2(), reassemble_hidden_size=32, **NECK, head_hidden_size=8, patch_size=14, **options
    )
    return hf.DepthAnythingForDepthEstimation(config)


def metric_depth_anything() -> Any:
    return depth_anything(depth_estimation_type="metric", max_depth=20)


def midas_vit() -> Any:
    config = hf.DPTConfig(
        **VIT, **NECK, intermediate_size=64, image_size=64, patch_size=16, backbone_out_indices=[0, 1, 2, 3], is_hybrid=False
    )
    return hf.DPTForDepthEstimation(config)


def midas_hybrid() -> Any:
    backbone = {
        "model_type": "bit",
        "global_padding": "same",
        "layer_type": "bottleneck",
        "depths": [1, 1, 1],
        "out_features": STAGES[:3],
        "embedding_dynamic_padding": True,
        "hidden_sizes": [8, 16, 32],
        "embedding_size": 8,
        "num_groups": 4,
    }
    config = hf.DPTConfig(
        **VIT,
        neck_hidden_sizes=[8, 16, 32, 32],
        fusion_hidden_size=16,
        intermediate_size=64,
        image_size=64,
        patch_size=16,
        is_hybrid=True,
        backbone_config=backbone,
        backbone_featmap_shape=[1, 32, 4, 4],
        backbone_out_indices=[0, 1, 2, 3],
        neck_ignore_stages=[0, 1],
    )
    return hf.DPTForDepthEstimation(config)


def midas_beit() -> Any:
    return hf.DPTForDepthEstimation(hf.DPTConfig(backbone_config=beit(), hidden_size=32, **NECK))


def midas_swin() -> Any:
    backbone = hf.Swinv2Config(
        embed_dim=8, depths=[1, 1, 1, 1], num_heads=[1, 2, 2, 2], window_size=4, image_size=64, patch_size=4, out_features=STAGES
    )
    neck = {**NECK, "neck_hidden_sizes": [8, 16, 32, 64]}
    return hf.DPTForDepthEstimation(hf.DPTConfig(backbone_config=backbone, hidden_size=32, **neck, readout_type="ignore", is_hybrid=False))


def dinov2_dpt() -> Any:
    neck = {**NECK, "fusion_hidden_size": 256}  # the only one that its projection knows
    config = hf.DPTConfig(backbone_config=dinov2(), hidden_size=32, **neck, add_projection=True, use_bias_in_fusion_residual=False)
    return hf.DPTForDepthEstimation(config)


def glpn() -> Any:
    config = hf.GLPNConfig(depths=[1] * 4, hidden_sizes=[8, 16, 24, 32], num_attention_heads=[1] * 4, decoder_hidden_size=8)
    return hf.GLPNForDepthEstimation(config)


def zoe(domains: list[dict[str, Any]] | None = None) -> Any:
    head = {"bottleneck_features": 16, "num_relative_features": 8, "bin_embedding_dim": 16, "num_attractors": [4, 2, 2, 1]}
    if domains is not None:
        sizes = {"hidden_size": 128, "intermediate_size": 16, "num_attention_heads": 2}
        head |= {"bin_configurations": domains, "num_patch_transformer_layers": 4}
        head |= {f"patch_transformer_{name}": size for name, size in sizes.items()}
    return hf.ZoeDepthForDepthEstimation(hf.ZoeDepthConfig(backbone_config=beit(), backbone_hidden_size=32, **NECK, **head))


def zoe_of_two_domains() -> Any:
    """As published for indoors and outdoors."""
    bins = {"n_bins": 8, "min_depth": 0.001}
    return zoe([{"name": "nyu", "max_depth": 10.0, **bins}, {"name": "kitti", "max_depth": 80.0, **bins}])


def depth_pro() -> Any:
    encoder = {"model_type": "dinov2", "hidden_size": 16, "num_hidden_layers": 2, "num_attention_heads": 2, "mlp_ratio": 2}
    encoder |= {"image_size": 28, "patch_size": 14, "reshape_hidden_states": False}
    config = hf.DepthProConfig(
        patch_size=28,
        fusion_hidden_size=16,
        intermediate_hook_ids=[1, 0],
        intermediate_feature_dims=[8, 8],
        scaled_images_ratios=[0.5, 1.0],
        scaled_images_overlap_ratios=[0.0, 0.2],
        scaled_images_feature_dims=[8, 8],
        merge_padding_value=0,
        image_model_config=dict(encoder),
        patch_model_config=dict(encoder),
        fov_model_config=dict(encoder),
    )
    return hf.DepthProForDepthEstimation(config)


def tipsv2() -> Any:
    backbone = hf.Tipsv2VisionConfig(
        **VIT, mlp_ratio=2, image_size=70, patch_size=14, out_indices=[1, 2, 3, 4], reshape_hidden_states=False
    )
    return hf.Tipsv2DptForDepthEstimation(hf.Tipsv2DptConfig(backbone_config=backbone, **NECK))


def chmv2() -> Any:
    backbone = hf.DINOv3ViTConfig(
        **VIT,
        intermediate_size=64,
        image_size=64,
        patch_size=16,
        out_indices=[1, 2, 3, 4],
        reshape_hidden_states=True,
        return_class_token=True,
        apply_layernorm=True,
    )
    head = {
        "post_process_channels": NECK["neck_hidden_sizes"],
        "fusion_hidden_size": 16,
        "head_hidden_size": 8,
        "number_output_channels": 32,
    }
    return hf.CHMv2ForDepthEstimation(hf.CHMv2Config(backbone_config=backbone, **head))


def prompt_depth_anything() -> Any:
    config = hf.PromptDepthAnythingConfig(
        backbone_config=dinov2(), reassemble_hidden_size=32, **NECK, head_hidden_size=8, depth_estimation_type="metric", max_depth=20
    )
    return hf.PromptDepthAnythingForDepthEstimation(config)


DPT, SQUARE_70 = "DPTImageProcessor", {"height": 70, "width": 70}
PATCHES = {"keep_aspect_ratio": True, "ensure_multiple_of": 14}
# Each network, its image processor and the options of that, as in the published folders but for the sizes.
NETWORKS: dict[str, tuple[Callable[[], Any], str, dict[str, Any]]] = {
    "depth_anything": (depth_anything, DPT, {"size": SQUARE_70, **PATCHES, **IMAGENET}),
    "metric_depth_anything": (metric_depth_anything, DPT, {"size": SQUARE_70, **PATCHES, **IMAGENET}),
    "midas_vit": (midas_vit, DPT, {"size": {"height": 64, "width": 64}, "resample": 2}),
    "midas_hybrid": (midas_hybrid, DPT, {"size": {"height": 64, "width": 64}, "resample": 2}),
    "midas_beit": (midas_beit, DPT, {"size": {"height": 64, "width": 64}, "keep_aspect_ratio": True, "ensure_multiple_of": 32}),
    "midas_swin": (midas_swin, DPT, {"size": {"height": 64, "width": 64}, "keep_aspect_ratio": True, "ensure_multiple_of": 32}),
    "dinov2_dpt": (dinov2_dpt, DPT, {"do_resize": False, "do_pad": True, "size_divisor": 14, **IMAGENET_GREY_LEVELS}),
    "glpn": (glpn, "GLPNImageProcessor", {"size_divisor": 32}),
    "zoe": (zoe, "ZoeDepthImageProcessor", {"size": {"height": 64, "width": 96}, "ensure_multiple_of": 32}),
}
if hasattr(hf, "DepthProConfig"):  # since transformers 4.49
    NETWORKS["depth_pro"] = (depth_pro, "DepthProImageProcessor", {"size": {"height": 56, "width": 56}})
if hasattr(hf, "Tipsv2DptConfig"):
    NETWORKS["tipsv2"] = (tipsv2, "Tipsv2DptImageProcessor", {"size": SQUARE_70, "resample": 2, "do_normalize": False})
if hasattr(hf, "CHMv2Config"):
    NETWORKS["chmv2"] = (chmv2, "CHMv2ImageProcessor", {})
REFUSED = dict[str, tuple[Callable[[], Any], str, dict[str, Any]]]()
if hasattr(hf, "PromptDepthAnythingConfig"):  # since transformers 4.50
    REFUSED["prompt_depth_anything"] = (prompt_depth_anything, "PromptDepthAnythingImageProcessor", {"size": SQUARE_70, **PATCHES})


def save_small_network(kind: str, folder: Path, seed: int = 0) -> Path:
    """Writes one of NETWORKS or REFUSED to `folder`. Its weights let signals through: what it predicts varies over the image."""
    build, processor, options = {**NETWORKS, **REFUSED}[kind]
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        network = build()
        with torch.no_grad():
            for name, weight in network.named_parameters():
                if weight.ndim > 1 and "token" not in name and "embeddings" not in name:
                    weight.normal_(std=weight[0].numel() ** -0.5)
                elif name.endswith("bias"):
                    weight.normal_(0.2, 0.1)
    network.save_pretrained(folder)
    saved = folder / "preprocessor_config.json"
    pil = getattr(hf, f"{processor}Pil", None)
    if pil is not None and isinstance(pil, type):
        pil(**options).save_pretrained(folder)
    else:  # a processor that this installation cannot run, and so cannot save
        saved.write_text(json.dumps({"image_processor_type": processor, **options}))
    return folder
