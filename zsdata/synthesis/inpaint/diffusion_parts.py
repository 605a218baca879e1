"""The parts of an inpainting pipeline in the diffusers format, loaded one by one.

Fine-tuned checkpoints name a pipeline class in model_index.json that diffusers does not know, so that file is not read: the layout is
fixed, and so are the classes. Weights come from safetensors alone, since pickled ones can run code.
"""

from __future__ import annotations

import logging
import os
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import torch
from huggingface_hub import hf_hub_download
from safetensors import SafetensorError
from torch import Tensor

from zsdata.synthesis.inpaint.options import DiffusionNetwork

CELL_PX = 8  # a latent cell is 8x8 pixels in every Stable Diffusion
LATENT_CHANNELS = 4
LATENT_SCALE = 0.18215
INPAINTING_CHANNELS = 2 * LATENT_CHANNELS + 1  # noisy latent, mask, latent of the masked image

# What a U-Net may be given beside the prompt; nothing here knows what to give.
OTHER_CONDITIONS = ("addition_embed_type", "class_embed_type", "encoder_hid_dim_type", "num_class_embeds", "time_cond_proj_dim")
SUGGESTION = "take ZeroStereo's checkpoint or Stable Diffusion 2 Inpainting"

WEIGHTED_PARTS = ("unet", "vae", "text_encoder")
OTHER_PARTS = ("scheduler", "tokenizer")


class DiffusionParts(NamedTuple):
    """What inpainting needs of a pipeline, on the CPU; the networks in evaluation mode and without gradients."""

    unet: Any  # diffusers.UNet2DConditionModel with 9 input channels
    autoencoder: Any  # diffusers.AutoencoderKL or AutoencoderTiny
    scheduler_config: Mapping[str, Any]
    prompt: Tensor  # [1, 2, D]: the empty prompt's embedding, not padded (begin, end), which is what the networks were tuned with


def check_configurations(network: DiffusionNetwork) -> Mapping[str, Any]:
    """Whether this is an inpainting pipeline, as far as its configurations tell; returns the scheduler's. No weights are loaded.

    Raises:
        ImportError, OSError, ValueError: as `load_diffusion_parts`.
    """
    _check_packages(network)
    _check_folder(network)
    from diffusers import DDIMScheduler, UNet2DConditionModel  # pyright: ignore[reportPrivateImportUsage]

    place = network.name, network.subfolder
    config: Any = _load(DDIMScheduler.load_config, *place, "scheduler", network.revision)
    _check_unet(network.name, _load(UNet2DConditionModel.load_config, *place, "unet", network.revision))
    return config


def at_commit(network: DiffusionNetwork) -> DiffusionNetwork:
    """The network at the commits that its Hub ids stand for now: what moves on the Hub later changes no run that goes on.

    Raises:
        ImportError: diffusers or transformers is not installed.
        FileNotFoundError, OSError, ValueError: there is no such folder, or the Hub does not have it, or cannot be reached and the local
            cache does not have it either.
    """
    _check_packages(network)
    _check_folder(network)
    revision, autoencoder_revision = network.revision, network.autoencoder_revision
    if not os.path.isdir(network.name):
        revision = _load(_commit, network.name, network.subfolder, "scheduler", revision, file="scheduler_config.json")
    if network.autoencoder is not None and not os.path.isdir(network.autoencoder):
        autoencoder_revision = _load(_commit, network.autoencoder, "", "", autoencoder_revision, file="config.json")
    return replace(network, revision=revision, autoencoder_revision=autoencoder_revision)


def _commit(name: str, revision: str | None, file: str, subfolder: str = "") -> str:
    """`file` is a small one: the Hub says its commit with it."""
    path = f"{subfolder}/{file}".lstrip("/")
    return Path(hf_hub_download(name, path, revision=revision)).parents[path.count("/")].name


