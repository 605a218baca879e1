"""Where the public stereo benchmarks keep their pairs, in the layout in which they are unpacked."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from os import PathLike
from pathlib import Path

from trainers.image_files import KITTI_DIVISOR
from trainers.pairs_on_disk import PairFiles

DRIVINGSTEREO_SIZES = {"H": ("half", 256), "F": ("full", 128)}  # variant: word in the folder names, divisor of its 16-bit disparities


@dataclass(frozen=True, kw_only=True)
class Benchmark:
    """One benchmark: how its pairs are found, and what its published protocol says."""

    find: Callable[[Path, str], list[PairFiles]]  # (root, variant)
    layout: str  # below the root, for people
    pairs: int  # how many there are when it is complete
    variants: tuple[str, ...] = ()  # resolutions or render passes; the first one unless told otherwise
    below_px: tuple[float, ...] = ()  # published scores that count only the points of smaller disparity


def find_benchmark(name: str, root: str | PathLike[str], variant: str | None = None) -> list[PairFiles]:
    """The pairs of a benchmark below `root`, sorted by name; all their files are there.

    Args:
        name: a key of BENCHMARKS.
        variant: one of its variants; None: the first.
    Raises:
        ValueError: an unknown name or variant.
        FileNotFoundError: no such folder, or not in the benchmark's layout; says what was expected where.
    """
    root = Path(root)
    if name not in BENCHMARKS:
        raise ValueError(f"no benchmark is called {name!r}; there is {', '.join(BENCHMARKS)}")
    benchmark = BENCHMARKS[name]
    if variant is not None and variant not in benchmark.variants:
        raise ValueError(f"the variants of {name} are {', '.join(benchmark.variants) or 'none'}; got {variant}")
    if not root.is_dir():
        raise FileNotFoundError(f"no folder {root}")
    expected = f"{name} lies in ROOT as {benchmark.layout}"
    pairs = benchmark.find(root, variant or next(iter(benchmark.variants), ""))
    if not pairs:
        raise FileNotFoundError(f"no left image of {name} in {root}; {expected}")
    files = {path for pair in pairs for path in pair.paths}
    missing = sorted(path for path in files if not path.is_file())
    if missing:
        raise FileNotFoundError(f"no file {missing[0]} ({len(missing)} of {len(files)} files are missing); {expected}")
    return pairs


def _kitti2012(root: Path, variant: str) -> list[PairFiles]:
    return _kitti(root / "training", ("colored_0", "colored_1", "disp_occ", "disp_noc"))


def _kitti2015(root: Path, variant: str) -> list[PairFiles]:
    return _kitti(root / "training", ("image_2", "image_3", "disp_occ_0", "disp_noc_0"))


def _kitti(training: Path, folders: tuple[str, str, str, str]) -> list[PairFiles]:
    left, right, all_points, nonoccluded = (training / folder for folder in folders)
    return [
        PairFiles(
            name=image.stem,
            left=image,
            right=right / image.name,
            disparity=all_points / image.name,
            divisor=KITTI_DIVISOR,
            nonoccluded=nonoccluded / image.name,
        )
        for image in sorted(left.glob("*_10.png"))  # the next frame, *_11, has no ground truth
    ]


def _middlebury(root: Path, variant: str) -> list[PairFiles]:
    return [_masked_pair(left, left.parent) for left in sorted((root / f"training{variant}").glob("*/im0.png"))]


def _eth3d(root: Path, variant: str) -> list[PairFiles]:
    truth = root / "two_view_training_gt"
    return [_masked_pair(left, truth / left.parent.name) for left in sorted((root / "two_view_training").glob("*/im0.png"))]


def _masked_pair(left: Path, truth: Path) -> PairFiles:
    return PairFiles(
        name=left.parent.name,
        left=left,
        right=left.with_name("im1.png"),
        disparity=truth / "disp0GT.pfm",
        nonoccluded=truth / "mask0nocc.png",
        mask_tells_unknown=True,
    )


def _drivingstereo(root: Path, variant: str) -> list[PairFiles]:
    size, divisor = DRIVINGSTEREO_SIZES[variant]
    images = [path for suffix in ("jpg", "png") for path in root.glob(f"*/left-image-{size}-size/*.{suffix}")]
    return [
        PairFiles(
            name=f"{weather.name}-{left.stem}",
            left=left,
            right=weather / f"right-image-{size}-size" / left.name,
            disparity=weather / f"disparity-map-{size}-size" / f"{left.stem}.png",
            divisor=divisor,
            group=weather.name,
        )
        for left in sorted(images)
        for weather in [left.parents[1]]
    ]


def _sceneflow(root: Path, variant: str) -> list[PairFiles]:
    root = root / "FlyingThings3D" if (root / "FlyingThings3D").is_dir() else root
    frames = root / f"frames_{variant}" / "TEST"
    return [
        PairFiles(
            name="-".join((*scene.relative_to(frames).parts, left.stem)),
            left=left,
            right=scene / "right" / left.name,
            disparity=root / "disparity" / "TEST" / scene.relative_to(frames) / "left" / f"{left.stem}.pfm",
        )
        for left in sorted(frames.glob("[ABC]/*/left/*.png"))
        for scene in [left.parents[1]]
    ]


BENCHMARKS = {
    "kitti2012": Benchmark(find=_kitti2012, layout="training/{colored_0,colored_1,disp_occ,disp_noc}/*_10.png", pairs=194),
    "kitti2015": Benchmark(find=_kitti2015, layout="training/{image_2,image_3,disp_occ_0,disp_noc_0}/*_10.png", pairs=200),
    "middlebury": Benchmark(
        find=_middlebury,
        layout="training{F,H,Q}/SCENE/{im0.png,im1.png,disp0GT.pfm,mask0nocc.png}, for which ROOT is MiddEval3",
        pairs=15,
        variants=("H", "F", "Q"),
    ),
    "eth3d": Benchmark(
        find=_eth3d,
        layout="two_view_training/SCENE/{im0.png,im1.png} and two_view_training_gt/SCENE/{disp0GT.pfm,mask0nocc.png}",
        pairs=27,
    ),
    "drivingstereo": Benchmark(
        find=_drivingstereo,
        layout="WEATHER/{left-image,right-image,disparity-map}-{half,full}-size/*.{jpg,png}",
        pairs=2000,
        variants=("H", "F"),
    ),
    "sceneflow": Benchmark(
        find=_sceneflow,
        layout="frames_{finalpass,cleanpass}/TEST/{A,B,C}/*/{left,right}/*.png and disparity/TEST/{A,B,C}/*/left/*.pfm",
        pairs=4370,
        variants=("finalpass", "cleanpass"),
        below_px=(192.0,),
    ),
}
