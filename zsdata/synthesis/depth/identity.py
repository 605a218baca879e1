"""Which depth estimator this is: a string that stays while its output does."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from huggingface_hub import try_to_load_from_cache

from zsdata.synthesis.depth.options import DepthNetwork

BUILTIN_VERSION = 1  # raised when the built-in estimator's output changes
PRETRAINED_VERSION = 3  # raised when pretrained.py does something else before or after the network

CONFIG_NAMES = ("config.json", "preprocessor_config.json")
WEIGHT_MARKS = (".safetensors", ".bin")  # part of the name of a file of weights, or of its index
SAMPLES = 16  # places at which a file of weights is read: unpacking and copying tools may give all files one time
SAMPLE_BYTES = 4096


def depth_identity(depth: str | os.PathLike[str] | DepthNetwork | Callable[..., Any]) -> str:
    """A readable string that changes whenever the output of a depth estimator may change, for the `identity` of a `DepthCache`.

    It depends on the estimator alone: not on the machine, the versions of the libraries, or what is computed from its output.

    - "builtin": the version of the built-in estimator.
    - A local folder in the transformers format: its name, the contents of its configuration and preprocessor files, and of its weights the
      names, sizes, times of change and samples of the contents. A folder may be moved, or copied with its times (`cp -p`, `rsync -t`); a
      copy with new times counts as another estimator, and depth is estimated anew.
    - A Hub id: the id, and the commit that it stands for in the local Hub cache. Nothing is downloaded: an id that is not there yet is an
      error, because maps of an unknown commit could not be told from those of the next one.
    - A `DepthNetwork`: its folder or Hub id, and the options that change its output.
    - A callable: its attribute `cache_name`, which whoever changes the callable also changes. No name is guessed: code and weights
      of a callable cannot be seen from outside, and wrong depth would come out of the cache without a word.

    Raises:
        FileNotFoundError: a Hub id that is not in the local Hub cache, or a folder without config.json.
        ValueError: a callable without `cache_name`, or a string that is neither a folder nor a Hub id.
    """
    if isinstance(depth, DepthNetwork):
        options = {
            "resolution": depth.resolution,
            "predicts": depth.predicts,
            "dtype": None if depth.dtype == DepthNetwork.dtype else depth.dtype,
        }
        said = "".join(f" {option}={value}" for option, value in options.items() if value is not None)
        return f"{_name_identity(depth.name, depth.revision)}{said}"
    if callable(depth):
        name = getattr(depth, "cache_name", None)
        if not isinstance(name, str) or not name.strip():
            raise ValueError(
                f"depth_cache needs to know which estimator {depth!r} is; got cache_name {name!r}. Give it a name that changes with its "
                'output, for example estimator.cache_name = "mynet-v3", or leave out depth_cache'
            )
        return f"callable {name}"
    name = os.fspath(depth)
    return f"builtin {BUILTIN_VERSION}" if name == "builtin" else depth_identity(DepthNetwork(name))


def _name_identity(name: str, revision: str | None) -> str:
    if os.path.isdir(name):
        return f"folder {os.path.basename(os.path.realpath(name))} {_folder_digest(name)} {PRETRAINED_VERSION}"
    return f"hub {name} {hub_commit(name, revision)} {PRETRAINED_VERSION}"


def hub_commit(name: str, revision: str | None = None) -> str:
    """The commit of a Hub id's revision (None: its branch "main") in the local Hub cache; see `depth_identity` for the errors."""
    try:
        config = try_to_load_from_cache(name, "config.json", revision=revision)
    except ValueError as error:
        raise ValueError(f'depth="{name}" is neither a folder nor a Hub id ("owner/name"): {error}') from error
    if not isinstance(config, str):
        wanted = "" if revision is None else f" --revision {revision}"
        raise FileNotFoundError(
            f'depth="{name}" is no folder, and the local Hub cache does not have it, so that nothing tells its commit. Download it there '
            f"first: hf download {name}{wanted}; of HF_HUB_CACHE and TRANSFORMERS_CACHE set one alone"
        )
    return os.path.basename(os.path.dirname(config))


def pinned(network: DepthNetwork) -> DepthNetwork:
    """The network of a Hub id at the commit that the local Hub cache has: what moves on the Hub changes no run that goes on, nor what lies
    in a depth cache. See `depth_identity` for the errors."""
    if os.path.isdir(network.name):
        return network
    return replace(network, revision=hub_commit(network.name, network.revision))


def _folder_digest(folder: str) -> str:
    digest = hashlib.sha256(usedforsecurity=False)
    names = sorted(os.listdir(folder))
    if "config.json" not in names:
        raise FileNotFoundError(f"depth={folder!r} has no config.json: it is no folder in the transformers format")
    for name in names:
        path = os.path.join(folder, name)
        if name in CONFIG_NAMES:
            with open(path, "rb") as file:
                data = file.read()
            digest.update(f"{name!r} {len(data)}\n".encode() + data)
        elif any(mark in name for mark in WEIGHT_MARKS):
            status = os.stat(path)
            digest.update(f"{name!r} {status.st_size} {status.st_mtime_ns}\n".encode())
            with open(path, "rb") as file:
                for sample in range(SAMPLES):
                    file.seek(max(0, status.st_size - SAMPLE_BYTES) * sample // (SAMPLES - 1))
                    digest.update(file.read(SAMPLE_BYTES))
    return digest.hexdigest()[:16]