def load_diffusion_parts(network: DiffusionNetwork, dtype: torch.dtype = torch.float32) -> DiffusionParts:
    """Loads U-Net, autoencoder and scheduler configuration; embeds the empty prompt and drops the text encoder.

    Args:
        network: its name holds unet/, vae/, text_encoder/, tokenizer/ and scheduler/; its autoencoder, `AutoencoderKL` or
            `AutoencoderTiny`, is used in place of vae/.
        dtype: of the U-Net, the autoencoder and the prompt; the prompt is computed in float32.

    Raises:
        ImportError: diffusers or transformers is not installed.
        FileNotFoundError, OSError: the folder, a part of it or its safetensors weights are missing or damaged.
        ValueError: the parts are not those of an inpainting pipeline, or weights are incomplete.
    """
    scheduler_config = check_configurations(network)
    from diffusers import (  # pyright: ignore[reportPrivateImportUsage]
        AutoencoderKL,  # pyright: ignore[reportPrivateImportUsage]
        AutoencoderTiny,  # pyright: ignore[reportPrivateImportUsage]
        UNet2DConditionModel,  # pyright: ignore[reportPrivateImportUsage]
    )
    from transformers import CLIPTextModel, CLIPTokenizerFast  # pyright: ignore[reportAttributeAccessIssue]

    name, subfolder, revision, autoencoder = network.name, network.subfolder, network.revision, network.autoencoder
    unet = _load_weights(UNet2DConditionModel, name, subfolder, "unet", revision, torch_dtype=dtype)

    autoencoder_place = (name, subfolder, "vae", revision) if autoencoder is None else (autoencoder, "", "", network.autoencoder_revision)
    autoencoders = {"AutoencoderKL": AutoencoderKL, "AutoencoderTiny": AutoencoderTiny}
    autoencoder_config: Any = _load(AutoencoderKL.load_config, *autoencoder_place)
    kind = autoencoder_config.get("_class_name")
    if kind not in autoencoders:
        raise ValueError(f"{_where(*autoencoder_place[:3])} is a {kind}; an autoencoder here is one of {sorted(autoencoders)}")
    images_to_latents = _load_weights(autoencoders[kind], *autoencoder_place, torch_dtype=dtype)
    config = images_to_latents.config
    cell_px = 2 ** (len(config.block_out_channels if kind == "AutoencoderKL" else config.encoder_block_out_channels) - 1)
    if (cell_px, config.latent_channels) != (CELL_PX, LATENT_CHANNELS):
        raise ValueError(
            f"{_where(*autoencoder_place[:3])} makes {config.latent_channels} channels of {cell_px}x{cell_px} pixels; "
            f"Stable Diffusion's latents are {LATENT_CHANNELS} channels of {CELL_PX}x{CELL_PX}"
        )

    shifted = [key for key in ("shift_factor", "latents_mean", "latents_std") if config.get(key)]
    other = autoencoder is not None and kind == "AutoencoderKL" and config.scaling_factor != LATENT_SCALE
    if shifted or other:
        raise ValueError(
            f"{_where(*autoencoder_place[:3])} has {shifted[0] if shifted else f'scaling_factor {config.scaling_factor:g}'}: "
            f"its latents are those of another model (Stable Diffusion's are scaled by {LATENT_SCALE} and not shifted); "
            'leave autoencoder out, or take "stabilityai/sd-vae-ft-mse" or the tiny "madebyollin/taesd"'
        )

    tokenizer = _load(CLIPTokenizerFast.from_pretrained, name, subfolder, "tokenizer", revision)
    text_encoder = _load_weights(CLIPTextModel, name, subfolder, "text_encoder", revision)
    words = tokenizer("", padding=False, return_tensors="pt").input_ids
    # Without its vocabulary a tokenizer loads all the same, with words of its own making.
    if len(tokenizer) < text_encoder.config.vocab_size or words.tolist() != [[tokenizer.bos_token_id, tokenizer.eos_token_id]]:
        raise ValueError(
            f"{_where(name, subfolder, 'tokenizer')} knows {len(tokenizer)} words and makes {words.tolist()[0]} of an empty prompt; the "
            f"text encoder knows {text_encoder.config.vocab_size}, and the prompt must be begin and end. Its vocabulary (tokenizer.json, "
            "or vocab.json and merges.txt) is missing, or belongs to another pipeline: download it again"
        )
    with torch.no_grad(), torch.autocast("cpu", enabled=False):  # an autocast around the first use must not change the pictures
        prompt = text_encoder.float()(words)[0]
    if prompt.shape[-1] != unet.config.cross_attention_dim:
        raise ValueError(
            f'inpaint="{name}": the text encoder gives {prompt.shape[-1]} channels, the U-Net takes {unet.config.cross_attention_dim}; '
            "the parts belong to different pipelines"
        )
    return DiffusionParts(unet, images_to_latents, scheduler_config, prompt.to(dtype))


def _where(name: str, subfolder: str, part: str) -> str:
    return "/".join(filter(None, (name, subfolder, part)))


def _load(load: Any, name: str, subfolder: str, part: str, revision: str | None, **options: Any) -> Any:
    try:
        inner = "/".join(filter(None, (subfolder, part)))
        return load(name, revision=revision, **({"subfolder": inner} if inner else {}), **options)
    except (OSError, SafetensorError, ValueError, RuntimeError, TypeError) as error:
        raise OSError(
            f"{_where(name, subfolder, part)} cannot be loaded. It must be there, complete, its weights (where it has any) in safetensors; "
            f"pickled .bin weights are refused, since they can run code. {type(error).__name__}: {error}"
        ) from error


