from __future__ import annotations

import numpy as np
import pytest

from zsdata.synthesis.depth.regions import LAB_WEIGHTS, merge, superpixels


def photo(height: int = 60, width: int = 83, grain: float = 0.0) -> np.ndarray:
    """Four flat tiles, with noise of that standard deviation."""
    tiles = np.array([[[200, 40, 40], [40, 200, 40]], [[40, 40, 200], [200, 200, 40]]], np.float64)
    image = tiles[np.arange(height) * 2 // height][:, np.arange(width) * 2 // width]
    return (image + np.random.default_rng(0).normal(0, grain, image.shape)).clip(0, 255).astype(np.uint8)


@pytest.mark.parametrize("size", [(1, 1), (1, 20), (20, 1), (7, 7), (8, 8), (60, 83)])
def test_superpixels_are_numbered_from_zero_without_gaps(size):
    labels, finest = superpixels(photo(*size))
    assert labels.shape == size
    assert np.array_equal(np.unique(labels), np.arange(len(finest.pixels)))
    assert np.array_equal(finest.pixels, np.bincount(labels.ravel()))


@pytest.mark.parametrize(("grain", "most"), [(0.0, 0.0), (4.0, 0.01)])
def test_superpixels_end_on_strong_edges(grain, most):
    labels, _ = superpixels(photo(grain=grain))
    tile = (np.arange(60) * 2 // 60)[:, None] * 2 + np.arange(83) * 2 // 83
    counts = np.bincount((labels * 4 + tile).ravel(), minlength=4 * (labels.max() + 1)).reshape(-1, 4)
    outside = counts.sum() - counts.max(1).sum()  # pixels that lie in another tile than the most of their superpixel
    assert outside <= most * labels.size


def test_merging_ends_at_the_four_tiles_and_then_at_one_region():
    labels, finest = superpixels(photo())
    tiles = merge(finest, 10.0)[-1]
    assert len(tiles.pixels) == 4
    assert len({tiles.region_of[labels[y, x]] for y in (5, 50) for x in (5, 70)}) == 4
    assert len(merge(finest, np.inf)[-1].pixels) == 1


def test_every_round_joins_regions_of_the_round_before_and_keeps_their_numbers_right():
    image = np.random.default_rng(1).integers(0, 255, (40, 50, 3), np.uint8)
    labels, finest = superpixels(image)
    before = finest
    for partition in merge(finest, np.inf):
        assert len(partition.pixels) < len(before.pixels)
        for region in range(len(before.pixels)):
            assert len(np.unique(partition.region_of[before.region_of == region])) == 1
        regions = partition.region_of[labels]
        assert np.array_equal(partition.pixels, np.bincount(regions.ravel()))
        borders = {}
        for a, b in ((regions[:, :-1], regions[:, 1:]), (regions[:-1], regions[1:])):
            for pair in zip(np.minimum(a, b).ravel(), np.maximum(a, b).ravel(), strict=True):
                if pair[0] != pair[1]:
                    borders[pair] = borders.get(pair, 0) + 1
        assert {(a, b): n for a, b, n in zip(partition.first, partition.second, partition.length, strict=True)} == borders
        for region in range(len(partition.pixels)):
            members = partition.region_of == region
            mean = (finest.colour[members] * finest.pixels[members, None]).sum(0) / finest.pixels[members].sum()
            assert np.allclose(partition.colour[region], mean)
        before = partition
    assert len(before.first) == 0


def test_colours_are_weighted_lab():
    _, finest = superpixels(np.full((20, 20, 3), 128, np.uint8))
    assert np.allclose(finest.colour / LAB_WEIGHTS, [137, 128, 128], atol=1.5)  # OpenCV's 8-bit Lab of middle grey
