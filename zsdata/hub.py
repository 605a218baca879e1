"""Models of the Hub, by the commit that they were taken at."""

from __future__ import annotations

from typing import Any

from zsdata.synthesis.depth.options import DepthNetwork
from zsdata.synthesis.inpaint.options import DiffusionNetwork


def hub_models(depth: Any, inpaint: Any = None) -> dict[str, str]:
    """Every model that came from the Hub, as "owner/name@commit", by what it is used for.

    Args:
        depth, inpaint: the stream's arguments of these names; networks with their commit as the revision, or loaded.
    """
    depth, inpaint = (getattr(step, "pinned", step) for step in (depth, inpaint))
    models = dict[str, tuple[str | None, str | None]]()
    if isinstance(depth, DepthNetwork):
        models["depth"] = depth.name, depth.revision
    if isinstance(inpaint, DiffusionNetwork):
        models["inpaint"] = inpaint.name, inpaint.revision
        models["autoencoder"] = inpaint.autoencoder, inpaint.autoencoder_revision
    return {use: f"{name}@{commit}" for use, (name, commit) in models.items() if commit is not None}  # a folder has none
