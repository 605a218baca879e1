"""What is behind an object: how close does each inpainter come to what the right camera really saw?

python benchmarks/inpainting.py [--stereo ../shared/data/stereo] [--pictures DIR]

The left image of each pair is warped with its true disparity; the holes are filled and compared with the true right image: PSNR over hole
pixels, SSIM averaged over hole pixels (with the true image outside of holes), and texture: the energy of the horizontal and of the vertical
gradient inside holes as a share of the true one. A smear is near 0; 1 is as rough as the truth, which has edges of things in it.

Where the left image has no true disparity, the farther neighbour of the row stands in, so that nothing tears; a hole pixel is scored
only where the pixels at both ends of its run come from true disparities. Pairs whose truth is sparser than DENSE are left out, and a
table leaves out pairs with fewer than FEWEST_PX scored pixels. "Inner" holes are connected areas (8 neighbours) that do not touch the
frame's edge. The random background is the left image of the next pair, resized.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from skimage.metrics import structural_similarity
from torch import Tensor

from trainers.pairs_on_disk import StereoPair, find_pairs, motorcycle, read_pair
from zsdata.synthesis.inpaint.background import RandomBackground
from zsdata.synthesis.inpaint.builtin import BuiltinInpainter
from zsdata.synthesis.warp import forward_warp

STEREO = Path(__file__).resolve().parents[2] / "shared" / "data" / "stereo"
DENSE = 0.9
FEWEST_PX = 200
CROP = (384, 512)
JPEG_QUALITY = 95


class Case(NamedTuple):
    """A warped pair: [1, C, H, W] tensors, and [H, W] masks of the hole pixels that each table scores."""

    name: str
    truth: NDArray[np.float64]  # the true right image, [H, W, 3]
    right: Tensor
    inpaint_mask: Tensor
    right_disparity: Tensor
    background: Tensor
    inner: NDArray[np.bool_]
    scored: NDArray[np.bool_]


class Score(NamedTuple):
    psnr: float
    ssim: float
    texture_x: float
    texture_y: float


def tensor(image: NDArray) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(image.transpose(2, 0, 1), dtype=np.float32))[None]


def array(image: Tensor) -> NDArray[np.float64]:
    return image[0].permute(1, 2, 0).double().numpy()


def row_ends(inside: NDArray[np.bool_]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """For every pixel the nearest column to the left, -1 for none, and to the right, W for none, that is not `inside`."""
    column = np.arange(inside.shape[1])
    left = np.maximum.accumulate(np.where(inside, -1, column), axis=1)
    right = np.minimum.accumulate(np.where(inside, inside.shape[1], column)[:, ::-1], axis=1)[:, ::-1]
    return left, right


def at_columns(values: NDArray, columns: NDArray[np.int64], outside: float) -> NDArray:
    width = values.shape[1]
    taken = np.take_along_axis(values, columns.clip(0, width - 1), axis=1)
    return np.where((columns >= 0) & (columns < width), taken, outside)


def dense_disparity(pair: StereoPair) -> NDArray[np.float32]:
    left, right = row_ends(~pair.valid)
    farther = np.minimum(at_columns(pair.disparity, left, np.inf), at_columns(pair.disparity, right, np.inf))
    smallest = pair.disparity[pair.valid].min()
    return np.where(pair.valid, pair.disparity, np.where(np.isfinite(farther), farther, smallest)).astype(np.float32)


def make_case(pair: StereoPair, background: NDArray[np.uint8]) -> Case:
    left = np.concatenate([pair.left, np.where(pair.valid, 255, 0)[..., None]], axis=2)
    warped = forward_warp(tensor(left), torch.from_numpy(dense_disparity(pair))[None, None])
    hole = warped.inpaint_mask[0, 0].numpy()
    true_disparity = (warped.right[0, 3] == 255).numpy()
    begins, ends = row_ends(hole)
    scored = hole & at_columns(true_disparity, begins, True).astype(bool) & at_columns(true_disparity, ends, True).astype(bool)
    _, component = cv2.connectedComponents(hole.astype(np.uint8), connectivity=8)
    at_edge = np.concatenate([component[0], component[-1], component[:, 0], component[:, -1]])
    other = cv2.resize(background, hole.shape[::-1], interpolation=cv2.INTER_AREA)
    return Case(
        pair.name,
        pair.right.astype(np.float64),
        warped.right[:, :3].contiguous(),
        warped.inpaint_mask,
        warped.right_disparity,
        tensor(other),
        scored & ~np.isin(component, at_edge),
        scored,
    )


def cases(stereo: Path) -> Iterator[Case]:
    """Every pair below `stereo` (if there) with dense truth, and the motorcycle."""
    pairs = [read_pair(folder) for folder in find_pairs(stereo)] if stereo.is_dir() else []
    pairs = [pair for pair in pairs if pair.valid.mean() >= DENSE] + [motorcycle()]
    for pair, following in zip(pairs, pairs[1:] + pairs[:1], strict=True):
        yield make_case(pair, following.left)


def builtin(case: Case) -> Tensor:
    return BuiltinInpainter()(case.right, case.inpaint_mask, None, case.right_disparity)


def builtin_without_disparity(case: Case) -> Tensor:
    return BuiltinInpainter()(case.right, case.inpaint_mask)


def replication(case: Case) -> Tensor:
    """The pixel at the farther end of the run, for the whole run."""
    hole, disparity = case.inpaint_mask[0, 0].numpy(), case.right_disparity[0, 0].numpy()
    left, right = row_ends(hole)
    to_right = at_columns(disparity, right, np.inf) <= at_columns(disparity, left, np.inf)
    source = np.where(to_right, right, left).clip(0, hole.shape[1] - 1)
    return case.right.gather(3, torch.from_numpy(np.where(hole, source, np.arange(hole.shape[1])))[None, None].expand_as(case.right))


def opencv(method: int) -> Callable[[Case], Tensor]:
    def inpaint(case: Case) -> Tensor:
        image = case.right[0].permute(1, 2, 0).round().byte().numpy()
        return tensor(cv2.inpaint(image, case.inpaint_mask[0, 0].byte().numpy(), 3, method))

    return inpaint


def random_background(case: Case) -> Tensor:
    return RandomBackground()(case.right, case.inpaint_mask, None, case.background)


METHODS: dict[str, Callable[[Case], Tensor]] = {
    "built-in": builtin,
    "no disparity": builtin_without_disparity,
    "replication": replication,
    "cv2 telea": opencv(cv2.INPAINT_TELEA),
    "cv2 ns": opencv(cv2.INPAINT_NS),
    "background": random_background,
}


def gradient_energy(image: NDArray[np.float64], counted: NDArray[np.bool_]) -> tuple[float, float]:
    """Mean squared horizontal and vertical difference of grey levels between neighbours that are both counted."""
    grey = image.mean(-1)
    across = np.diff(grey, axis=1)[counted[:, 1:] & counted[:, :-1]]
    down = np.diff(grey, axis=0)[counted[1:] & counted[:-1]]
    return float((across**2).mean()), float((down**2).mean())


def score(case: Case, filled: Tensor, counted: NDArray[np.bool_]) -> Score:
    image = np.where(case.inpaint_mask[0, 0].numpy()[..., None], array(filled), case.truth)
    error = ((image - case.truth)[counted] ** 2).mean()
    similarity = np.asarray(structural_similarity(case.truth, image, channel_axis=-1, data_range=255, full=True)[1])
    made, true = gradient_energy(image, counted), gradient_energy(case.truth, counted)
    return Score(float(10 * np.log10(255**2 / error)), float(similarity.mean(-1)[counted].mean()), made[0] / true[0], made[1] / true[1])


def milliseconds(work: Callable[[], object], repeats: int) -> float:
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        seconds.append(time.perf_counter() - start)
    return 1e3 * min(seconds)


def print_table(title: str, names: list[str], scores: dict[str, list[Score]]) -> None:
    print(f"\n{title} (PSNR in dB, SSIM)")
    print(f"{'':32s}" + "".join(f"{method:>15s}" for method in scores))
    for row, name in enumerate(names):
        print(f"{name:32s}" + "".join(f"{of[row].psnr:9.2f} {of[row].ssim:.3f}" for of in scores.values()))
    means = {method: np.mean(of, axis=0) for method, of in scores.items()}
    print(f"{'mean':32s}" + "".join(f"{mean[0]:9.2f} {mean[1]:.3f}" for mean in means.values()))
    medians = {method: np.median(of, axis=0) for method, of in scores.items()}
    print(f"{'median':32s}" + "".join(f"{median[0]:9.2f} {median[1]:.3f}" for median in medians.values()))
    print(f"{'texture x, y (median share)':32s}" + "".join(f"{median[2]:9.2f}  {median[3]:.2f}" for median in medians.values()))


def print_times(case: Case) -> None:
    """Of one crop, on one thread."""
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    height, width = case.right.shape[2:]
    top, left = (height - CROP[0]) // 2, (width - CROP[1]) // 2
    window = (..., slice(top, top + CROP[0]), slice(left, left + CROP[1]))
    crop = case._replace(
        right=case.right[window].contiguous(),
        inpaint_mask=case.inpaint_mask[window].contiguous(),
        right_disparity=case.right_disparity[window].contiguous(),
        background=case.background[window].contiguous(),
    )
    jpeg = cv2.imencode(".jpg", array(crop.right).astype(np.uint8)[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1]
    decode = milliseconds(lambda: cv2.imdecode(jpeg, cv2.IMREAD_COLOR), 50)
    share = float(crop.inpaint_mask.float().mean())
    print(f"\none thread, {CROP[0]}x{CROP[1]} crop of {case.name}, {share:.0%} holes; decoding it takes {decode:.2f} ms")
    for method, inpaint in METHODS.items():
        taken = milliseconds(lambda inpaint=inpaint: inpaint(crop), 10)
        print(f"{method:32s}{taken:8.1f} ms {taken / decode:6.1f} x JPEG decode")


def save_pictures(case: Case, filled: dict[str, Tensor], folder: Path) -> None:
    """True right image, holes in magenta, and every method, side by side."""
    holes = array(case.right)
    holes[case.inpaint_mask[0, 0].numpy()] = (255, 0, 255)
    tiles = [case.truth, holes, *(array(image) for image in filled.values())]
    half = len(tiles) // 2
    sheet = np.vstack([np.hstack(tiles[:half]), np.hstack(tiles[half:])])
    cv2.imwrite(str(folder / f"{case.name}.png"), sheet.round().astype(np.uint8)[..., ::-1])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--stereo", type=Path, default=STEREO, help="folder of pairs; without it only the motorcycle is scored")
    parser.add_argument("--pictures", type=Path, help="write a picture of every pair into this folder")
    options = parser.parse_args()
    if options.pictures:
        options.pictures.mkdir(parents=True, exist_ok=True)
    tables = {"inner holes": (list[str](), {method: list[Score]() for method in METHODS})}
    tables["all holes"] = ([], {method: [] for method in METHODS})
    case = None
    for case in cases(options.stereo):
        filled = {method: inpaint(case) for method, inpaint in METHODS.items()}
        for (names, scores), counted in zip(tables.values(), (case.inner, case.scored), strict=True):
            if counted.sum() >= FEWEST_PX:
                names.append(case.name)
                for method, image in filled.items():
                    scores[method].append(score(case, image, counted))
        if options.pictures:
            save_pictures(case, filled, options.pictures)
    for title, (names, scores) in tables.items():
        print_table(title, names, scores)
    if case is not None:
        print_times(case)


if __name__ == "__main__":
    main()
