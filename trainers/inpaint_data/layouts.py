"""Synthetic stereo data sets in the folders that their authors publish, each with its own way to store disparity."""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from trainers.inpaint_data.stored_maps import StereoFrame, decode_map
from zsdata.faults import BadPhoto
from zsdata.source.photo import decode_rgb

# TartanAir (castacks/tartanair_tools, data_type.md): depth in metres, "disparity = 80.0 / depth".
TARTANAIR_FOCAL_PX, TARTANAIR_BASELINE_M = 320.0, 0.25
# CREStereo (megvii-research/CREStereo, dataset.py): 16-bit PNG of 32 times the disparity.
CRESTEREO_DIVISOR = 32
# Virtual KITTI 2 (README of the data set): 16-bit PNG of depth in centimetres, the sky at 655.35 m.
VKITTI2_FOCAL_PX, VKITTI2_BASELINE_M, VKITTI2_CENTIMETRES = 725.0087, 0.532725, 100
VKITTI2_APART = ("vkitti_2.0.3_rgb/", "vkitti_2.0.3_depth/")  # the names of its tars
# Falling Things (README of the data set): 16-bit PNG of depth in tenths of a millimetre; the focal length lies beside the images.
FALLING_THINGS_FOCAL_PX, FALLING_THINGS_BASELINE_M, FALLING_THINGS_UNITS = 768.16058349609375, 0.06, 10_000
FALLING_THINGS_END = 65_535  # of the range, 6.5535 m: what is farther is stored as that
FALLING_THINGS_CAMERA = "_camera_settings.json"


@dataclass(frozen=True, kw_only=True)
class Layout:
    """How one data set lies in its folder. The patterns speak of paths relative to it, with "/" between folders."""

    left: re.Pattern[str]  # all left images, and nothing else
    right: str  # what `left.match(path).expand` makes the other paths of
    truth: str  # disparity or depth of the left view
    right_truth: str  # of the right view; the pair does without where there is no such file
    disparity: Callable[[np.ndarray, Path], np.ndarray]  # (stored values, the folder they lie in) -> pixels
    apart: tuple[str, str] | None = None  # folders that images and truth are unpacked into, side by side, where not together
    example: str  # a left image below the root, for people


def _scene_flow(stored: np.ndarray, folder: Path) -> np.ndarray:
    return np.abs(stored)  # some releases write the direction of the shift as its sign


def _tartanair(stored: np.ndarray, folder: Path) -> np.ndarray:
    return TARTANAIR_FOCAL_PX * TARTANAIR_BASELINE_M / stored


def _crestereo(stored: np.ndarray, folder: Path) -> np.ndarray:
    return stored / CRESTEREO_DIVISOR


def _vkitti2(stored: np.ndarray, folder: Path) -> np.ndarray:
    return VKITTI2_FOCAL_PX * VKITTI2_BASELINE_M * VKITTI2_CENTIMETRES / stored


def _falling_things(stored: np.ndarray, folder: Path) -> np.ndarray:
    camera, focal_px = folder / FALLING_THINGS_CAMERA, FALLING_THINGS_FOCAL_PX
    if camera.is_file():
        try:
            focal_px = float(json.loads(camera.read_text())["camera_settings"][0]["intrinsic_settings"]["fx"])
        except (ValueError, KeyError, IndexError, TypeError) as error:
            raise BadPhoto(f"damaged camera: {camera} gives no focal length: {error!r}") from error
    stored = np.where(stored < FALLING_THINGS_END, stored, np.nan)  # its disparity would be read as 7 px, and may be anything below
    return focal_px * FALLING_THINGS_BASELINE_M * FALLING_THINGS_UNITS / stored


def _scene_flow_layout(render_pass: str) -> Layout:
    return Layout(
        # FlyingThings3D's TEST is what matchers are judged by; Monkaa and Driving have no such folder.
        left=re.compile(rf"(.*/)?(frames_{render_pass}pass(?:_webp)?)/((?!TEST/).*?/)?left/([^/]+)\.(png|webp)"),
        right=r"\g<1>\g<2>/\g<3>right/\g<4>.\g<5>",
        truth=r"\g<1>disparity/\g<3>left/\g<4>.pfm",
        right_truth=r"\g<1>disparity/\g<3>right/\g<4>.pfm",
        disparity=_scene_flow,
        example=f"FlyingThings3D/frames_{render_pass}pass/TRAIN/A/0000/left/0006.png, likewise Monkaa and Driving",
    )


