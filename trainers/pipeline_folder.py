"""An inpainting pipeline as a folder in the diffusers format: found, downloaded, and written again with another U-Net."""

from __future__ import annotations

import hashlib
import os
import re
import shutil
from pathlib import Path
from typing import Any

from zsdata.synthesis.inpaint.diffusion_parts import OTHER_PARTS, WEIGHTED_PARTS

UNET = "unet"
FROZEN_PARTS = tuple(part for part in (*WEIGHTED_PARTS, *OTHER_PARTS) if part != UNET)
ABOUT = ("*.json", "*.md", "LICENSE*")  # which pipeline it is, its card and its licence: they hold for a fine-tuned one too
LEFT_OUT = ("*.bin", "*.fp16.*", "*.non_ema.*", "*.msgpack", "*.onnx*")  # the same weights in other forms


def local_pipeline(name: str, subfolder: str = "", revision: str | None = None) -> Path:
    """The folder of a pipeline; one from the Hub is downloaded to its cache first, without the forms of weights that nobody needs.

    Args:
        name: a local folder or a Hub id ("owner/name").
        subfolder: where in it the pipeline lies.
        revision: branch, tag or commit of a Hub id.

    Raises:
        FileNotFoundError: neither a folder nor a Hub id.
        OSError: the Hub does not have it, or cannot be reached.
    """
    if os.path.isdir(name):
        return Path(name, subfolder)
    if not re.fullmatch(r"[\w.-]+/[\w.-]+", name):
        raise FileNotFoundError(f'"{name}" is neither a folder nor a Hub id ("owner/name")')
    from huggingface_hub import snapshot_download

    inner = f"{subfolder}/" if subfolder else ""
    wanted = [f"{inner}{part}/*" for part in (UNET, *FROZEN_PARTS)] + [f"{inner}{pattern}" for pattern in ABOUT]
    return Path(snapshot_download(name, revision=revision, allow_patterns=wanted, ignore_patterns=list(LEFT_OUT)), subfolder)


def frozen_digest(folder: Path) -> str:
    """Changes with any file of what `write_pipeline` takes over and the U-Net is tuned for; a few seconds for a large pipeline."""
    digest = hashlib.sha256(usedforsecurity=False)
    for path in sorted(path for part in FROZEN_PARTS for path in (folder / part).rglob("*") if path.is_file()):
        if not any(path.match(pattern) for pattern in LEFT_OUT):
            digest.update(f"{path.relative_to(folder).as_posix()} {path.stat().st_size}\n".encode())
            with path.open("rb") as file:
                while block := file.read(2**20):
                    digest.update(block)
    return digest.hexdigest()[:16]


def write_pipeline(folder: Path, unet: Any, source: Path) -> None:
    """Writes the pipeline of `source` to a new folder, but with `unet` (diffusers.UNet2DConditionModel)."""
    folder.mkdir(parents=True)
    for part in FROZEN_PARTS:
        shutil.copytree(source / part, folder / part, ignore=shutil.ignore_patterns(*LEFT_OUT))
    for pattern in ABOUT:
        for path in source.glob(pattern):
            if path.is_file():
                shutil.copyfile(path, folder / path.name)
    unet.save_pretrained(folder / UNET)
