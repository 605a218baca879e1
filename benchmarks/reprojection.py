"""Do a synthesised pair and its label fit together: how well is the left image reconstructed from the right one?

python benchmarks/reprojection.py                                   the photos that scikit-image ships
python benchmarks/reprojection.py --photos DIR [--every N]          a folder of photos, every Nth of them
python benchmarks/reprojection.py --stereo DIR                      also pairs with ground truth (see trainers/pairs_on_disk.py)

Photos: whole, at full resolution. Built-in depth, disparity dilated and sharpened as the stream does, its largest value 0.03, 0.05 and 0.10
of the width (small; the lower end and the centre of what most draws are), then as the stream draws it. The right image is looked up
bilinearly at x - d and compared with the left one, in 0..1: mean absolute error, SSIM (7x7 windows, borders reflected), and the photometric
loss 0.85 (1 - SSIM) / 2 + 0.15 AbsErr; means over the photos. "Visible" are the non-occluded pixels whose lookup reads no invented pixel;
"whole" are all, with the holes filled by the built-in inpainter and the frame's border repeated: what leaves the frame or is occluded
cannot be found there by any warp, and it grows with the disparity. The paper gives 0.025, 0.850, 0.068 for its own pairs (whole images,
other photos and depth) and 0.082, 0.269, 0.323 for StereoDiffusion. "Bilinear" and "nearest pixel" are references with the geometry and the
masks of `forward_warp`: the left image is read at u + d of the right image's disparity, between its two neighbours or at the nearer one.
Their time is that of `forward_warp` and this lookup; "decodes" are multiples of decoding the photo from JPEG. A second table says where the
error comes from.

Pairs: the left image is warped with the true disparity and compared with the true right image where something was warped to. "Floor" is the
true right image, looked up bilinearly from the left: what the cameras, and not the warp, make different, on the same scene points. Where a
pair says which pixels both cameras see, the others are left out. Pairs whose truth is sparser than DENSE are left out.
"""

from __future__ import annotations

import argparse
import platform
import statistics
import time
import warnings
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor

from trainers.pairs_on_disk import StereoPair, find_pairs, read_pair
from zsdata import (
    AdaptiveDisparity,
    Warped,
    backward_warp,
    decode_photo,
    dilate_disparity,
    forward_warp,
    load_depth,
    load_inpainter,
    normalize_inverse_depth,
    sharpen_disparity,
)
from zsdata.example_photos import example_photos
from zsdata.metrics import reconstruction_error, reconstruction_maps
from zsdata.progress import Progress
from zsdata.seeding import rng
from zsdata.synthesis.depth.builtin import BuiltinDepthWarning
from zsdata.synthesis.disparity import SMALLEST_DISPARITY_PX
from zsdata.synthesis.inpaint import fill
from zsdata.synthesis.warp import LARGEST_STEP_PX

PHOTO_ENDINGS = (".jpg", ".jpeg", ".png", ".webp")
JPEG_QUALITY = 95
DENSE = 0.9
SHARES = (0.03, AdaptiveDisparity().center - AdaptiveDisparity().radius, AdaptiveDisparity().center)
SCALES: dict[str, Callable[[int, int], float]] = {  # (photo's number, its width) -> largest disparity as a share of the width
    **{f"largest disparity {share:.2f} of the width": lambda index, width, share=share: share for share in SHARES},
    "largest disparity as the stream draws it": lambda index, width: AdaptiveDisparity().draw_scale(rng(0, 0, index, "disparity"), width),
}

Views = dict[str, Tensor]  # the right view by each way to resample; 0 in its holes
inpainter = load_inpainter("builtin")


def right_views(left: Tensor, disparity: Tensor) -> tuple[Warped, Views, dict[str, float]]:
    """The warp, the right views by each way, and the milliseconds of each."""
    start = time.perf_counter()
    warped = forward_warp(left, disparity)
    ms = {"forward_warp": 1e3 * (time.perf_counter() - start)}
    views = {"forward_warp": warped.right}
    for name, mode in (("bilinear", "bilinear"), ("nearest pixel", "nearest")):
        start = time.perf_counter()
        views[name] = backward_warp(left, -warped.right_disparity, mode).masked_fill(warped.inpaint_mask, 0)
        ms[name] = ms["forward_warp"] + 1e3 * (time.perf_counter() - start)
    return warped, views, ms


