"""A place in the stream: all there is to save, and what is checked when it comes back."""

from __future__ import annotations

import reprlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from typing import Any

VERSION = 2
CAUSES = {  # of a difference, by field
    "seed": "the stream's seed differs",
    "manifest": "the photos, their order, the sources or epoch_size differ",
    "configuration": "an option of the stream differs (size, depth, inpaint, disparity, view, augmentation, ...)",
    "models": 'a model has moved on at the Hub; name it as the state does, "owner/name@commit"',
}
_short = reprlib.Repr()
_short.maxstring = 150  # shows "owner/name@commit" whole


@dataclass(frozen=True, kw_only=True)
class Position:
    """Where a stream stands. The same on all ranks; `samples` counts what all ranks together have been given of `epoch`."""

    seed: int
    epoch: int
    samples: int
    manifest: str
    configuration: str
    models: dict[str, str] = field(default_factory=dict)  # those of the Hub: "owner/name@commit" by what they are used for

    def to_state(self) -> dict[str, Any]:
        """Plain JSON."""
        return {"version": VERSION, **asdict(self)}

    @staticmethod
    def from_state(state: Mapping[str, Any], expected: Position, epoch_size: Callable[[int], int] | None = None) -> Position:
        """The place that `state` names, if it belongs to the stream at `expected`.

        Args:
            epoch_size: samples of an epoch, where a place in it can be too far.

        Raises:
            ValueError: where a field is missing, of the wrong kind, or belongs to another stream; it names the field.
        """
        if not isinstance(state, Mapping):
            raise ValueError(f"a stream's state is a dictionary as state_dict() returns it; got {type(state).__name__}")
        if type(state.get("version")) is int and state["version"] != VERSION:
            raise ValueError(f"the state's version is {state['version']}; this zsdata reads version {VERSION}")
        names = {"version", *(one.name for one in fields(Position))}
        if state.keys() != names:
            unknown = _short.repr(sorted(map(str, state.keys() - names)))
            raise ValueError(f"not a stream's state: missing {sorted(names - state.keys())}, unknown {unknown}")
        if type(state["version"]) is not int:
            raise ValueError(f"the state's version is {_short.repr(state['version'])}; this zsdata reads version {VERSION}")
        for name in ("epoch", "samples"):
            if type(state[name]) is not int or not 0 <= state[name] < 2**63:
                raise ValueError(f"the state's {name} must be an integer in 0..2^63 - 1; got {_short.repr(state[name])}")
        for name, cause in CAUSES.items():
            if type(state[name]) is not type(getattr(expected, name)) or state[name] != getattr(expected, name):
                raise ValueError(
                    f"the state's {name} is {_short.repr(state[name])}, this stream's is {getattr(expected, name)!r}: {cause}. "
                    "Open the stream as it was when the state was saved, or start anew without it."
                )
        if epoch_size is not None and state["samples"] > epoch_size(state["epoch"]):
            raise ValueError(f"the state's samples is {state['samples']}, but epoch {state['epoch']} has only {epoch_size(state['epoch'])}")
        return Position(**{name: state[name] for name in names - {"version"}})


def require_one_place(states: Sequence[Mapping[str, Any]]) -> None:
    """Checks that all ranks are about to give out parts of the same batches; to be called where the ranks talk to each other anyway.

    A shard that is cut on one node alone would otherwise give that rank other photos, or fewer batches, and the others would wait for ever.

    Args:
        states: `state_dict()` of every rank's loader, in the order of the ranks.

    Raises:
        ValueError: names the rank and the field that differs from rank 0's.
    """
    for rank, state in enumerate(states):
        for name, value in states[0].items():
            if state.get(name) != value:
                cause = CAUSES.get(name, "they stand at different places; load the same state on all of them")
                raise ValueError(f"rank {rank} differs from rank 0: its {name} is {state.get(name)!r}, not {value!r}: {cause}")
