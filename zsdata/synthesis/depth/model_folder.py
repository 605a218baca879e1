"""The weights of a local folder in the transformers format: whether they are there and whole, as far as it shows without loading them."""

from __future__ import annotations

import json
from pathlib import Path

from safetensors import SafetensorError, safe_open

WEIGHTS = (
    "model.safetensors",
    "model.safetensors.index.json",
    "pytorch_model.bin",
    "pytorch_model.bin.index.json",
)  # as transformers looks
LFS_POINTER = b"version https://git-lfs"


def check_weights(folder: str) -> None:
    """Says what is wrong with the weights of a folder before a worker finds it.

    Raises:
        FileNotFoundError: there are no weights, or a part of them is missing.
        ValueError: a file is a Git LFS pointer, or not whole.
    """
    found = next((name for name in WEIGHTS if Path(folder, name).is_file()), None)
    if found is None:
        raise FileNotFoundError(f'depth="{folder}" holds no weights: {WEIGHTS[0]} is missing; download the folder again')
    for name in _parts(folder, found):
        path = Path(folder, name)
        if not path.is_file():
            raise FileNotFoundError(f'depth="{folder}" lacks {name}, which {found} names; download it again')
        with path.open("rb") as file:
            begin = file.read(len(LFS_POINTER))
        if begin == LFS_POINTER:
            raise ValueError(f'depth="{folder}": {name} is a Git LFS pointer, not the weights; fetch them: git lfs pull')
        if not begin:
            raise ValueError(f'depth="{folder}": {name} is empty; download it again')
        if name.endswith(".safetensors"):
            try:
                with safe_open(path, framework="pt"):
                    pass
            except SafetensorError as error:
                raise ValueError(
                    f'depth="{folder}": {name} is no whole safetensors file ({path.stat().st_size:,} bytes: {error}); download it again'
                ) from error


def _parts(folder: str, found: str) -> list[str]:
    """The files that hold the weights."""
    if not found.endswith(".json"):
        return [found]
    try:
        return sorted(set(json.loads(Path(folder, found).read_text(encoding="utf-8"))["weight_map"].values()))
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise ValueError(f'depth="{folder}": {found} is no index of weights ({error}); download it again') from error
