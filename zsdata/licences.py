"""Which models took part, at which revision, under which licence; and which of them a commercial user must not take.

What is said here is what the model cards say, as far as they are at hand: a record for the user, not legal advice.
"""

from __future__ import annotations

import json
import logging
import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml
from huggingface_hub import hf_hub_download, metadata_load, try_to_load_from_cache
from huggingface_hub.errors import HfHubHTTPError

from zsdata.hub import Model, models_of
from zsdata.synthesis.depth.options import STORED

logger = logging.getLogger("zsdata")

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
NON_COMMERCIAL = re.compile(r"(?<![a-z0-9])(nc|amlr)(?![a-z])|non[-_ ]?commercial|research", re.IGNORECASE)
NON_COMMERCIAL_LINK = re.compile(r"by-nc(?![a-z])|non[-_]?commercial", re.IGNORECASE)  # not "research": it may be who wrote the licence
SILENT = ("", "other", "unknown")  # what a card says where it does not say the licence
ALTERNATIVES = {
    "depth": '"depth-anything/Depth-Anything-V2-Small-hf" (apache-2.0), "Intel/zoedepth-nyu-kitti" (mit) or "builtin"',
    "inpaint": '"Windsrain/ZeroStereo" with subfolder "StereoGen" (mit), "sd2-community/stable-diffusion-2-inpainting" (openrail++) '
    'or "builtin"',
    "autoencoder": '"madebyollin/taesd" (mit), or the pipeline\'s own',
}


_told: set[Model] = set()  # models that were warned of, in this process


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
        `licence` is what the model card (README.md of the folder, or in the Hub cache) says; where it says nothing what is known of that
        id, of a folder named as one, or of a model that the card or a configuration says it was made from, a non-commercial licence before
        others; None where nothing is. A card's "other" stays unless what is known is non-commercial.
    """
    if name in BUILT_IN:
        return {"id": name, "revision": None, "licence": OWN_LICENCE}
    if name == STORED:
        return {"id": name, "revision": None, "licence": None}
    folder = _folder(name, revision, subfolder)
    licence = min(_card_licences(folder, subfolder), key=_silent, default=None)
    if _silent(licence):
        known = [LICENCES[model] for model, _ in _known_models(name, folder, subfolder)]
        licence = next(filter(NON_COMMERCIAL.search, known), licence or next(iter(known), None))
    if folder is not None and not os.path.isdir(name):
        revision = folder.name
    return {"id": name, "revision": revision, "licence": licence}


def model_records(step: Any) -> list[dict[str, str | None]]:
    """The models behind the stream's `depth` or `inpaint` argument: of a diffusion pipeline also its other autoencoder.

    Args:
        step: a name or path, a DepthNetwork, a DiffusionNetwork, or a callable; of one that `load_depth` or `load_inpainter` made, the
            network's.
    """
    if models := models_of(step, ""):
        return [model_record(model.name, model.revision, model.subfolder) for model in models]
    kind = step if hasattr(step, "__qualname__") else type(step)
    own = kind.__module__.partition(".")[0] == __name__.partition(".")[0]
    return [{"id": f"{kind.__module__}.{kind.__qualname__}", "revision": None, "licence": OWN_LICENCE if own else None}]


def fetch_cards(*steps: Any) -> None:
    """Downloads the model cards of Hub ids whose licence is not known here, into the Hub's cache; where that fails they stay unknown.

    Args:
        steps: as `model_records` takes them.
    """
    for _, name, revision, _ in (model for step in steps for model in models_of(step, "")):
        if name in (*BUILT_IN, STORED) or os.path.isdir(name) or name.lower() in KNOWN:
            continue
        try:
            if try_to_load_from_cache(name, CARD, revision=revision) is None:  # neither there nor known to be missing
                hf_hub_download(name, CARD, revision=revision)
        except (OSError, ValueError, HfHubHTTPError):  # no network, no Hub id, no card: loading the model says what is wrong
            continue


def require_commercial(step: Any, argument: str) -> None:
    """Refuses models that are known to be for non-commercial use alone. One of which nothing is known passes.

    Args:
        step: as `model_records` takes it.
        argument: which argument of the stream it is: "depth" or "inpaint".

    Raises:
        NonCommercialModel: it names the model, its licence and alternatives.
    """
    for model in models_of(step, argument):
        for licence, reason in _licences(model.name, model.revision, model.subfolder):
            if NON_COMMERCIAL.search(licence):
                raise NonCommercialModel(
                    f'{model.use}="{model.name}" is under {licence}{reason}, which allows no commercial use, and commercial_safe is set. '
                    f"Take {ALTERNATIVES[model.use]}, or leave commercial_safe out"
                )


def warn_of_unknown_licences(step: Any, argument: str) -> None:
    """Says once of each model, in a process, that `require_commercial` could not judge it, as nothing tells its licence."""
    for model in models_of(step, argument):
        if _silent(model_record(model.name, model.revision, model.subfolder)["licence"]) and model not in _told:
            _told.add(model)
            logger.warning(
                'the licence of %s="%s" is not known, so commercial_safe cannot judge it; look it up where the model comes from',
                model.use,
                model.name,
            )


def _licences(name: str, revision: str | None, subfolder: str) -> Iterator[tuple[str, str]]:
    """(licence, why it is thought to be that one) for all that is said of a model: by its cards, then by what it is or comes from."""
    if name in (*BUILT_IN, STORED):
        return
    folder = _folder(name, revision, subfolder)
    yield from ((licence, "") for licence in _card_licences(folder, subfolder))
    for model, evidence in _known_models(name, folder, subfolder):
        yield LICENCES[model], f" (by its {evidence} it is or comes from {model})" if evidence else ""


def _known_models(name: str, folder: Path | None, subfolder: str) -> Iterator[tuple[str, str]]:
    """(known model, what says so): a Hub id itself, and what its folders' names, cards and configurations say that it is or comes from."""
    if os.path.isdir(name):
        paths = [(path, "folder's name") for path in dict.fromkeys((os.path.abspath(name), os.path.realpath(name)))]
    else:
        paths = []
        yield from ((known, "") for known in LICENCES if _plain(known) == _plain(name))
    paths += [(part, "subfolder's name") for part in Path(subfolder).parts]
    paths += [] if folder is None else _origins(folder, subfolder)
    yield from ((known, evidence) for path, evidence in paths if (known := _named_after(path)) is not None)


