"""Is the built-in depth better than a ramp, how long does it take, and what does a mirrored photo change?

python benchmarks/depth.py                                   three tables
python benchmarks/depth.py --pictures DIR [--count 24]       also photo, depth (red is near) and flip confidence side by side, as PNG files

Order: Spearman's rank correlation of inverse depth with the true disparity of real pairs; 1 is the right order of all pixels, 0 is chance.
    "row" is the image row (lower is nearer). "left out" refits the cues' weights to the other pairs first, so the weights have not seen
    the pair. (All other numbers of the method were chosen while looking at the pairs in data/stereo; motorcycle was only looked at.)
Time: on one thread; also as multiples of decoding a JPEG of that size.
Mirroring: D is the normalised depth of a photo, D' that of the mirrored photo, mirrored back. |D - D'| should be small, but larger where
    edges are weak: it is also given within 3 px of steps in D, for the half of the photo's steps with the lower colour contrast, and
    for the half with the higher.
"""

from __future__ import annotations

import argparse
import time
import warnings
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import nnls

from trainers.pairs_on_disk import StereoPair, find_pairs, motorcycle, read_pair
from zsdata.synthesis.confidence import flip_confidence, normalize_inverse_depth
from zsdata.synthesis.depth.builtin import WEIGHTS, BuiltinDepth, BuiltinDepthWarning, analyse, fit_planes, render, working_image

DATA = Path(__file__).resolve().parents[2] / "shared" / "data"
SIZES = ((480, 640), (768, 1024), (1536, 2048))
RIDGE = 0.05  # pull of the refitted weights to equal weights, for cues of unit variance: six numbers from few pairs need a hold
MOTORCYCLE = "motorcycle"

depth = BuiltinDepth()


def tensor(photo: NDArray[np.uint8]) -> torch.Tensor:
    return torch.from_numpy(photo).permute(2, 0, 1)[None].float()


def ranks(values: NDArray) -> NDArray[np.float64]:
    """Ranks from 0 to 1; equal values share their mean rank."""
    _, group, count = np.unique(values, return_inverse=True, return_counts=True)
    last = np.cumsum(count)
    return ((last - count + last - 1) / 2)[group.reshape(-1)] / max(len(values) - 1, 1)


def spearman(prediction: NDArray, truth: NDArray) -> float:
    return float(np.corrcoef(ranks(prediction), ranks(truth))[0, 1])


