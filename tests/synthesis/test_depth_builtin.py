from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from scipy.stats import spearmanr
from torch import Tensor

from trainers.pairs_on_disk import StereoPair, find_pairs, motorcycle, read_pair
from zsdata.synthesis.confidence import normalize_inverse_depth
from zsdata.synthesis.depth import builtin
from zsdata.synthesis.depth.builtin import BuiltinDepth, BuiltinDepthWarning

pytestmark = pytest.mark.filterwarnings("ignore::zsdata.synthesis.depth.builtin.BuiltinDepthWarning")

SHARED = Path(__file__).resolve().parents[2] / ".." / "shared" / "data"
depth = BuiltinDepth()


def noise(height: int, width: int, seed: int = 0) -> Tensor:
    return torch.rand(1, 3, height, width, generator=torch.Generator().manual_seed(seed)) * 255


def standing(height: int, width: int, grain: float = 6.0) -> tuple[Tensor, np.ndarray]:
    """A red post that stands on a brown ground in front of a blue sky, all with noise; the image and the post's mask."""
    y, x = (np.mgrid[:height, :width] + 0.5) / np.array([height, width])[:, None, None]
    post = (0.35 < x) & (x < 0.6) & (0.25 < y) & (y < 0.8)
    image = np.where((y > 0.5)[..., None], (120.0, 110.0, 80.0), (150.0, 190.0, 230.0))
    image[post] = 200, 60, 50
    image += np.random.default_rng(0).normal(0, grain, (height, width, 1))
    return torch.from_numpy(image.clip(0, 255)).permute(2, 0, 1)[None].float(), post


def example_photos() -> list[Tensor]:
    from skimage import data

    return [torch.from_numpy(photo).permute(2, 0, 1)[None].float() for photo in (data.astronaut(), data.coffee(), data.chelsea())]


@pytest.mark.parametrize("size", [(1, 1), (1, 9), (9, 1), (2, 2), (6, 7), (8, 15), (3, 700), (600, 2), (33, 47)])
def test_any_size_gives_a_finite_map_of_that_size(size):
    for images in (noise(*size), torch.zeros(1, 3, *size), torch.full((1, 3, *size), 255.0)):
        inverse_depth = depth(images)
        assert inverse_depth.shape == (1, 1, *size) and inverse_depth.dtype == torch.float32
        assert torch.isfinite(inverse_depth).all()


def test_a_constant_photo_is_a_ground_plane():
    inverse_depth = depth(torch.full((1, 3, 60, 80), 90.0))[0, 0]
    rows = inverse_depth.mean(1)
    assert (rows.diff() >= 0).all() and rows[-1] > rows[0]
    assert torch.allclose(inverse_depth, rows[:, None].expand(60, 80), atol=0.02)


