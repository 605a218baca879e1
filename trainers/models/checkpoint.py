"""Weights on disk: published checkpoints and our own, loaded whole or not at all."""

from __future__ import annotations

from collections import defaultdict
from os import PathLike
from pathlib import Path
from pickle import UnpicklingError

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

# What DataParallel and DistributedDataParallel put before every name; the published .pth files carry it.
WRAPPER_PREFIX = "module."
WEIGHTS_FILE = "model.safetensors"  # in the folder of a checkpoint


def load_checkpoint(matcher: nn.Module, path: str | PathLike[str]) -> None:
    """Loads every weight of `matcher` from a .safetensors file, or a .pth (.pt, .ckpt) file that holds nothing but tensors.

    A name may lack if it is one of several for the same tensor and another one is there: safetensors files that Accelerate
    writes keep only one.

    Raises:
        FileNotFoundError: no such file.
        ValueError: a file of another kind, or weights of another network or other options; says what is missing, left over or
            of another shape. The matcher is then as it was.
    """
    path = Path(path)
    weights = read_weights(path)
    expected = matcher.state_dict(keep_vars=True)
    for names in _names_of_one_tensor(expected):
        present = [name for name in names if name in weights]
        if present:
            weights.update({name: weights[present[-1]] for name in names if name not in weights})
    missing = [name for name in expected if name not in weights]
    left_over = [name for name in weights if name not in expected]
    shapes = [
        f"{name} {list(weights[name].shape)} instead of {list(tensor.shape)}"
        for name, tensor in expected.items()
        if name in weights and weights[name].shape != tensor.shape
    ]
    if missing or left_over or shapes:
        lists = (("missing", missing), ("left over", left_over), ("of another shape", shapes))
        found = "; ".join(f"{len(names)} {kind}: {some(names)}" for kind, names in lists if names)
        raise ValueError(
            f"{path} does not fit {type(matcher).__name__} with these options ({found}); "
            "build the matcher with the options it was trained with"
        )
    matcher.load_state_dict(weights)


def save_checkpoint(matcher: nn.Module, path: str | PathLike[str]) -> None:
    """Writes all weights to a .safetensors file under the names of `state_dict()`; shared ones under each of their names."""
    save_file({name: tensor.detach().cpu().clone().contiguous() for name, tensor in matcher.state_dict().items()}, path)


def read_weights(path: Path) -> dict[str, Tensor]:
    """The tensors of a .safetensors or .pth file by name, without the prefix of a wrapper; errors as for `load_checkpoint`."""
    if not path.is_file():
        raise FileNotFoundError(f"no checkpoint file {path}")
    if path.suffix not in (".safetensors", ".pth", ".pt", ".ckpt"):
        raise ValueError(f"a checkpoint is a .safetensors or .pth file; got {path}")
    try:
        weights = load_file(path) if path.suffix == ".safetensors" else torch.load(path, map_location="cpu", weights_only=True)
    except UnpicklingError as error:
        raise ValueError(f"{path} is no file of torch.save, or holds more than tensors and is not opened: it could run code") from error
    except (SafetensorError, RuntimeError, EOFError) as error:
        raise ValueError(f"{path} is damaged: {error}") from error
    if not isinstance(weights, dict) or not all(isinstance(value, Tensor) for value in weights.values()):
        raise ValueError(f"{path} is not a dictionary of tensors; save the model's state_dict() alone")
    if all(name.startswith(WRAPPER_PREFIX) for name in weights):
        return {name.removeprefix(WRAPPER_PREFIX): tensor for name, tensor in weights.items()}
    return dict(weights)


def _names_of_one_tensor(state: dict[str, Tensor]) -> list[list[str]]:
    names = defaultdict(list)
    for name, tensor in state.items():
        names[id(tensor)].append(name)
    return [group for group in names.values() if len(group) > 1]


def some(names: list[str], at_most: int = 8) -> str:
    """The first of the names, and how many more there are."""
    rest = len(names) - at_most
    return ", ".join(names[:at_most]) + (f" and {rest} more" if rest > 0 else "")
