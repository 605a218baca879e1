"""Where the public stereo benchmarks keep their pairs, in the layout in which they are unpacked."""

from __future__ import annotations

from collections.abc import Callable
from os import PathLike
from pathlib import Path

from trainers.pairs_on_disk import KITTI_DIVISOR, PairFiles

Root = str | PathLike[str]


def kitti2015(root: Root) -> list[PairFiles]:
    """The 200 training frames: ROOT/training/{image_2,image_3,disp_occ_0}/*_10.png."""
    training = Path(root) / "training"
    return [
        PairFiles(
            name=left.stem,
            left=left,
            right=training / "image_3" / left.name,
            disparity=training / "disp_occ_0" / left.name,
            divisor=KITTI_DIVISOR,
        )
        for left in _some(training / "image_2", "*_10.png")
    ]


def middlebury(root: Root) -> list[PairFiles]:
    """Middlebury v3 (MiddEval3), one resolution: ROOT/SCENE/{im0.png,im1.png,disp0GT.pfm,mask0nocc.png}, e.g. ROOT = trainingH."""
    return [_middlebury_pair(left, left.parent) for left in _some(Path(root), "*/im0.png")]


def eth3d(root: Root) -> list[PairFiles]:
    """ETH3D two-view: ROOT/two_view_training/SCENE/{im0,im1}.png, ROOT/two_view_training_gt/SCENE/{disp0GT.pfm,mask0nocc.png}."""
    root = Path(root)
    truth = root / "two_view_training_gt"
    return [_middlebury_pair(left, truth / left.parent.name) for left in _some(root / "two_view_training", "*/im0.png")]


def drivingstereo(root: Root) -> list[PairFiles]:
    """DrivingStereo's weather subsets, half size: ROOT/WEATHER/{left,right}-image-half-size/*.jpg, disparity-map-half-size/*.png."""
    pairs = []
    for left in _some(Path(root), "*/left-image-half-size/*.jpg"):
        weather = left.parents[1]
        pairs.append(
            PairFiles(
                name=f"{weather.name}-{left.stem}",
                left=left,
                right=weather / "right-image-half-size" / left.name,
                disparity=weather / "disparity-map-half-size" / f"{left.stem}.png",
                divisor=KITTI_DIVISOR,
            )
        )
    return pairs


BENCHMARKS: dict[str, Callable[[Root], list[PairFiles]]] = {
    "kitti2015": kitti2015,
    "middlebury": middlebury,
    "eth3d": eth3d,
    "drivingstereo": drivingstereo,
}


def _middlebury_pair(left: Path, truth: Path) -> PairFiles:
    mask = truth / "mask0nocc.png"
    return PairFiles(
        name=left.parent.name,
        left=left,
        right=left.with_name("im1.png"),
        disparity=truth / "disp0GT.pfm",
        nonoccluded=mask if mask.exists() else None,
    )


def _some(folder: Path, pattern: str) -> list[Path]:
    found = sorted(folder.glob(pattern))
    if not found:
        raise FileNotFoundError(f"no file {folder / pattern}; is --root the folder that the benchmark was unpacked into?")
    return found
