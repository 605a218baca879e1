"""Which models are behind the stream's arguments, and which of them came from the Hub."""

from __future__ import annotations

import os
from typing import Any, NamedTuple

from zsdata.synthesis.depth.options import DepthNetwork
from zsdata.synthesis.inpaint.options import DiffusionNetwork


class Model(NamedTuple):
    """One model behind an argument of the stream."""

    use: str  # "depth", "inpaint" or "autoencoder"
    name: str  # a folder, a Hub id, or the name of a built-in step
    revision: str | None = None  # branch, tag or commit of a Hub id
    subfolder: str = ""  # where in it the model lies


def models_of(step: Any, use: str) -> list[Model]:
    """The models behind the stream's `depth` or `inpaint` argument; of a diffusion pipeline also its other autoencoder.

    Args:
        step: a name or path, a DepthNetwork, a DiffusionNetwork, or what was loaded from them. Of another callable nothing is known.
        use: "depth" or "inpaint".
    """
    network = getattr(step, "pinned", step)
    if isinstance(network, DepthNetwork):
        return [Model(use, network.name, network.revision)]
    if isinstance(network, DiffusionNetwork):
        other = [] if network.autoencoder is None else [Model("autoencoder", network.autoencoder, network.autoencoder_revision)]
        return [Model(use, network.name, network.revision, network.subfolder), *other]
    return [Model(use, os.fspath(network))] if isinstance(network, str | os.PathLike) else []


def hub_models(depth: Any, inpaint: Any = None) -> dict[str, str]:
    """Every model that came from the Hub, as "owner/name@commit", by what it is used for.

    Args:
        depth, inpaint: the stream's arguments of these names, with commits as their revisions.
    """
    models = [*models_of(depth, "depth"), *models_of(inpaint, "inpaint")]
    return {model.use: f"{model.name}@{model.revision}" for model in models if model.revision is not None}  # a folder has none