def visible_mask(warped: Warped, disparity: Tensor) -> Tensor:
    """bool, left view: True where the right image shows the pixel and its lookup reads no invented pixel and none outside."""
    return warped.nonocclusion_mask & (backward_warp((~warped.inpaint_mask).float(), disparity, padding="zeros") == 1)


def parts_of(warped: Warped, disparity: Tensor, visible: Tensor) -> dict[str, Tensor]:
    """bool, left view: every pixel of the left image in one of five parts."""
    x = torch.arange(disparity.shape[-1])
    first = (x - disparity).floor()  # of the two columns that the lookup reads
    leaves = disparity > x
    occluded = ~leaves & ~warped.nonocclusion_mask
    there = [backward_warp(warped.right_disparity, x - column, "nearest") for column in (first, first + 1)]
    mixed = ((there[0] - disparity).abs() > LARGEST_STEP_PX) | ((there[1] - disparity).abs() > LARGEST_STEP_PX)
    return {
        "leaves the frame": leaves,
        "occluded": occluded,
        "lookup reads an invented pixel": ~leaves & ~occluded & ~visible,
        "visible, lookup reads another surface": visible & mixed,
        "visible, lookup reads one surface": visible & ~mixed,
    }


class PhotoTable:
    """Sums over photos of one choice of disparities."""

    def __init__(self, title: str) -> None:
        self.title = title
        self.rows: dict[str, list[list[float]]] = {}
        self.parts: dict[str, list[list[float]]] = {}

    def add(self, left: Tensor, disparity: Tensor, decode_ms: float) -> None:
        warped, views, ms = right_views(left, disparity)
        visible = visible_mask(warped, disparity)
        context = {"right_disparity": warped.right_disparity}
        for name, view in views.items():
            right = fill(inpainter, view, warped.inpaint_mask, [rng(0, 0, 0, "inpaint")], context, micro_batch=1)
            maps = reconstruction_maps(left, right, disparity)
            row = [float(values[mask].double().mean()) for mask in (visible, torch.ones_like(visible)) for values in maps]
            self.rows.setdefault(name, []).append([*row, ms[name], decode_ms])
            if name == "forward_warp":
                for part, mask in parts_of(warped, disparity, visible).items():
                    sums = [float(values[mask].double().sum()) / mask.numel() for values in (torch.ones_like(maps.ssim), *maps[:2])]
                    self.parts.setdefault(part, []).append([sums[0], sums[1], sums[0] - sums[2]])

    def print(self) -> None:
        print(f"\n{self.title}, {len(self.rows['forward_warp'])} photos")
        print(f"{'':16}{'visible: AbsErr':>17}{'SSIM':>8}{'L_p':>8}{'whole: AbsErr':>17}{'SSIM':>8}{'L_p':>8}{'ms':>8}{'decodes':>9}")
        for name, rows in self.rows.items():
            mean = np.nanmean(rows, axis=0)
            text = "".join(f"{value:{width}.4f}" for value, width in zip(mean[:6], (17, 8, 8, 17, 8, 8), strict=True))
            print(f"{name:16}{text}{mean[6]:8.1f}{mean[6] / mean[7]:9.1f}")
        print(
            f"{'where the error of forward_warp is':40}{'share':>8}{'AbsErr':>9}{'1 - SSIM':>10}   (the parts add up to the whole image's)"
        )
        for part, rows in self.parts.items():
            share, error, dissimilarity = np.mean(rows, axis=0)
            print(f"{part:40}{share:8.3f}{error:9.4f}{dissimilarity:10.4f}")


def median_ms(work: Callable[[], object], repeats: int = 3) -> float:
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        seconds.append(time.perf_counter() - start)
    return 1e3 * statistics.median(seconds)


