"""What does augmentation cost, effect by effect, next to decoding the photo? And what does it look like?

python benchmarks/augment.py                                     a table
python benchmarks/augment.py --pictures DIR [--photo FILE]       augmented pairs of a photo, left beside right, as DIR/augment.png
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import torch

from zsdata.augment import AugmentConfig, augment
from zsdata.seeding import rng

HEIGHT, WIDTH, BATCH = 384, 512, 8  # the paper's crop and batch

NONE = AugmentConfig.none()
ONE = (1.0, 1.0)
JITTER_OFF = replace(NONE, jitter_probability=1.0, brightness=ONE, contrast=ONE, saturation=ONE, hue_turns=0.0)
EFFECTS = {
    "nothing (a copy)": NONE,
    "brightness": replace(JITTER_OFF, brightness=(0.6, 1.4)),
    "contrast": replace(JITTER_OFF, contrast=(0.6, 1.4)),
    "saturation": replace(JITTER_OFF, saturation=(0.0, 1.4)),
    "hue": replace(JITTER_OFF, hue_turns=AugmentConfig().hue_turns),
    "gamma": replace(JITTER_OFF, gamma=(0.8, 1.2)),
    "grey": replace(NONE, grey_probability=1.0),
    "vertical jitter (right)": replace(NONE, vertical_jitter_px=2),
    "rectification error (right)": replace(NONE, rectification_probability=1.0),
    "gain": replace(NONE, gain_probability=1.0),
    "vignetting": replace(NONE, vignetting_probability=1.0),
    "blur (right)": replace(NONE, blur_probability=1.0),
    "defocus": replace(NONE, defocus_probability=1.0),
    "noise (right)": replace(NONE, noise_probability=1.0),
    "sensor noise": replace(NONE, sensor_noise_probability=1.0),
    "eraser (right)": replace(NONE, eraser_probability=1.0),
    "all as by default": AugmentConfig(),
    "every effect on every pair": replace(
        AugmentConfig(), **{name: 1.0 for name in AugmentConfig.__dataclass_fields__ if name.endswith("_probability")}, gamma=(0.8, 1.2)
    ),
}


def median_seconds(work: Callable[[int], object], repeats: int) -> float:
    work(0)
    seconds = []
    for i in range(repeats):
        start = time.perf_counter()
        work(i)
        seconds.append(time.perf_counter() - start)
    return float(np.median(seconds))


def load_photo(path: str | None) -> np.ndarray:
    """RGB uint8 [H, W, 3], 384x512 and a margin on the left for the second view."""
    if path is None:
        from skimage.data import astronaut

        photo = astronaut()
    else:
        photo = cv2.imread(path, cv2.IMREAD_COLOR)
        if photo is None:
            raise SystemExit(f"{path} is no image that OpenCV reads")
        photo = photo[..., ::-1]
    scale = max(HEIGHT / photo.shape[0], (WIDTH + 16) / photo.shape[1])
    photo = cv2.resize(np.ascontiguousarray(photo), None, fx=scale + 1e-3, fy=scale + 1e-3, interpolation=cv2.INTER_AREA)
    return photo[:HEIGHT]


def as_batch(photo: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(np.ascontiguousarray(photo.transpose(2, 0, 1))).float()[None].repeat(BATCH, 1, 1, 1)


def print_table(left: torch.Tensor, right: torch.Tensor, repeats: int) -> None:
    picture = left[0].permute(1, 2, 0).byte().numpy()[..., ::-1]
    jpeg = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 95])[1]
    decode = median_seconds(lambda _: cv2.imdecode(jpeg, cv2.IMREAD_COLOR), 50)
    print(f"batch {BATCH} at {HEIGHT}x{WIDTH}, {left.device}, one CPU thread, median of {repeats}")
    print(f"{'':30}{'ms a pair':>10}{'JPEG decodes':>14}")
    print(f"{'JPEG decode, one image':30}{decode * 1e3:10.2f}{1:14.1f}")
    for name, config in EFFECTS.items():

        def once(i: int, config: AugmentConfig = config) -> None:
            augment(left, right, [rng(0, i, pair, "augment") for pair in range(BATCH)], config)
            if left.is_cuda:
                torch.cuda.synchronize()

        seconds = median_seconds(once, repeats) / BATCH
        print(f"{name:30}{seconds * 1e3:10.2f}{seconds / decode:14.1f}")


def write_pictures(left: torch.Tensor, right: torch.Tensor, folder: Path) -> None:
    """Row 1: the pair itself and the first effects; then the effects one by one; then twelve pairs as by default."""
    effects = {name: config for name, config in EFFECTS.items() if name not in ("all as by default", "every effect on every pair")}
    cells = [(name, config, 3) for name, config in effects.items()] + [(f"default {i}", AugmentConfig(), i) for i in range(12)]
    tiles = []
    for name, config, index in cells:
        pair = augment(left[:1], right[:1], [rng(0, 0, index, "augment")], config)
        tile = torch.cat(pair, -1)[0].permute(1, 2, 0).round().byte().numpy()[..., ::-1].copy()
        tile = cv2.resize(tile, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        cv2.putText(tile, name, (6, 16), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (0, 0, 0), 3)
        cv2.putText(tile, name, (6, 16), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (255, 255, 255), 1)
        tiles.append(tile)
    while len(tiles) % 3:
        tiles.append(np.zeros_like(tiles[0]))
    sheet = np.concatenate([np.concatenate(tiles[i : i + 3], 1) for i in range(0, len(tiles), 3)], 0)
    folder.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(folder / "augment.png"), sheet)
    print(folder / "augment.png")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--repeats", type=int, default=9)
    parser.add_argument("--photo", help="default: scikit-image's astronaut")
    parser.add_argument("--pictures", type=Path, metavar="DIR", help="write pictures in place of the table")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    photo = load_photo(arguments.photo)
    # A fronto-parallel scene at 16 px: the right view is the photo 16 px further on.
    left, right = (as_batch(photo[:, start : start + WIDTH]).to(arguments.device) for start in (0, 16))
    if arguments.pictures:
        write_pictures(left.cpu(), right.cpu(), arguments.pictures)
    else:
        print_table(left, right, arguments.repeats)


if __name__ == "__main__":
    main()
