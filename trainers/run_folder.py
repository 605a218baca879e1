"""The folder of a training run: whole checkpoints, written beside and renamed, and the newest of them found again.

OUTPUT/checkpoints/step-00000500/model.safetensors    weights under their published names
                                 config.json          which matcher with which options: what `evaluate.py` needs
                                 training.pt          optimizer, schedule and gradient scaler (tensors and numbers only)
                                 state.json           step, place in the stream, the run's arguments
OUTPUT/best/                                          the checkpoint that was judged best, of the same files

A folder belongs to one run: `check_output` refuses another one's, and `claimed` one that is still at work, so that what `write` removes is
always the run's own.
"""

from __future__ import annotations

import errno
import fcntl
import json
import math
import os
import shutil
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from pickle import UnpicklingError
from typing import Any

import torch
from safetensors import SafetensorError
from torch import nn

from trainers.models import save_checkpoint
from trainers.models.checkpoint import WEIGHTS_FILE
from zsdata.launch import launched_as
from zsdata.source.writing import writing

KEPT_CHECKPOINTS = 3
LOCK = ".lock"  # in the output; names the process that holds it
LOCK_SECONDS = 10.0  # the most that a run waits for another one to end, such as one that was killed a moment ago
HIDDEN = ".unfinished"  # ends the names of folders that are being written or removed; what a killed run leaves of them is no checkpoint


def check_output(output: Path, resume: Path | None) -> Path | None:
    """The checkpoint to go on from; None where the run begins. Refuses an output with checkpoints other than those that it goes on from.

    A run that is to resume from its own output, in which there is no checkpoint yet, begins: the command that a cluster repeats need not
    know which time it is. To be called before anything slow, and before any rank may have written its first checkpoint.

    Raises:
        FileExistsError: there are such checkpoints; names them and the way out.
        NotADirectoryError: the output is a file.
        FileNotFoundError: no checkpoint to resume from.
    """
    if output.exists() and not output.is_dir():
        raise NotADirectoryError(f"--output {output} is a file; name a folder")
    if resume is not None and resume.resolve() == output.resolve() and not _whole(output):
        resume = None
    start = None if resume is None else newest(resume)
    there = [*_whole(output), *([output / "best"] if _is_whole(output / "best") else [])]
    if not there:
        return start
    last = max(there, key=_step)
    if start is None:
        source = output if _whole(output) else last
        raise FileExistsError(
            f"{output} holds the checkpoints of an earlier run, up to step {_step(last)}: --resume {source} goes on with it; "
            "or give another --output"
        )
    if not start.resolve().is_relative_to(output.resolve()):
        raise FileExistsError(
            f"{output} holds the checkpoints of another run than {start}, up to step {_step(last)}: --resume {output} goes on with "
            "that one; or give another --output"
        )
    if _step(start) < _step(last):
        raise FileExistsError(
            f"{output} holds a later checkpoint than {start}: {last}, of step {_step(last)}. Give another --output, or move the later ones "
            f"away; --resume {output} goes on from the last one"
        )
    return start


@contextmanager
def claimed(output: Path) -> Iterator[None]:
    """Makes the folder, and keeps other runs out of it; on the first rank, for all. On file systems without locks it keeps nobody out.

    Raises:
        BlockingIOError: another run is at work there; names its process.
    """
    output.mkdir(parents=True, exist_ok=True)
    rank, _ = launched_as()
    if rank:
        yield
        return
    with (output / LOCK).open("a+") as file:
        give_up = time.monotonic() + LOCK_SECONDS
        while not _lock(file.fileno()):
            if time.monotonic() > give_up:
                file.seek(0)
                raise BlockingIOError(
                    f"another run is at work in {output}, {file.read().strip() or 'of a process that is not known'}: stop it first, or "
                    "give another --output"
                )
            time.sleep(0.1)
        try:
            file.truncate(0)
            file.write(f"process {os.getpid()} on {socket.gethostname()}")
            file.flush()
            yield
        finally:
            with suppress(OSError):  # where there are no locks
                fcntl.flock(file, fcntl.LOCK_UN)  # closing is not enough: a process forked meanwhile has the file open too


def save(output: Path, step: int, matcher: nn.Module, config: dict[str, Any], training: dict[str, Any], state: dict[str, Any]) -> Path:
    """Writes the checkpoint of `step` as a whole or not at all; older ones but the last few are removed afterwards."""

    def weights(folder: Path) -> None:
        save_checkpoint(matcher, folder / WEIGHTS_FILE)
        (folder / "config.json").write_text(json.dumps(config, indent=2) + "\n")

    return write(output, step, weights, training, state)


def write(output: Path, step: int, weights: Callable[[Path], None], training: dict[str, Any], state: dict[str, Any]) -> Path:
    """As `save`, for any network: `weights(folder)` writes its files."""
    folder = folder_of(output, step)
    folder.parent.mkdir(parents=True, exist_ok=True)

    def fill(unfinished: Path) -> None:
        unfinished.mkdir()
        weights(unfinished)
        torch.save(training, unfinished / "training.pt")
        (unfinished / "state.json").write_text(json.dumps({"step": step, **state}, indent=2) + "\n")

    _replace(folder, fill)
    others = [path for path in _whole(output) if path != folder]
    for old in others[: -(KEPT_CHECKPOINTS - 1)]:
        shutil.rmtree(_hide(old))
    return folder


def amend(checkpoint: Path, **state: Any) -> None:
    """Writes what was found out about a checkpoint into its state.json, in the place of what it says there; as a whole or not at all."""
    file = checkpoint / "state.json"
    unfinished = checkpoint / f".state.json{HIDDEN}"
    unfinished.write_text(json.dumps({**_state(checkpoint), **state}, indent=2) + "\n")
    _flush(unfinished)
    os.replace(unfinished, file)
    _flush(checkpoint)