def _load_weights(network: Any, name: str, subfolder: str, part: str, revision: str | None, **options: Any) -> Any:
    """A network with all of its weights; the libraries themselves fill gaps with random numbers and only log it.

    Some pipelines hold their weights only in half precision, under names with "fp16".
    """
    options |= {"use_safetensors": True, "output_loading_info": True}
    with torch.random.fork_rng(devices=[]):  # older transformers fill the weights with random numbers first
        try:
            with _unsaid("error occurred while trying to fetch"):
                loaded, report = _load(network.from_pretrained, name, subfolder, part, revision, **options)
        except OSError as error:
            try:
                loaded, report = _load(network.from_pretrained, name, subfolder, part, revision, variant="fp16", **options)
            except OSError:
                raise error from None
    if report["missing_keys"]:
        missing = sorted(report["missing_keys"])
        raise ValueError(
            f'{_where(name, subfolder, part)} lacks {len(missing)} weights, "{missing[0]}" for one; download it again, or upgrade '
            "diffusers and transformers: a text encoder saved by transformers 5 has names that older ones do not know"
        )
    return loaded.eval().requires_grad_(False)


@contextmanager
def _unsaid(words: str) -> Iterator[None]:
    """Keeps back what diffusers logs of weights that are not there; they may be there under another name, and if not, the error says it."""

    def others(record: logging.LogRecord) -> bool:
        return words not in record.getMessage()

    logger = logging.getLogger("diffusers.models.modeling_utils")
    logger.addFilter(others)
    try:
        yield
    finally:
        logger.removeFilter(others)


def _check_unet(name: str, config: Mapping[str, Any]) -> None:
    channels = config.get("in_channels"), config.get("out_channels")
    if channels != (INPAINTING_CHANNELS, LATENT_CHANNELS):
        raise ValueError(
            f'inpaint="{name}" is no inpainting model: its U-Net takes {channels[0]} channels and gives {channels[1]}, inpainting takes '
            f"{INPAINTING_CHANNELS} (latent, mask, masked image) and gives {LATENT_CHANNELS}; {SUGGESTION}"
        )
    if others := [f"{key}={config[key]}" for key in OTHER_CONDITIONS if config.get(key) is not None]:
        raise ValueError(
            f'inpaint="{name}": its U-Net wants more than the empty prompt ({", ".join(others)}), as Stable Diffusion XL and models '
            f"distilled with guidance do; {SUGGESTION}"
        )


def _check_packages(network: DiffusionNetwork) -> None:
    try:
        import diffusers  # noqa: F401
        import transformers  # noqa: F401
    except ImportError as error:
        raise ImportError(f'inpaint="{network.name}" needs diffusers and transformers: pip install "zsdata[diffusion]"') from error


def _check_folder(network: DiffusionNetwork) -> None:
    """Says what a local folder lacks, before a library asks the Hub for it."""
    name, subfolder, autoencoder = network.name, network.subfolder, network.autoencoder
    for place, revision, argument in (
        (name, network.revision, "revision"),
        (autoencoder, network.autoencoder_revision, "autoencoder_revision"),
    ):
        if place is not None and revision is not None and os.path.isdir(place):
            raise ValueError(f'"{place}" is a folder, which has no revisions; got {argument}="{revision}": leave it out')
    for place in filter(None, (name, autoencoder)):
        if not os.path.isdir(place) and not re.fullmatch(r"[\w.-]+/[\w.-]+", place):
            raise FileNotFoundError(f'"{place}" is neither a folder nor a Hub id ("owner/name")')
    weighted = [Path(name, subfolder, part) for part in WEIGHTED_PARTS if part != "vae" or autoencoder is None]
    needed = weighted + [Path(name, subfolder, part) for part in OTHER_PARTS]
    if os.path.isdir(name):
        if missing := [path.name for path in needed if not path.is_dir()]:
            deeper = sorted(path.parent for path in Path(name, subfolder).glob("*/unet"))
            cure = f'"{deeper[0]}" may be meant' if deeper else "if the pipeline lies deeper in the folder, name its `subfolder`"
            raise FileNotFoundError(
                f'"{Path(name, subfolder)}" is no inpainting pipeline: it lacks {", ".join(f"{part}/" for part in missing)}; {cure}'
            )
    else:
        weighted = []
    for path in weighted + ([Path(autoencoder)] if autoencoder and os.path.isdir(autoencoder) else []):
        if not any(path.glob("*.safetensors")):
            raise FileNotFoundError(f'"{path}" holds no weights in safetensors (pickled .bin weights are refused, since they can run code)')
