"""The folder of a training run: whole checkpoints, written beside and renamed, and the newest of them found again.

OUTPUT/checkpoints/step-00000500/model.safetensors    weights under their published names
                                 config.json          which matcher with which options: what `evaluate.py` needs
                                 training.pt          optimizer, schedule and gradient scaler (tensors and numbers only)
                                 state.json           step, place in the stream, the run's arguments
OUTPUT/best/                                          the checkpoint that was judged best, of the same files
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import nn

from trainers.models import save_checkpoint

KEPT_CHECKPOINTS = 3


def save(output: Path, step: int, matcher: nn.Module, config: dict[str, Any], training: dict[str, Any], state: dict[str, Any]) -> Path:
    """Writes the checkpoint of `step` as a whole or not at all; older ones but the last few are removed afterwards."""

    def weights(folder: Path) -> None:
        save_checkpoint(matcher, folder / "model.safetensors")
        (folder / "config.json").write_text(json.dumps(config, indent=2) + "\n")

    return write(output, step, weights, training, state)


def write(output: Path, step: int, weights: Callable[[Path], None], training: dict[str, Any], state: dict[str, Any]) -> Path:
    """As `save`, for any network: `weights(folder)` writes its files."""
    folder = output / "checkpoints" / f"step-{step:08d}"
    unfinished = folder.with_name(f".{folder.name}.{os.getpid()}")
    unfinished.mkdir(parents=True)
    try:
        weights(unfinished)
        torch.save(training, unfinished / "training.pt")
        (unfinished / "state.json").write_text(json.dumps({"step": step, **state}, indent=2) + "\n")
        if folder.exists():
            shutil.rmtree(folder)
        os.replace(unfinished, folder)
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)
    for old in _whole(output)[:-KEPT_CHECKPOINTS]:
        shutil.rmtree(old)
    return folder


def keep_best(checkpoint: Path, output: Path) -> Path:
    """Copies a checkpoint to OUTPUT/best, in the place of an earlier best, as a whole."""
    best = output / "best"
    unfinished = output / f".best.{os.getpid()}"
    try:
        shutil.copytree(checkpoint, unfinished)
        if best.exists():
            shutil.rmtree(best)
        os.replace(unfinished, best)
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)
    return best


def restore_best(checkpoint: Path, output: Path, step: int) -> bool:
    """Makes OUTPUT/best the checkpoint of `step`, which was the best when `checkpoint` was saved.

    The run may have stopped before it was copied, or be resumed into another folder. False where that checkpoint is no longer there.
    """
    best = output / "best"
    for folder in (best, checkpoint, checkpoint.parent.parent / "best"):
        if (folder / "state.json").is_file() and json.loads((folder / "state.json").read_text())["step"] == step:
            if folder != best:
                keep_best(folder, output)
            return True
    return False


def newest(path: Path) -> Path:
    """The checkpoint to resume from: `path` itself, or the newest one of the run in `path`.

    Raises:
        FileNotFoundError: there is none.
    """
    if (path / "state.json").is_file():
        return path
    checkpoints = _whole(path)
    if not checkpoints:
        raise FileNotFoundError(
            f"no checkpoint to resume from in {path}; give --resume the --output folder of a run or one of its checkpoints"
        )
    return checkpoints[-1]


def load(checkpoint: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """(training, state) of a checkpoint, as they were given to `save`; weights are loaded by `trainers.models.load_checkpoint`."""
    training = torch.load(checkpoint / "training.pt", map_location="cpu", weights_only=True)
    return training, json.loads((checkpoint / "state.json").read_text())


def _whole(output: Path) -> list[Path]:
    return sorted(path for path in (output / "checkpoints").glob("step-*") if (path / "state.json").is_file())