LAYOUTS = {
    "sceneflow-clean": _scene_flow_layout("clean"),
    "sceneflow-final": _scene_flow_layout("final"),
    "tartanair": Layout(
        left=re.compile(r"(.*/)?image_left/(\d+)_left\.png"),
        right=r"\g<1>image_right/\g<2>_right.png",
        truth=r"\g<1>depth_left/\g<2>_left_depth.npy",
        right_truth=r"\g<1>depth_right/\g<2>_right_depth.npy",
        disparity=_tartanair,
        example="abandonedfactory/Easy/P000/image_left/000000_left.png",
    ),
    "crestereo": Layout(
        left=re.compile(r"(.+)_left\.jpg"),
        right=r"\g<1>_right.jpg",
        truth=r"\g<1>_left.disp.png",
        right_truth=r"\g<1>_right.disp.png",
        disparity=_crestereo,
        example="tree/0/0a0a6a21_left.jpg",
    ),
    "vkitti2": Layout(
        left=re.compile(r"(.*/)?frames/rgb/Camera_0/rgb_(\d+)\.jpg"),
        right=r"\g<1>frames/rgb/Camera_1/rgb_\g<2>.jpg",
        truth=r"\g<1>frames/depth/Camera_0/depth_\g<2>.png",
        right_truth=r"\g<1>frames/depth/Camera_1/depth_\g<2>.png",
        disparity=_vkitti2,
        apart=VKITTI2_APART,
        example=f"Scene01/clone/frames/rgb/Camera_0/rgb_00000.jpg, or {VKITTI2_APART[0]}Scene01/...",
    ),
    "fallingthings": Layout(
        left=re.compile(r"(.+)\.left\.jpg"),
        right=r"\g<1>.right.jpg",
        truth=r"\g<1>.left.depth.png",
        right_truth=r"\g<1>.right.depth.png",
        disparity=_falling_things,
        example="fat/mixed/kitchen_0/000000.left.jpg",
    ),
}


class StereoFolder:
    """The pairs of one data set, in the order of their paths.

    Args:
        kind: a key of LAYOUTS.
        root: the folder that the data set was unpacked into, or one above it.

    Raises:
        ValueError, FileNotFoundError: an unknown kind; no such folder; no left image in that layout; the first pair lacks a file.
    """

    def __init__(self, kind: str, root: str | os.PathLike[str]) -> None:
        if kind not in LAYOUTS:
            raise ValueError(f"no data set is called {kind!r}; there is {', '.join(LAYOUTS)}")
        self._layout = LAYOUTS[kind]
        self._root = Path(root)
        if not self._root.is_dir():
            raise FileNotFoundError(f"no folder {root}")
        self._lefts = sorted(path for path in _files_below(self._root) if self._layout.left.fullmatch(path))
        if not self._lefts:
            raise FileNotFoundError(f"no pair of {kind} in {root}: its left images lie below it as {self._layout.example}")
        for path in self._paths(0)[:3]:
            if not path.is_file():
                raise FileNotFoundError(
                    f"no file {path}, which belongs to {self._root / self._lefts[0]}; is the data set unpacked as a whole?"
                )

    def __len__(self) -> int:
        return len(self._lefts)

    @property
    def digest(self) -> str:
        """Changes with the names of the pairs, not with the folder they lie in."""
        return hashlib.sha256("\n".join(self._lefts).encode("utf-8", "surrogateescape")).hexdigest()

    def place(self, index: int) -> tuple[str, str]:
        """The folder and, below it, the left image."""
        return str(self._root), self._lefts[index]

    def read(self, index: int) -> StereoFrame:
        """Pair `index`; raises BadPhoto where a file is missing or damaged."""
        left, right, truth, right_truth = self._paths(index)
        return StereoFrame(
            left=decode_rgb(_content(left)),
            right=decode_rgb(_content(right)),
            disparity=self._disparity(truth),
            right_disparity=self._disparity(right_truth) if right_truth.is_file() else None,
        ).checked()

    def _paths(self, index: int) -> tuple[Path, Path, Path, Path]:
        """Left image, right image, truth of the left view, truth of the right view."""
        layout, path = self._layout, self._lefts[index]
        right, truth, right_truth = (self._root / layout.left.sub(part, path) for part in (layout.right, layout.truth, layout.right_truth))
        if layout.apart is not None and not truth.is_file():  # the root may be the images' folder itself
            truth, right_truth = (Path(one.as_posix().replace(*layout.apart)) for one in (truth, right_truth))
        return self._root / path, right, truth, right_truth

    def _disparity(self, path: Path) -> np.ndarray:
        stored = decode_map(_content(path), path.suffix[1:])
        stored = np.where(np.isfinite(stored) & (stored != 0), stored, np.nan).astype(np.float32)
        return self._layout.disparity(stored, path.parent).astype(np.float32)


def _files_below(root: Path) -> list[str]:
    """Paths relative to `root`. Links to folders are followed, as data sets are often linked together; but no folder is visited twice, and
    one that has a place of its own counts there."""
    found, visited, starts = list[str](), set[tuple[int, int]](), deque([root])
    while starts:
        for folder, below, names in os.walk(starts.popleft()):  # follows no link itself
            known = os.stat(folder)
            if (known.st_dev, known.st_ino) in visited:
                below.clear()
                continue
            visited.add((known.st_dev, known.st_ino))
            inner = Path(folder).relative_to(root)
            found += [(inner / name).as_posix() for name in names]
            below.sort()
            starts += [path for path in (Path(folder, name) for name in below) if path.is_symlink()]
    return found


def _content(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except FileNotFoundError:
        raise BadPhoto(f"no file: {path}") from None
