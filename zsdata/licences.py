"""Which models took part, at which revision, under which licence; and which of them a commercial user must not take.

What is said here is what the model cards say, as far as they are at hand: a record for the user, not legal advice.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml
from huggingface_hub import hf_hub_download, metadata_load, try_to_load_from_cache
from huggingface_hub.errors import HfHubHTTPError

from zsdata.synthesis.depth.options import STORED, DepthNetwork
from zsdata.synthesis.inpaint.options import DiffusionNetwork

CARD = "README.md"
OWN_LICENCE = "apache-2.0"
BUILT_IN = ("builtin", "background")

# Depth Anything's authors put the Small V2 networks under Apache-2.0, Base and Large (the metric ones too) under CC-BY-NC-4.0.
LICENCES = {
    **{f"depth-anything/Depth-Anything-V2-{kind}Small-hf": "apache-2.0" for kind in ("", "Metric-Indoor-", "Metric-Outdoor-")},
    **{
        f"depth-anything/Depth-Anything-V2-{kind}{size}-hf": "cc-by-nc-4.0"
        for kind in ("", "Metric-Indoor-", "Metric-Outdoor-")
        for size in ("Base", "Large")
    },
    **{f"LiheYoung/depth-anything-{size}-hf": "apache-2.0" for size in ("small", "base", "large")},
    **{f"facebook/dpt-dinov2-{size}-{scenes}": "apache-2.0" for size in ("small", "base", "large", "giant") for scenes in ("nyu", "kitti")},
    "Intel/dpt-large": "apache-2.0",
    "Intel/dpt-hybrid-midas": "apache-2.0",
    "Intel/zoedepth-nyu": "mit",
    "Intel/zoedepth-kitti": "mit",
    "Intel/zoedepth-nyu-kitti": "mit",
    "vinvino02/glpn-nyu": "apache-2.0",
    "vinvino02/glpn-kitti": "apache-2.0",
    "apple/DepthPro-hf": "apple-amlr",
    "Windsrain/ZeroStereo": "mit",
    "sd2-community/stable-diffusion-2-inpainting": "openrail++",
    "stabilityai/stable-diffusion-2-inpainting": "openrail++",
    "stable-diffusion-v1-5/stable-diffusion-inpainting": "creativeml-openrail-m",
    "madebyollin/taesd": "mit",
    "stabilityai/sd-turbo": "sai-nc-community",
    "stabilityai/sdxl-turbo": "sai-nc-community",
}
KNOWN = {name.lower(): licence for name, licence in LICENCES.items()}
NON_COMMERCIAL = re.compile(r"(^|[-_ ])nc([-_ ]|$)|non-?commercial|research|(^|-)amlr($|-)", re.IGNORECASE)
ALTERNATIVES = {
    "depth": '"depth-anything/Depth-Anything-V2-Small-hf" (apache-2.0), "Intel/zoedepth-nyu-kitti" (mit) or "builtin"',
    "inpaint": '"Windsrain/ZeroStereo" with subfolder "StereoGen" (mit), "sd2-community/stable-diffusion-2-inpainting" (openrail++) '
    'or "builtin"',
}


class NonCommercialModel(ValueError):
    """A model may not be used commercially, and the user asked for models that may."""


def model_record(name: str, revision: str | None = None, subfolder: str = "") -> dict[str, str | None]:
    """What is known of a model: {"id", "revision", "licence"}, plain JSON values. Nothing is downloaded.

    Args:
        name: a Hub id, a local folder, the name of a built-in step, or "stored": whoever packed the depth maps knows their model.
        revision: branch, tag or commit of a Hub id; what is recorded is the commit that it stands for in the local Hub cache, where that
            has it.
        subfolder: where in it the model lies.

    Returns:
        `licence` is what the model card (README.md of the folder, or in the Hub cache) says; without a card what is known of that id, of a
        folder named as one, or of a model that the folder's configuration says it was made from; None where nothing is.
    """
    if name in BUILT_IN:
        return {"id": name, "revision": None, "licence": OWN_LICENCE}
    if name == STORED:
        return {"id": name, "revision": None, "licence": None}
    folder = Path(name) if os.path.isdir(name) else _snapshot(name, revision, subfolder)
    licence = None if folder is None else _card_licence(folder, folder / subfolder)
    if folder is not None and not os.path.isdir(name):
        revision = folder.name
    return {"id": name, "revision": revision, "licence": licence or next(_known_licences(name, subfolder), None)}


def model_records(step: Any) -> list[dict[str, str | None]]:
    """The models behind the stream's `depth` or `inpaint` argument: of a diffusion pipeline also its other autoencoder.

    Args:
        step: a name or path, a DepthNetwork, a DiffusionNetwork, or a callable; of one that `load_depth` or `load_inpainter` made, the
            network's.
    """
    network = getattr(step, "network", step)
    if isinstance(network, DepthNetwork | DiffusionNetwork):
        return [model_record(*model) for model in _models(network)]
    if isinstance(network, str | os.PathLike):
        return [model_record(os.fspath(network))]
    kind = network if hasattr(network, "__qualname__") else type(network)
    own = kind.__module__.partition(".")[0] == __name__.partition(".")[0]
    return [{"id": f"{kind.__module__}.{kind.__qualname__}", "revision": None, "licence": OWN_LICENCE if own else None}]


def _models(step: Any) -> list[tuple[str, str | None, str]]:
    """(name, revision, subfolder) of every model behind a name, a path, a DepthNetwork or a DiffusionNetwork."""
    network = getattr(step, "network", step)
    if isinstance(network, DepthNetwork):
        return [(network.name, network.revision, "")]
    if isinstance(network, DiffusionNetwork):
        other = [] if network.autoencoder is None else [(network.autoencoder, None, "")]
        return [(network.name, network.revision, network.subfolder), *other]
    return [(os.fspath(network), None, "")] if isinstance(network, str | os.PathLike) else []


def fetch_cards(*steps: Any) -> None:
    """Downloads the model cards of Hub ids whose licence is not known here, into the Hub's cache; where that fails they stay unknown.

    Args:
        steps: as `model_records` takes them.
    """
    for name, revision, _ in (model for step in steps for model in _models(step)):
        if name in (*BUILT_IN, STORED) or os.path.isdir(name) or name.lower() in KNOWN:
            continue
        try:
            if try_to_load_from_cache(name, CARD, revision=revision) is None:  # neither there nor known to be missing
                hf_hub_download(name, CARD, revision=revision)
        except (OSError, ValueError, HfHubHTTPError):  # no network, no Hub id, no card: loading the model says what is wrong
            continue


def require_commercial(step: Any, argument: str) -> None:
    """Refuses models that are known to be for non-commercial use alone. A model of which nothing is known passes.

    Args:
        step: as `model_records` takes it.
        argument: which argument of the stream it is: "depth" or "inpaint".

    Raises:
        NonCommercialModel: it names the model, its licence and alternatives.
    """
    for name, revision, subfolder in _models(step):
        said = [model_record(name, revision, subfolder)["licence"], *_known_licences(name, subfolder)]
        refused = next((licence for licence in said if licence is not None and NON_COMMERCIAL.search(licence)), None)
        if refused is not None:
            raise NonCommercialModel(
                f'{argument}="{name}" is under {refused}, which allows no commercial use, and commercial_safe is set. '
                f"Take {ALTERNATIVES[argument]}, or leave commercial_safe out"
            )


def _known_licences(name: str, subfolder: str) -> Iterator[str]:
    """Of a Hub id; of a folder what its name, its place in the Hub's cache and its configurations say that it is, or was made from."""
    if not os.path.isdir(name):
        yield from filter(None, [KNOWN.get(name.lower())])
        return
    parts = Path(os.path.realpath(name)).parts
    cached = [part.removeprefix("models--").replace("--", "/") for part in parts if part.startswith("models--")]
    origins = [KNOWN.get(origin.lower()) for origin in (*cached[-1:], *_origins(Path(name, subfolder)))]
    folders = {part.lower().replace("_", "-") for part in (*parts[-1:], *Path(subfolder).parts)} if not cached else set()
    yield from filter(None, origins)
    yield from (licence for known, licence in KNOWN.items() if known.rpartition("/")[2] in folders)