def folder_of(output: Path, step: int) -> Path:
    """The folder of the checkpoint of `step`."""
    return output / "checkpoints" / f"step-{step:08d}"


def keep_best(checkpoint: Path, output: Path) -> Path:
    """Copies a checkpoint to OUTPUT/best, in the place of an earlier best, as a whole."""
    return _replace(output / "best", lambda unfinished: shutil.copytree(checkpoint, unfinished))


def restore_best(checkpoint: Path, output: Path, step: int) -> bool:
    """Makes OUTPUT/best the checkpoint of `step`, which was the best when `checkpoint` was saved.

    The run may have stopped before it was copied, or be resumed into another folder. False where that checkpoint is no longer there.
    """
    best = output / "best"
    for folder in (best, checkpoint, checkpoint.with_name(folder_of(output, step).name), checkpoint.parent.parent / "best"):
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
    if _is_whole(path):
        return path
    checkpoints = _whole(path)
    if not checkpoints:
        raise FileNotFoundError(
            f"no checkpoint to resume from in {path}; give --resume the --output folder of a run or one of its checkpoints"
        )
    return checkpoints[-1]


def load(checkpoint: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """(training, state) of a checkpoint, as they were given to `save`; weights are loaded by `trainers.models.load_checkpoint`.

    Raises:
        ValueError: a file of it is damaged; names it.
        OSError: it is missing.
    """
    file = checkpoint / "training.pt"
    try:
        training = torch.load(file, map_location="cpu", weights_only=True)
    except (EOFError, RuntimeError, UnpicklingError) as error:
        raise ValueError(
            f"{file} is damaged: it is cut off, or holds more than tensors and numbers; resume from another checkpoint"
        ) from error
    return training, _state(checkpoint)


def require_options(checkpoint: Path, state: dict[str, Any], options: dict[str, Any], weights: str) -> None:
    """Checks that a run is resumed with what cannot change on its way, and would be left out or mixed without a word.

    Args:
        state: of the checkpoint; has the options that its run was begun with under "options".
        options: of this run, in plain JSON; "model" is what is trained.
        weights: how a new run starts from this checkpoint's weights.

    Raises:
        ValueError: names the option that differs, what it was and what it is.
    """
    begun = state.get("options")
    if begun is None:
        raise ValueError(
            f"{checkpoint} does not tell what its run was begun with: an earlier version wrote it; start a new run with {weights}"
        )
    if begun["model"] != options["model"]:
        raise ValueError(f"{checkpoint} is of a run that trains {begun['model']}; this one trains {options['model']}")
    for name in {**begun, **options}:
        if begun.get(name) != options.get(name):
            raise ValueError(
                f"{checkpoint} is of a run with {name} {begun.get(name)}, this one has {options.get(name)}; resume it as it was begun, "
                f"or start a new run with {weights}"
            )


def append(path: Path, values: dict[str, Any]) -> None:
    """One more line of JSON; what is not finite, which JSON does not know, is null."""
    finite = {name: None if isinstance(value, float) and not math.isfinite(value) else value for name, value in values.items()}
    with writing(path), path.open("a") as file:
        file.write(json.dumps(finite) + "\n")


def _replace(folder: Path, fill: Callable[[Path], Any]) -> Path:
    """Puts a new folder, which `fill` fills, in the place of `folder`. At any moment there is the old one, none, or the new one, whole.

    Killed in between, it leaves hidden folders behind, which the next call removes: one run at a time writes to a folder.

    Raises:
        OSError: it cannot be written; names it, and how much room there is.
    """
    for left in folder.parent.glob(f".*{HIDDEN}"):
        shutil.rmtree(left)
    unfinished = folder.with_name(f".{folder.name}{HIDDEN}")
    try:
        fill(unfinished)
        for path in [*unfinished.rglob("*"), unfinished]:
            _flush(path)
        before = _hide(folder) if folder.exists() else None
        os.replace(unfinished, folder)
        _flush(folder.parent)
    except (OSError, RuntimeError, SafetensorError) as error:  # a full disk is a riddle in torch's words, or in those of safetensors
        free_mb = shutil.disk_usage(folder.parent).free // 10**6
        raise OSError(
            f"{folder} could not be written, with {free_mb:,} MB free on its disk: {error}. "
            "Earlier checkpoints are whole; make room (a quota counts, too), and --resume goes on from the last one"
        ) from error
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)
    if before is not None:
        shutil.rmtree(before)
    return folder


def _lock(descriptor: int) -> bool:
    """Whether nobody else has the lock; True where there are no locks."""
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        return error.errno not in (errno.EWOULDBLOCK, errno.EACCES)
    return True


def _hide(folder: Path) -> Path:
    """Out of sight, to be removed: half a checkpoint must not look like one."""
    hidden = folder.with_name(f".{folder.name}.old{HIDDEN}")
    os.replace(folder, hidden)
    return hidden


def _flush(path: Path) -> None:
    """To the disk: after a power failure a name may be there without its bytes."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _state(checkpoint: Path) -> dict[str, Any]:
    file = checkpoint / "state.json"
    try:
        state = json.loads(file.read_text())
        return {"step": int(state["step"]), **state}
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{file} is damaged: {error!r}; resume from another checkpoint") from error


def _step(checkpoint: Path) -> int:
    return _state(checkpoint)["step"]


def _is_whole(checkpoint: Path) -> bool:
    return (checkpoint / "state.json").is_file()


def _whole(output: Path) -> list[Path]:
    return sorted(path for path in (output / "checkpoints").glob("step-*") if _is_whole(path))
