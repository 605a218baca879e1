"""The matchers that are trained, by name."""

from __future__ import annotations

import inspect
import json
from os import PathLike
from pathlib import Path
from typing import Any

from trainers.models.checkpoint import WEIGHTS_FILE, load_checkpoint, save_checkpoint
from trainers.models.igev_stereo import IGEVStereo
from trainers.models.matcher import Matcher
from trainers.models.raft_stereo import RAFTStereo

__all__ = ["MATCHERS", "Matcher", "load_checkpoint", "load_matcher", "load_trained", "save_checkpoint"]

MATCHERS: dict[str, type[Matcher]] = {"raft_stereo": RAFTStereo, "igev_stereo": IGEVStereo}


def load_matcher(name: str, **options: Any) -> Matcher:
    """A matcher with fresh weights.

    Args:
        name: a key of MATCHERS.
        options: the published ones, with the published defaults; see the class.
    Raises:
        ValueError, TypeError: an unknown name or option, or a value out of range; says the choices.
    """
    if name not in MATCHERS:
        raise ValueError(f"no matcher is called {name!r}; there is {', '.join(MATCHERS)}")
    known = list(inspect.signature(MATCHERS[name]).parameters)
    unknown = sorted(set(options) - set(known))
    if unknown:
        raise TypeError(f"{name} has no option {', '.join(unknown)}; it has {', '.join(known)}")
    return MATCHERS[name](**options)


def load_trained(path: str | PathLike[str], name: str, **options: Any) -> Matcher:
    """A matcher with the weights of a checkpoint.

    Args:
        path: a .pth or .safetensors file, which does not know its options; or a folder with model.safetensors and config.json
            ({"model": name, "options": {...}}), as the trainers write it.
        name: a key of MATCHERS; a folder must hold that one.
        options: as for `load_matcher`; they go before those of config.json.
    Raises:
        FileNotFoundError, ValueError, TypeError: naming the file and what does not fit.
    """
    path = Path(path)
    if not path.is_dir():
        matcher = load_matcher(name, **options)
        load_checkpoint(matcher, path)
        return matcher
    description = path / "config.json"
    if not description.is_file():
        raise FileNotFoundError(
            f"no {description}; a checkpoint folder holds model.safetensors and config.json, as RUN/checkpoints/step-... do"
        )
    try:
        config = json.loads(description.read_text())
        trained, trained_options = config["model"], dict(config["options"])
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f'{description} is to hold {{"model": name, "options": {{...}}}}: {error!r}') from error
    if trained != name:
        raise ValueError(f"{path} holds a {trained}, not a {name}")
    matcher = load_matcher(name, **(trained_options | options))
    load_checkpoint(matcher, path / WEIGHTS_FILE)
    return matcher