def _origins(folder: Path) -> Iterator[str]:
    """What the configurations in a folder name as the models that they were loaded from."""
    for path in (folder / "config.json", folder / "model_index.json", *sorted(folder.glob("*/config.json"))):
        try:
            config = json.loads(path.read_text(encoding="utf-8"))
        except (OSError, ValueError):  # not there, or not JSON: loading the model says so
            continue
        if isinstance(config, dict) and isinstance(config.get("_name_or_path"), str):
            yield config["_name_or_path"]


def _card_licence(*folders: Path) -> str | None:
    """Of the first of the folders that has a model card with a licence."""
    for folder in folders:
        card = folder / CARD
        if not card.is_file():
            continue
        try:
            said = metadata_load(card) or {}
        except (ValueError, yaml.YAMLError):  # a card that cannot be read says nothing
            continue
        licence = said.get("license")
        if licence == "other":
            licence = said.get("license_name", licence)
        if licence:
            return ", ".join(map(str, licence)) if isinstance(licence, list) else str(licence)
    return None


def _snapshot(name: str, revision: str | None, subfolder: str) -> Path | None:
    """Where the Hub's cache keeps that revision; its name is the commit."""
    # Of a transformers network or an autoencoder, of a pipeline, and of whatever is not loaded yet.
    for inner in (*(f"{subfolder}/{file}".lstrip("/") for file in ("config.json", "unet/config.json")), CARD):
        try:
            found = try_to_load_from_cache(name, inner, revision=revision)
        except ValueError as error:
            raise ValueError(f'"{name}" is neither a folder nor a Hub id ("owner/name"): {error}') from error
        if isinstance(found, str):
            return Path(found).parents[inner.count("/")]
    return None
