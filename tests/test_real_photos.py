"""End to end on real photographs: the development photos where they are, and those that scikit-image ships everywhere."""

from collections import Counter

import pytest
import torch

from tests.scenes import SHARED
from zsdata import AdaptiveDisparity, AugmentConfig, ZeroStereoStream, backward_warp
from zsdata.example_photos import pack_example_photos
from zsdata.source.pack import pack

pytestmark = pytest.mark.filterwarnings("ignore::zsdata.synthesis.depth.builtin.BuiltinDepthWarning")


@pytest.fixture(scope="module", params=["scikit-image", "development"])
def photos(request, tmp_path_factory):
    """(tars of photos, how many pairs to look at)"""
    output = tmp_path_factory.mktemp("photos")
    if request.param == "scikit-image":
        pack_example_photos(output)
        return output, 8
    if not (SHARED / "data" / "photos").is_dir():
        pytest.skip("the development photos are not here")
    pack(SHARED / "data" / "photos", output)
    return output, 48


def known_pixels(pair):
    """bool [1, H, W]: left pixels that are visible in the right image, at a place that was not invented."""
    known = backward_warp((~pair.masks.inpaint)[None].float(), pair.disparity[None])[0] > 0.999
    return known & pair.masks.nonocclusion


def test_every_batch_is_finite_and_every_label_reprojects(photos):
    tars, count = photos
    stream = ZeroStereoStream(tars, epoch_size=count)
    errors, pixels = [], []
    with stream.loader(4, num_workers=2) as loader:
        for batch in loader:
            for pair in (batch[i] for i in range(4)):
                for tensor in (pair.left, pair.right, pair.left_clean, pair.right_clean, pair.disparity, pair.confidence):
                    assert torch.isfinite(tensor).all()
                for image in (pair.left, pair.right, pair.left_clean, pair.right_clean):
                    assert image.min() >= 0 and image.max() <= 255
                width_in_crop = pair.meta["photo_size"][1] * pair.meta["scale_x"]
                assert pair.disparity.min() > 0 and pair.disparity.max() <= 0.2 * width_in_crop + 1e-3
                assert 0 <= pair.confidence.min() and pair.confidence.max() <= 1
                known = known_pixels(pair)
                back = backward_warp(pair.right_clean[None], pair.disparity[None])[0]
                errors.append((back - pair.left_clean).abs().mean(0, keepdim=True)[known].sum().item())
                pixels.append(int(known.sum()))
        assert loader.stats()["rejected"] == {} and loader.stats()["pairs"] == count
    assert sum(errors) / sum(pixels) < 2
    assert sum(pixels) / (count * 384 * 512) > 0.6


def test_holes_are_filled_with_more_than_one_colour(photos):
    tars, _ = photos
    stream = ZeroStereoStream(tars, epoch_size=4, augmentation=AugmentConfig.none())
    for pair in stream:
        hole = pair.masks.inpaint[0]
        if hole.float().mean() > 0.01:
            filled = pair.right_clean[:, hole]
            assert (filled.std(1) > 1).all(), "the holes were left at one colour"
            # A hole that nobody filled is black.
            assert (filled.sum(0) == 0).float().mean() < 0.2


def test_confidence_is_low_somewhere_and_high_in_most_places(photos):
    tars, _ = photos
    confidences = torch.stack([pair.confidence for pair in ZeroStereoStream(tars, epoch_size=6)])
    assert confidences.min() < 0.5 and confidences.median() > 0.7


def test_scales_follow_the_papers_distribution_over_the_stream(photos):
    tars, _ = photos
    stream = ZeroStereoStream(tars, epoch_size=8, disparity=AdaptiveDisparity(center=0.1, radius=0.02))
    counts = Counter(0.06 < pair.meta["disparity_scale"] < 0.14 for pair in stream)
    assert counts == {True: 8}
