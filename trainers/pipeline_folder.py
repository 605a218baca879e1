"""An inpainting pipeline as a folder in the diffusers format: found, downloaded, and written again with another U-Net."""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

from zsdata.synthesis.inpaint.diffusion_parts import OTHER_PARTS, WEIGHTED_PARTS
from zsdata.synthesis.model_name import split_revision

UNET = "unet"
FROZEN_PARTS = tuple(part for part in (*WEIGHTED_PARTS, *OTHER_PARTS) if part != UNET)
SMALL_PARTS = ("feature_extractor",)  # downloaded too: diffusers' own loader wants them, and they are a few kilobytes
INDEX = "model_index.json"  # which pipeline it is, and its parts: {"vae": ["diffusers", "AutoencoderKL"], ...}
CARD = ("README.md", "LICENSE*")  # they hold for a fine-tuned pipeline too
LEFT_OUT_ALWAYS = ("*.bin", "*.non_ema.*", "*.msgpack", "*.onnx*")  # the same weights in other forms
LEFT_OUT = (*LEFT_OUT_ALWAYS, "*.fp16.*")


def local_pipeline(name: str, subfolder: str = "", revision: str | None = None) -> Path:
    """The folder that holds a pipeline, at `subfolder` of it; one from the Hub is downloaded to its cache first, without the parts and the
    forms of weights that nobody needs here.

    Args:
        name: a local folder or a Hub id ("owner/name", or "owner/name@revision").
        subfolder: where in it the pipeline lies.
        revision: branch, tag or commit of a Hub id.

    Raises:
        FileNotFoundError: neither a folder nor a Hub id; or the folder has no such subfolder.
        OSError: the Hub does not have it, or cannot be reached.
    """
    name, revision = split_revision(name, revision)
    if os.path.isdir(name):
        if not Path(name, subfolder).is_dir():
            raise FileNotFoundError(f'no folder "{subfolder}" in {name}')
        return Path(name)
    if not re.fullmatch(r"[\w.-]+/[\w.-]+", name):
        raise FileNotFoundError(f'"{name}" is neither a folder nor a Hub id ("owner/name")')
    from huggingface_hub import snapshot_download

    inner = f"{subfolder}/" if subfolder else ""
    wanted = [f"{inner}{part}/*" for part in (UNET, *FROZEN_PARTS, *SMALL_PARTS)] + [f"{inner}{file}" for file in (INDEX, *CARD)]
    return Path(snapshot_download(name, revision=revision, allow_patterns=[*wanted, *CARD], ignore_patterns=list(LEFT_OUT)))


def frozen_digest(folder: Path) -> str:
    """Changes with any file of what `write_pipeline` takes over and the U-Net is tuned for; a few seconds for a large pipeline."""
    digest = hashlib.sha256(usedforsecurity=False)
    for path in sorted(path for part in FROZEN_PARTS for path in (folder / part).rglob("*") if path.is_file()):
        if path.name not in _other_forms(str(path.parent), os.listdir(path.parent)):
            digest.update(f"{path.relative_to(folder).as_posix()} {path.stat().st_size}\n".encode())
            with path.open("rb") as file:
                while block := file.read(2**20):
                    digest.update(block)
    return digest.hexdigest()[:16]


def write_pipeline(folder: Path, unet: Any, source: Path, subfolder: str = "") -> None:
    """Writes the pipeline at `subfolder` of `source` to a new folder, but with `unet` (diffusers.UNet2DConditionModel).

    A part that its index names and that is not there, as a safety checker that was not downloaded, is one that it goes without.
    """
    inner = source / subfolder
    folder.mkdir(parents=True)
    index: dict[str, Any] = json.loads((inner / INDEX).read_text()) if (inner / INDEX).is_file() else {}
    more = [name for name, made_by in index.items() if isinstance(made_by, list) and name not in (UNET, *FROZEN_PARTS)]
    for part in (*FROZEN_PARTS, *(name for name in more if _is_whole(inner / name))):
        shutil.copytree(inner / part, folder / part, ignore=_other_forms)
    if index:
        index |= {name: [None, None] for name in more if not (folder / name).is_dir()}
        (folder / INDEX).write_text(json.dumps(index, indent=2) + "\n")
    for place in (source, inner):  # the pipeline's own last
        for path in (path for pattern in CARD for path in place.glob(pattern) if path.is_file()):
            shutil.copyfile(path, folder / path.name)
    unet.save_pretrained(folder / UNET)


def _other_forms(_: str, names: list[str]) -> set[str]:
    """Which of a folder's files hold the same weights again; those in half precision only where there are others."""
    patterns = LEFT_OUT if any(name.endswith(".safetensors") and ".fp16." not in name for name in names) else LEFT_OUT_ALWAYS
    return {name for name in names if any(fnmatch(name, pattern) for pattern in patterns)}


def _is_whole(part: Path) -> bool:
    """Whether a part is there, with its weights if it is a network."""
    return part.is_dir() and (not (part / "config.json").is_file() or any(part.glob("*.safetensors")))