def test_a_grey_photo_has_depth():
    images, post = standing(120, 160)
    inverse_depth = depth(images.mean(1, keepdim=True).expand(-1, 3, -1, -1))[0, 0].numpy()
    assert inverse_depth[post].mean() > inverse_depth[: 120 // 2][~post[: 120 // 2]].mean()


def test_an_empty_batch_stays_empty():
    assert depth(torch.zeros(0, 3, 8, 8)).shape == (0, 1, 8, 8)


@pytest.mark.parametrize(
    "images", [torch.zeros(3, 8, 8), torch.zeros(1, 1, 8, 8), torch.zeros(1, 3, 0, 8), torch.zeros(1, 3, 8, 8, dtype=torch.uint8)]
)
def test_other_shapes_and_dtypes_are_refused(images):
    with pytest.raises(ValueError, match=r"float tensor \[B, 3, H, W\]"):
        depth(images)


def test_a_photo_with_nan_is_refused():
    images = noise(20, 30)
    images[0, 1, 4, 5] = torch.nan
    with pytest.raises(ValueError, match="finite"):
        depth(images)


def test_half_precision_and_strided_photos_give_the_same_as_plain_ones():
    images = noise(40, 50).round()
    assert torch.equal(depth(images.half()), depth(images))
    assert torch.equal(depth(images.permute(0, 2, 3, 1).contiguous().permute(0, 3, 1, 2)), depth(images))


def test_the_photos_are_left_as_they_were():
    images = noise(40, 50)
    before = images.clone()
    depth(images)
    assert torch.equal(images, before)


def test_the_same_bits_in_any_batch_and_with_any_number_of_threads():
    photos = torch.cat([standing(500, 620)[0], noise(500, 620, 1), standing(500, 620, grain=20)[0]])
    threads = torch.get_num_threads(), cv2.getNumThreads()
    try:
        torch.set_num_threads(1)
        cv2.setNumThreads(1)
        batch = depth(photos)
        torch.set_num_threads(2)
        cv2.setNumThreads(2)
        assert torch.equal(depth(photos), batch)
        for i in range(3):
            assert torch.equal(depth(photos[i : i + 1]), batch[i : i + 1])
    finally:
        torch.set_num_threads(threads[0])
        cv2.setNumThreads(threads[1])


def test_it_says_once_that_a_network_is_better(monkeypatch):
    monkeypatch.setattr(builtin, "_said", False)
    with pytest.warns(BuiltinDepthWarning, match="Depth-Anything-V2") as said:
        depth(noise(8, 8))
        depth(noise(8, 8))
    assert len(said) == 1
    assert said[0].filename == __file__


@pytest.mark.parametrize("size", [(240, 320), (480, 640), (700, 930), (1536, 2048)])
def test_depth_jumps_at_the_pixel_where_the_colour_does(size):
    images, post = standing(*size)
    inverse_depth = depth(images)[0, 0].numpy()
    rows = range(int(0.27 * size[0]), int(0.48 * size[0]))  # in front of the sky
    off = []
    for row in rows:
        for edge in np.flatnonzero(np.diff(post[row])):
            step = np.abs(np.diff(inverse_depth[row, edge - 10 : edge + 12]))
            off.append(abs(int(step.argmax()) - 10))
            assert step.max() > 0.8 * step.sum(), "one jump, not a ramp"
    assert np.mean(np.array(off) <= 1) > 0.97


def test_what_stands_on_the_ground_is_nearer_than_what_is_behind_it():
    images, post = standing(240, 320)
    inverse_depth = normalize_inverse_depth(depth(images))[0, 0].numpy()
    sky = inverse_depth[:110][~post[:110]]
    assert np.percentile(inverse_depth[post], 5) > np.percentile(sky, 95) + 0.2
    for row in range(130, 180, 10):  # ground beside the post, at the same height in the image
        assert inverse_depth[row][post[row]].mean() > inverse_depth[row][~post[row]].mean()
    ground = inverse_depth[200:, :].mean(1)
    assert ground[-1] > ground[0]


def test_surfaces_are_smooth_between_their_edges():
    images, post = standing(480, 640)
    inverse_depth = depth(images)[0, 0].numpy()
    inside = cv2.erode(post.astype(np.uint8), np.ones((25, 25))).astype(bool)
    steps = np.abs(np.diff(inverse_depth, axis=1))[:, :-1][inside[:, 1:-1]]
    assert np.percentile(steps, 99) < 0.002
    assert np.ptp(inverse_depth) > 0.3


def difference(images: Tensor) -> Tensor:
    """|D - D'| of the normalised depth and that of the mirrored photo, mirrored back, [H, W]."""
    return (normalize_inverse_depth(depth(images)) - normalize_inverse_depth(depth(images.flip(-1))).flip(-1)).abs()[0, 0]


def test_a_clear_scene_is_the_same_in_the_mirror():
    assert difference(standing(480, 640, grain=0.0)[0]).mean() < 0.005
    assert difference(standing(480, 640)[0]).mean() < 0.005


def test_real_photos_change_a_little_in_the_mirror():
    for photo in example_photos():
        change = difference(photo)
        assert 0.001 < change.mean() < 0.06
        assert change.max() > 3 * change.mean()  # in some places more than in others


def test_a_scene_that_drowns_in_noise_changes_more_in_the_mirror_than_a_clear_one():
    assert difference(standing(480, 640, grain=40.0)[0]).mean() > 5 * difference(standing(480, 640)[0]).mean()


def order(pair: StereoPair) -> tuple[float, float]:
    """Spearman's correlation with the true disparity: of the built-in depth, and of the image row."""
    inverse_depth = depth(torch.from_numpy(pair.left).permute(2, 0, 1)[None].float())[0, 0].numpy()
    row = np.broadcast_to(np.arange(pair.disparity.shape[0])[:, None], pair.disparity.shape)
    truth = pair.disparity[pair.valid]
    return spearmanr(inverse_depth[pair.valid], truth).statistic, spearmanr(row[pair.valid], truth).statistic


def test_the_order_beats_a_ramp_on_the_motorcycle():
    built_in, row = order(motorcycle())
    assert built_in > row


@pytest.mark.skipif(not (SHARED / "stereo").is_dir(), reason="needs shared/data/stereo")
def test_the_order_beats_a_ramp_on_the_mean_of_real_pairs():
    built_in, row = np.mean([order(read_pair(folder)) for folder in find_pairs(SHARED / "stereo")], 0)
    assert built_in > row + 0.05


@pytest.mark.skipif(not (SHARED / "photos").is_dir(), reason="needs shared/data/photos")
def test_photos_change_a_little_in_the_mirror_and_more_where_edges_are_weak():
    means, weak, strong = [], [], []
    for file in sorted((SHARED / "photos").glob("*.jpg"))[::20]:
        photo = cv2.cvtColor(cv2.imread(str(file)), cv2.COLOR_BGR2RGB)
        images = torch.from_numpy(photo).permute(2, 0, 1)[None].float()
        change = difference(images).numpy()
        means.append(change.mean())
        kernel = np.ones((3, 3), np.uint8)
        step = cv2.morphologyEx(normalize_inverse_depth(depth(images))[0, 0].numpy(), cv2.MORPH_GRADIENT, kernel) > 0.03
        contrast = cv2.morphologyEx(cv2.blur(photo, (3, 3)), cv2.MORPH_GRADIENT, kernel).max(2)
        weak.append(change[step & (contrast < np.median(contrast[step]))].mean())
        strong.append(change[step & (contrast >= np.median(contrast[step]))].mean())
    assert 0.001 < np.mean(means) < 0.05
    assert np.mean(weak) > np.mean(strong)