def cue_maps(pair: StereoPair) -> tuple[NDArray, NDArray]:
    """Every cue as a depth map of its own at working size [pixels, cues], and the true ranks there; the method is linear in the cues."""
    scene = analyse(working_image(pair.left.transpose(2, 0, 1).astype(np.float32)))
    labels = scene.surfaces.region_of[scene.labels]
    h, w = labels.shape
    height, width = pair.disparity.shape
    here = np.ix_((np.arange(h) * 2 + 1) * height // (2 * h), (np.arange(w) * 2 + 1) * width // (2 * w))
    valid = pair.valid[here]
    maps = np.stack([render(fit_planes(scene, cue), labels)[valid] for cue in scene.cues], 1)
    return maps - maps.mean(0), ranks(pair.disparity[here][valid])


def fitted(cases: list[tuple[NDArray, NDArray]]) -> NDArray:
    """Non-negative weights that fit the true ranks of the cases, held towards equal weights of cues of equal variance."""
    scale = np.mean([maps.std(0) for maps, _ in cases], 0) + 1e-9
    gram, target = RIDGE * np.eye(len(scale)), np.full(len(scale), RIDGE * 0.05)
    for maps, truth in cases:
        unit = maps / scale
        gram = gram + unit.T @ unit / len(unit) / len(cases)
        target = target + unit.T @ (truth - truth.mean()) / len(unit) / len(cases)
    root = np.linalg.cholesky(gram)
    return nnls(root.T, np.linalg.solve(root, target))[0] / scale


def order_table(root: Path) -> None:
    pairs = [read_pair(folder) for folder in find_pairs(root)] if root.is_dir() else []
    if not pairs:
        print(f"(no pairs in {root}; see --stereo)")
    pairs.append(motorcycle())
    cases = {pair.name: cue_maps(pair) for pair in pairs}
    in_fit = [name for name in cases if name != MOTORCYCLE]
    print(f"{'order (Spearman)':34s}{'built-in':>10s}{'row':>10s}{'left out':>10s}")
    rows = []
    for pair in pairs:
        height, width = pair.disparity.shape
        prediction = depth(tensor(pair.left))[0, 0].numpy()[pair.valid]
        ramp = np.repeat(np.arange(height), width).reshape(height, width)[pair.valid]
        truth = pair.disparity[pair.valid]
        others = [cases[name] for name in in_fit if name != pair.name]
        left_out = spearman(cases[pair.name][0] @ fitted(others), cases[pair.name][1]) if others else float("nan")
        rows.append((pair.name, spearman(prediction, truth), spearman(ramp, truth), left_out))
        print(f"{pair.name:34s}" + "".join(f"{value:10.3f}" for value in rows[-1][1:]))
    if in_fit:
        means = np.mean([row[1:] for row in rows if row[0] != MOTORCYCLE], 0)
        print(f"{f'mean of {len(in_fit)} without motorcycle':34s}" + "".join(f"{value:10.3f}" for value in means))
        weights = fitted([cases[name] for name in in_fit])
        print("weights   " + ", ".join(f"{name} {value:.2f}" for name, value in zip(WEIGHTS._fields, WEIGHTS, strict=True)))
        scaled = weights * sum(WEIGHTS) / weights.sum()
        print("refitted  " + ", ".join(f"{name} {value:.2f}" for name, value in zip(WEIGHTS._fields, scaled, strict=True)))


def median_ms(work: Callable[[], object], repeats: int) -> float:
    work()
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        seconds.append(time.perf_counter() - start)
    return 1e3 * float(np.median(seconds))


def time_table(photo: NDArray[np.uint8], repeats: int) -> None:
    print(f"\n{'time (median of ' + str(repeats) + ')':34s}{'ms':>10s}{'decode ms':>12s}{'ratio':>8s}")
    for height, width in SIZES:
        resized = cv2.resize(photo, (width, height), interpolation=cv2.INTER_CUBIC)
        images, jpeg = tensor(resized), cv2.imencode(".jpg", resized)[1]
        built_in = median_ms(lambda images=images: depth(images), repeats)
        decode = median_ms(lambda jpeg=jpeg: cv2.imdecode(jpeg, cv2.IMREAD_COLOR), repeats)
        print(f"{f'{height} x {width}':34s}{built_in:10.1f}{decode:12.2f}{built_in / decode:8.1f}")


def near_steps(inverse_depth: NDArray, photo: NDArray[np.uint8]) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Pixels within 3 px of depth steps of weak and of strong colour contrast (below and above the median step)."""
    kernel = np.ones((3, 3), np.uint8)
    step = cv2.morphologyEx(inverse_depth, cv2.MORPH_GRADIENT, kernel) > 0.03
    contrast = cv2.morphologyEx(cv2.blur(photo, (3, 3)), cv2.MORPH_GRADIENT, kernel).max(2)
    half = np.median(contrast[step]) if step.any() else 0

    def around(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
        return cv2.dilate(mask.astype(np.uint8), np.ones((7, 7), np.uint8)).astype(bool)

    weak, strong = around(step & (contrast < half)), around(step & (contrast >= half))
    return weak & ~strong, strong & ~weak


def mirror_table(files: list[Path], pictures: Path | None) -> None:
    differences, weak, strong, low = [], [], [], []
    for file in files:
        photo = cv2.cvtColor(cv2.imread(str(file), cv2.IMREAD_COLOR), cv2.COLOR_BGR2RGB)
        images = tensor(photo)
        inverse_depth = normalize_inverse_depth(depth(images))
        mirrored = normalize_inverse_depth(depth(images.flip(-1))).flip(-1)
        difference = (inverse_depth - mirrored).abs()[0, 0].numpy()
        at_weak, at_strong = near_steps(inverse_depth[0, 0].numpy(), photo)
        differences.append(difference.mean())
        confidence = flip_confidence(inverse_depth, mirrored)
        low.append(float((confidence < 0.5).float().mean()))
        if at_weak.any() and at_strong.any():
            weak.append(difference[at_weak].mean())
            strong.append(difference[at_strong].mean())
        if pictures is not None:
            panels = [cv2.cvtColor(photo, cv2.COLOR_RGB2BGR)]
            for panel, colours in ((inverse_depth, cv2.COLORMAP_TURBO), (confidence, cv2.COLORMAP_BONE)):
                panels.append(cv2.applyColorMap((panel[0, 0].numpy() * 255).astype(np.uint8), colours))
            cv2.imwrite(str(pictures / f"{file.stem}.png"), np.hstack(panels))
    median, high, worst = np.percentile(differences, (50, 90, 100))
    print(f"\nmirroring, {len(files)} photos: mean |D - D'| {np.mean(differences):.4f}", end="")
    print(f" (median photo {median:.4f}, 90th percentile {high:.4f}, worst {worst:.4f}; none in {sum(d == 0 for d in differences)})")
    print(f"    at depth steps of weak contrast {np.mean(weak):.4f}, of strong contrast {np.mean(strong):.4f}", end="")
    print(f"; confidence below 1/2 on {100 * np.mean(low):.1f} % of the pixels")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--stereo", type=Path, default=DATA / "stereo", metavar="DIR", help="folder of pairs as trainers/pairs_on_disk.py reads them"
    )
    parser.add_argument("--photos", type=Path, default=DATA / "photos", metavar="DIR", help="folder of JPEG photos")
    parser.add_argument("--count", type=int, default=60, metavar="N", help="how many photos, evenly spaced in the folder (default 60)")
    parser.add_argument("--pictures", type=Path, metavar="DIR", help="write PNG pictures of these photos to DIR")
    parser.add_argument("--repeats", type=int, default=9, metavar="N", help="repeats of each timing (default 9)")
    arguments = parser.parse_args()
    if arguments.count < 1 or arguments.repeats < 1:
        parser.error("--count and --repeats must be at least 1")
    warnings.simplefilter("ignore", BuiltinDepthWarning)
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    order_table(arguments.stereo)
    time_table(motorcycle().left, arguments.repeats)
    files = sorted(arguments.photos.glob("*.jpg"))
    if not files:
        print(f"\n(no photos in {arguments.photos}; see --photos)")
        return
    if arguments.pictures is not None:
        arguments.pictures.mkdir(parents=True, exist_ok=True)
    chosen = np.unique(np.linspace(0, len(files) - 1, arguments.count).astype(int))
    mirror_table([files[i] for i in chosen], arguments.pictures)


if __name__ == "__main__":
    main()
