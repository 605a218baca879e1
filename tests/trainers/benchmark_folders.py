"""Small made-up folders in the official layouts of the stereo benchmarks, written without the code that reads them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

SIZE = (20, 44)


@dataclass
class MadeUpPair:
    """What the files say: disparities with 0, inf and NaN where the format has them, and which points both cameras see."""

    left: np.ndarray  # uint8 RGB
    right: np.ndarray
    truth: np.ndarray
    nonoccluded: np.ndarray | None


def made_up_pair(seed: int, holes: tuple[float, ...], largest: float = 60.0) -> MadeUpPair:
    """Random images, and blocks of disparity in multiples of 1/256 with `holes` in a third of the pixels."""
    rng = np.random.default_rng(seed)
    left, right = rng.integers(0, 256, (2, *SIZE, 3), dtype=np.uint8)
    blocks = rng.integers(256, int(256 * largest), (SIZE[0] // 5, SIZE[1] // 4))
    truth = (np.kron(blocks, np.ones((5, 4))) / 256).astype(np.float32)
    truth[rng.random(SIZE) < 1 / 3] = holes[0]
    for hole in holes[1:]:
        truth[rng.random(SIZE) < 0.1] = hole
    return MadeUpPair(left, right, truth, rng.random(SIZE) < 0.6)


def write_image(path: Path, image: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    uncompressed = [cv2.IMWRITE_TIFF_COMPRESSION, 1]  # OpenCV 4 rounds three channels of floats to 3 digits otherwise
    assert cv2.imwrite(str(path), image[..., ::-1] if image.ndim == 3 else image, uncompressed if path.suffix == ".tif" else [])


def write_pfm(path: Path, values: np.ndarray, order: str = "<") -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    kind = "Pf" if values.ndim == 2 else "PF"
    header = f"{kind}\n{values.shape[1]} {values.shape[0]}\n{'-1.0' if order == '<' else '1.0'}\n"
    path.write_bytes(header.encode() + values[::-1].astype(f"{order}f4").tobytes())


def write_16_bit(path: Path, truth: np.ndarray, divisor: int) -> None:
    write_image(path, np.rint(truth * divisor).astype(np.uint16))


def write_benchmark(name: str, root: Path, variant: str = "") -> dict[str, MadeUpPair]:
    """Writes two pairs of benchmark `name` (one a weather on DrivingStereo); returns them by name, as JPEG and PNG give them back."""
    pairs: dict[str, MadeUpPair] = {}
    for seed, (title, group) in enumerate({"first": "foggy", "second": "rainy"}.items()):
        if name in ("kitti2012", "kitti2015"):
            pair = made_up_pair(seed, holes=(0,))
            assert pair.nonoccluded is not None
            folders = {
                "kitti2012": ("colored_0", "colored_1", "disp_occ", "disp_noc"),
                "kitti2015": ("image_2", "image_3", "disp_occ_0", "disp_noc_0"),
            }[name]
            left, right, occluded, nonoccluded = (root / "training" / folder for folder in folders)
            for frame, image in ((f"00000{seed}_10.png", pair.left), (f"00000{seed}_11.png", pair.right)):
                write_image(left / frame, image)  # the next frame has no ground truth
            write_image(right / f"00000{seed}_10.png", pair.right)
            write_16_bit(occluded / f"00000{seed}_10.png", pair.truth, 256)
            write_16_bit(nonoccluded / f"00000{seed}_10.png", np.where(pair.nonoccluded, pair.truth, 0), 256)
            pairs[f"00000{seed}_10"] = pair
        elif name in ("middlebury", "eth3d"):
            pair = made_up_pair(seed, holes=(np.inf,))
            assert pair.nonoccluded is not None
            scene = root / f"training{variant}" / title if name == "middlebury" else root / "two_view_training" / title
            truth = scene if name == "middlebury" else root / "two_view_training_gt" / title
            mask = np.where(np.isfinite(pair.truth), np.where(pair.nonoccluded, 255, 128), 0).astype(np.uint8)
            mask[0, :20] = 0  # not judged although it has a value
            write_image(scene / "im0.png", pair.left)
            write_image(scene / "im1.png", pair.right)
            write_pfm(truth / "disp0GT.pfm", pair.truth)
            write_image(truth / "mask0nocc.png", mask)
            pair.truth = np.where(mask > 0, pair.truth, np.inf)
            pairs[title] = pair
        elif name == "drivingstereo":
            size, suffix, divisor = {"H": ("half", "jpg", 256), "F": ("full", "png", 128)}[variant]
            pair = made_up_pair(seed, holes=(0,), largest=200)
            pair.truth = np.rint(pair.truth * divisor) / divisor
            pair.nonoccluded = None
            weather = root / group
            write_image(weather / f"left-image-{size}-size" / f"{title}.{suffix}", pair.left)
            write_image(weather / f"right-image-{size}-size" / f"{title}.{suffix}", pair.right)
            write_16_bit(weather / f"disparity-map-{size}-size" / f"{title}.png", pair.truth, divisor)
            pair.left, pair.right = (
                cv2.imread(str(weather / f"{side}-image-{size}-size" / f"{title}.{suffix}"))[..., ::-1] for side in ("left", "right")
            )
            pairs[f"{group}-{title}"] = pair
        elif name == "sceneflow":
            pair = made_up_pair(seed, holes=(np.nan, np.inf, 0, -3), largest=300)
            pair.nonoccluded = None
            part = "AC"[seed]
            things, place = root / "FlyingThings3D", Path("TEST") / part / f"000{seed}"
            write_image(things / f"frames_{variant}" / place / "left" / "0006.png", pair.left)
            write_image(things / f"frames_{variant}" / place / "right" / "0006.png", pair.right)
            write_pfm(things / "disparity" / place / "left" / "0006.pfm", pair.truth, order=">" if seed else "<")
            pairs[f"{part}-000{seed}-0006"] = pair
    return pairs