def measure_photos(files: Sequence[Path]) -> None:
    depth = load_depth("builtin")
    tables = {title: PhotoTable(title) for title in SCALES}
    for index, file in enumerate(Progress(files, unit="photo", desc="photos")):
        left = decode_photo(file.read_bytes()).unsqueeze(0).float()
        jpeg = cv2.imencode(".jpg", left[0].permute(1, 2, 0).byte().numpy()[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1]
        decode_ms = median_ms(lambda jpeg=jpeg: cv2.imdecode(jpeg, cv2.IMREAD_COLOR))
        inverse_depth = normalize_inverse_depth(depth(left))
        width = left.shape[-1]
        for title, scale in SCALES.items():
            disparity = sharpen_disparity(dilate_disparity(inverse_depth * scale(index, width) * width))
            tables[title].add(left, disparity.clamp(min=SMALLEST_DISPARITY_PX), decode_ms)
    for table in tables.values():
        table.print()


def against_the_truth(pair: StereoPair) -> dict[str, list[float]]:
    """PSNR in dB, AbsErr and SSIM of each right view, and of the floor; over the pixels that both cameras see."""
    left, right = (torch.from_numpy(image).permute(2, 0, 1)[None].float() for image in (pair.left, pair.right))
    disparity, valid = (torch.from_numpy(array)[None, None] for array in (pair.disparity, pair.valid))
    warped, views, _ = right_views(left, torch.where(valid, disparity, torch.nan))
    seen = valid & visible_mask(warped, disparity)
    shown = ~warped.inpaint_mask
    if pair.nonoccluded is not None:
        nonoccluded = torch.from_numpy(pair.nonoccluded)[None, None]
        seen &= nonoccluded
        shown &= backward_warp(nonoccluded, -warped.right_disparity, "nearest")
    straight = torch.zeros_like(disparity)
    scores = {}
    for name, view in views.items():
        made = torch.where(shown, view, right)  # SSIM's windows see the truth where there is nothing to compare
        scores[name] = score(right, made, straight, shown)
    scores["floor"] = score(left, right, disparity, seen)
    return scores


def score(image: Tensor, other: Tensor, disparity: Tensor, counted: Tensor) -> list[float]:
    means = reconstruction_error(image, other, disparity, counted)
    squares = (image - backward_warp(other, disparity)).square().mean(1, keepdim=True)[counted].double().mean()
    return [float(10 * torch.log10(255**2 / squares)), float(means.abs_err), float(means.ssim)]


def measure_pairs(folders: Iterable[Path]) -> None:
    pairs = [pair for pair in map(read_pair, folders) if pair.valid.mean() >= DENSE]
    scores = {pair.name: against_the_truth(pair) for pair in Progress(pairs, unit="pair", desc="pairs")}
    ways = list(next(iter(scores.values()))) if scores else []
    print(f"\nagainst the true right image, {len(scores)} pairs (PSNR in dB, AbsErr, SSIM)")
    print(f"{'':32}" + "".join(f"{way:>24}" for way in ways))
    for name, of in [*scores.items(), ("mean", {way: np.mean([of[way] for of in scores.values()], axis=0) for way in ways})]:
        print(f"{name:32}" + "".join(f"{psnr:10.2f}{error:7.4f}{ssim:7.4f}" for psnr, error, ssim in of.values()))


def photos_in(folder: Path) -> list[Path]:
    return sorted(file for file in folder.iterdir() if file.suffix.lower() in PHOTO_ENDINGS)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--photos", type=Path, metavar="DIR", help="folder of photos (default: the example photos of scikit-image)")
    parser.add_argument("--every", type=int, default=1, metavar="N", help="only every Nth photo (default: 1)")
    parser.add_argument("--stereo", type=Path, metavar="DIR", help="folder of pairs with ground truth")
    options = parser.parse_args()
    if options.every < 1:
        parser.error(f"--every is at least 1; got {options.every}")
    files = (
        sorted(file for file in options.photos.iterdir() if file.suffix.lower() in PHOTO_ENDINGS) if options.photos else example_photos()
    )
    if not files:
        parser.error(f"no photo ({', '.join(PHOTO_ENDINGS)}) in {options.photos}")
    warnings.simplefilter("ignore", BuiltinDepthWarning)
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    machine = platform.processor() or platform.machine()
    print(f"{machine}, torch {torch.__version__}, OpenCV {cv2.__version__}, numpy {np.__version__}, Python {platform.python_version()}")
    with torch.inference_mode():
        measure_photos(files[:: options.every])
        if options.stereo:
            measure_pairs(find_pairs(options.stereo))


if __name__ == "__main__":
    main()