def _named_after(path: str) -> str | None:
    """The known model that a Hub id or path is named as: by its place in the Hub's cache, or by its last parts, with or without the owner.

    A name that only begins as a known one ("sd-turbo-local"), or a folder around it ("sd-turbo/snapshots/abc"), can forbid but not allow.
    """
    parts = Path(path).parts
    cached = [_plain(part.removeprefix("models--")) for part in parts if part.startswith("models--")]
    if cached:
        return next((known for known in LICENCES if _plain(known) == cached[-1]), None)
    names = {_plain(form): known for known in LICENCES for form in (known, known.rpartition("/")[2])}
    for above, part in enumerate(reversed(parts[-3:])):  # further up they are projects and disks, not models
        said = (_plain(part), _plain(part.rpartition("--")[2]))
        found = [name for name in names if name in said or (above == 0 and any(form.startswith(f"{name}-") for form in said))]
        if found:
            name = max(found, key=len)
            sure = above == 0 and name in said
            return names[name] if sure or NON_COMMERCIAL.search(LICENCES[names[name]]) else None
    return None


def _plain(name: str) -> str:
    """A model's name as names are compared: "Depth_Anything-V2-Large-hf" and "depth-anything-v2-large" are one."""
    return re.sub("[^a-z0-9]+", "-", name.lower()).strip("-").removesuffix("-hf")


def _origins(folder: Path, subfolder: str) -> Iterator[tuple[str, str]]:
    """What the cards and configurations in a folder name as the models that these were made or loaded from, and which of them does."""
    for card in _cards(folder, subfolder):
        yield from ((base, "model card") for base in _texts(card.get("base_model")))
    inner = folder / subfolder
    for path in (inner / "config.json", inner / "model_index.json", *sorted(inner.glob("*/config.json"))):
        try:
            config = json.loads(path.read_text(encoding="utf-8"))
        except (OSError, ValueError):  # not there, or not JSON: loading the model says so
            continue
        if isinstance(config, dict) and isinstance(config.get("_name_or_path"), str):
            yield config["_name_or_path"], path.name


def _card_licences(folder: Path | None, subfolder: str) -> Iterator[str]:
    """Of each model card that names a licence; with its link where only that says that it is non-commercial."""
    for card in _cards(folder, subfolder):
        licence = ", ".join(_texts(card.get("license")))
        if _silent(licence):
            licence = ", ".join(_texts(card.get("license_name"))) or licence
            links = [f"({link})" for link in _texts(card.get("license_link")) if NON_COMMERCIAL_LINK.search(link)]
            licence = " ".join([licence or "other", *links]) if links else licence
        if licence:
            yield licence


def _cards(folder: Path | None, subfolder: str) -> Iterator[dict[str, Any]]:
    """What the model cards say that lie in a folder and in its subfolder."""
    for place in () if folder is None else dict.fromkeys((folder, folder / subfolder)):
        card = place / CARD
        if not card.is_file():
            continue
        try:
            yield metadata_load(card) or {}
        except (ValueError, yaml.YAMLError):  # a card that cannot be read says nothing
            continue


def _texts(entry: Any) -> list[str]:
    """An entry of a card, which may be missing, one value or several."""
    return [str(value) for value in (entry if isinstance(entry, list) else [entry]) if value]


def _silent(licence: str | None) -> bool:
    return licence is None or licence.lower() in SILENT


def _folder(name: str, revision: str | None, subfolder: str) -> Path | None:
    return Path(name) if os.path.isdir(name) else _snapshot(name, revision, subfolder)


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
