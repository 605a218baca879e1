"""The matchers that are trained, by name."""

from __future__ import annotations

import inspect
from typing import Any

from trainers.models.checkpoint import load_checkpoint, save_checkpoint
from trainers.models.matcher import Matcher
from trainers.models.raft_stereo import RAFTStereo

__all__ = ["MATCHERS", "Matcher", "load_checkpoint", "load_matcher", "save_checkpoint"]

MATCHERS: dict[str, type[Matcher]] = {"raft_stereo": RAFTStereo}


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
