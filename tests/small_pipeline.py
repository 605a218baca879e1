"""A small inpainting pipeline with random weights, saved by the libraries themselves in the layout of Stable Diffusion 2 Inpainting."""

from __future__ import annotations

import json
from pathlib import Path

import torch

SCHEDULE = {"beta_start": 0.00085, "beta_end": 0.012, "beta_schedule": "scaled_linear"}
TOKENS = {"<|startoftext|>": 0, "<|endoftext|>": 1, "a": 2, "a</w>": 3}


def save_small_pipeline(path: Path, prediction_type: str = "epsilon") -> Path:
    """Writes it to the folder `path`; its model_index.json names a class that no library has, as published fine-tuned models do."""
    import diffusers
    import transformers

    with torch.random.fork_rng():
        torch.manual_seed(0)
        unet = diffusers.UNet2DConditionModel(
            in_channels=9,
            out_channels=4,
            block_out_channels=[8, 16],
            norm_num_groups=4,
            attention_head_dim=4,
            layers_per_block=1,
            cross_attention_dim=16,
            down_block_types=["CrossAttnDownBlock2D", "DownBlock2D"],
            up_block_types=["UpBlock2D", "CrossAttnUpBlock2D"],
        )
        vae = diffusers.AutoencoderKL(
            down_block_types=["DownEncoderBlock2D"] * 4,
            up_block_types=["UpDecoderBlock2D"] * 4,
            block_out_channels=[4, 4, 8, 8],
            norm_num_groups=2,
        )
        text = transformers.CLIPTextConfig(vocab_size=4, hidden_size=16, intermediate_size=16, num_hidden_layers=1, num_attention_heads=2)
        text_encoder = transformers.CLIPTextModel(text)
    unet.save_pretrained(path / "unet")
    vae.save_pretrained(path / "vae")
    text_encoder.save_pretrained(path / "text_encoder")
    diffusers.PNDMScheduler(**SCHEDULE, skip_prk_steps=True, steps_offset=1, prediction_type=prediction_type).save_pretrained(
        path / "scheduler"
    )
    tokenizer = path / "tokenizer"
    tokenizer.mkdir()
    (tokenizer / "vocab.json").write_text(json.dumps(TOKENS))
    (tokenizer / "merges.txt").write_text("#version: 0.2\n")
    special = {"bos_token": "<|startoftext|>", "eos_token": "<|endoftext|>", "pad_token": "!", "unk_token": "<|endoftext|>"}
    (tokenizer / "tokenizer_config.json").write_text(json.dumps({"tokenizer_class": "CLIPTokenizer", "model_max_length": 77} | special))
    (path / "model_index.json").write_text('{"_class_name": "NobodyKnowsThisPipeline"}')
    (path / "README.md").write_text("---\nlicense: openrail++\n---\n")
    return path
