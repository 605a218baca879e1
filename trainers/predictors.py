"""What can be judged, by name: the matchers here, OpenCV's SGBM, or anybody's callable by its import path."""

from __future__ import annotations

import importlib
import inspect
import os
import sys
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from trainers.models import MATCHERS, load_trained
from trainers.sgbm import sgbm
from trainers.strips import Predict, in_strips

MODELS = {name.removesuffix("_stereo"): name for name in MATCHERS}
PRECISIONS = {"no": None, "bf16": torch.bfloat16, "fp16": torch.float16}
TAKES = ("torch", "numpy")


def find_predictor(
    model: str,
    *,
    checkpoint: Path | None = None,
    options: dict[str, Any] | None = None,
    iterations: int = 32,
    device: str | torch.device = "cpu",
    mixed_precision: str = "no",
    takes: str = "torch",
    tile_rows: int | None = None,
) -> Predict:
    """A function (left, right) -> disparity, as `trainers.evaluate.evaluate` takes it.

    Args:
        model: a key of MODELS, "sgbm", or "package.module:callable", see `foreign_predictor`.
        checkpoint, options, iterations: of a matcher from MODELS, see `trainers.models.load_trained`.
        mixed_precision: a key of PRECISIONS: runs networks under autocast.
        takes: "torch" or "numpy", what a callable of somebody else's takes.
        tile_rows: matches in strips of so many rows, see `trainers.strips`.
    Raises:
        ValueError, TypeError, FileNotFoundError, ImportError: naming what does not fit.
    """
    predict: Predict
    if model in MODELS:
        predict = _trained(model, checkpoint, options or {}, iterations, device)
    elif checkpoint is not None or options:
        raise ValueError(f"--model {model} has no weights of ours: leave out --checkpoint and the matcher's options")
    elif model == "sgbm":
        if mixed_precision != "no":
            raise ValueError("--model sgbm is no network: leave out --mixed-precision")
        predict = sgbm
    else:
        predict = foreign_predictor(model, takes, device)
    dtype = PRECISIONS[mixed_precision]
    if dtype is not None:
        predict = _under_autocast(predict, dtype)
    return predict if tile_rows is None else in_strips(predict, tile_rows)


def foreign_predictor(path: str, takes: str = "torch", device: str | torch.device = "cpu") -> Predict:
    """The predictor behind "package.module:callable", imported from the current folder or the installed packages.

    The callable is called once a pair, without gradients, as callable(left, right), and returns the left view's disparity [H, W],
    [1, H, W] or [1, 1, H, W], in pixels, positive, as a tensor or an array. The images are unpadded RGB:

        takes="torch": float32 [1, 3, H, W], 0..255, on `device`. A torch module is moved there and put into evaluation mode.
        takes="numpy": uint8 [H, W, 3].

    Raises:
        ValueError, ImportError, TypeError: the path leads to no callable; or, when called, what comes back is no disparity.
    """
    if takes not in TAKES:
        raise ValueError(f"a model takes {' or '.join(TAKES)}; got {takes}")
    function = _import(path)
    if isinstance(function, nn.Module):
        function = function.to(device).eval()

    @torch.no_grad()
    def predict(left: Tensor, right: Tensor) -> Tensor:
        images = [left, right]
        if takes == "numpy":
            images = [image[0].permute(1, 2, 0).cpu().numpy().astype(np.uint8) for image in images]
        try:
            output = function(*images)
        except (torch.OutOfMemoryError, MemoryError):
            raise
        except Exception as error:
            raise RuntimeError(f"{path} failed on images of {left.shape[-1]} x {left.shape[-2]} px: {error!r}") from error
        if not isinstance(output, (Tensor, np.ndarray)):
            raise TypeError(f"{path} returned a {type(output).__name__}; a disparity is one tensor or array [H, W]")
        disparity = torch.as_tensor(output).to(left.device, torch.float32)
        if disparity.shape[-2:] != left.shape[-2:] or disparity.numel() != left[0, 0].numel():
            raise ValueError(f"{path} returned {list(output.shape)} for images of {list(left.shape[-2:])}; a disparity is [H, W]")
        if disparity.max() <= 0 and disparity.min() < 0:
            raise ValueError(f"{path} returned no disparity above 0; left (x, y) is right (x - d, y), so return minus the horizontal flow")
        return disparity.reshape(1, 1, *left.shape[-2:])

    return predict


def _trained(model: str, checkpoint: Path | None, options: dict[str, Any], iterations: int, device: str | torch.device) -> Predict:
    if checkpoint is None:
        raise ValueError(f"--model {model} needs --checkpoint FILE or DIR")
    matcher = load_trained(checkpoint, MODELS[model], **options).to(device)
    return lambda left, right: matcher.predict(left, right, iterations=iterations)


def _import(path: str) -> Any:
    module_name, _, attributes = path.partition(":")
    if not module_name or not attributes:
        raise ValueError(f"--model is {', '.join(MODELS)}, sgbm, or package.module:callable; got {path!r}")
    if os.getcwd() not in sys.path:
        sys.path.insert(0, os.getcwd())
    try:
        found = importlib.import_module(module_name)
    except ImportError as error:
        where = f"from here ({os.getcwd()}) or the installed packages"
        raise ImportError(f"--model {path}: cannot import {module_name} {where}: {error}") from error
    for name in attributes.split("."):
        if not hasattr(found, name):
            there = ", ".join(key for key in dir(found) if not key.startswith("_") and callable(getattr(found, key))) or "nothing"
            raise ImportError(f"--model {path}: {module_name} has no {attributes}; to call there is {there}")
        found = getattr(found, name)
    if inspect.isclass(found) or not callable(found):
        what = f"the class {found.__name__}" if inspect.isclass(found) else f"a {type(found).__name__}"
        raise TypeError(f"--model {path} is {what}; name a function or an object that is called as (left, right) -> disparity")
    return found


def _under_autocast(predict: Predict, dtype: torch.dtype) -> Predict:
    def predict_mixed(left: Tensor, right: Tensor) -> Tensor:
        with torch.autocast(left.device.type, dtype=dtype):
            return predict(left, right).float()

    return predict_mixed
