import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from skimage.filters import sobel

from tests.oracles import nearest_sharp
from zsdata.synthesis.disparity import AdaptiveDisparity, UniformDisparity, dilate_disparity, sharpen_disparity, sobel_magnitude


def test_adaptive_scales_follow_the_papers_mixture():
    generator = np.random.default_rng(0)
    scales = np.array([AdaptiveDisparity().draw_scale(generator, 640) for _ in range(20_000)])
    assert scales.min() > 0 and scales.max() < 0.2
    assert np.mean(scales < 0.05) == pytest.approx(0.1, abs=0.01)
    assert np.mean(scales > 0.15) == pytest.approx(0.1, abs=0.01)
    assert np.mean(scales[(scales > 0.05) & (scales < 0.15)]) == pytest.approx(0.1, abs=0.001)


def test_each_range_of_adaptive_scales_has_a_probability_of_its_own():
    generator = np.random.default_rng(0)
    mixture = AdaptiveDisparity(center_probability=0.5, small_probability=0.4, large_probability=0.1)
    scales = np.array([mixture.draw_scale(generator, 640) for _ in range(5000)])
    assert np.mean(scales < 0.05) == pytest.approx(0.4, abs=0.03)
    assert np.mean(scales > 0.15) == pytest.approx(0.1, abs=0.03)


def test_uniform_scales_are_pixels_whatever_the_width():
    for width in (100, 2000):
        pixels = [UniformDisparity(min_px=20, max_px=30).draw_scale(np.random.default_rng(i), width) * width for i in range(200)]
        assert 20 <= min(pixels) < 21 and 29 < max(pixels) <= 30


@pytest.mark.parametrize("values", [{"center": 0.05, "radius": 0.05}, {"center": 0.95}, {"small_probability": 0.5}, {"radius": 0.0}])
def test_impossible_ranges_are_refused(values):
    with pytest.raises(ValueError, match="got"):
        AdaptiveDisparity(**values)


def test_dilation_grows_near_surfaces_by_a_cross():
    disparity = torch.zeros(1, 1, 7, 7)
    disparity[..., 3, 3] = 5
    grown = dilate_disparity(disparity, 1)
    assert grown.nonzero()[:, 2:].tolist() == [[2, 3], [3, 2], [3, 3], [3, 4], [4, 3]]
    assert dilate_disparity(disparity, 2).count_nonzero() == 13
    assert disparity.count_nonzero() == 1, "the input was changed"


@pytest.mark.parametrize("radius_px", [0, 1, 3])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_dilation_takes_the_largest_within_reach_of_each_map(radius_px, dtype):
    disparity = torch.rand(2, 1, 9, 14, dtype=dtype).transpose(2, 3)
    grown = dilate_disparity(disparity, radius_px)
    y, x = torch.meshgrid(torch.arange(14), torch.arange(9), indexing="ij")
    for v in range(14):
        for u in range(9):
            near = (y - v).abs() + (x - u).abs() <= radius_px
            assert torch.equal(grown[..., v, u], disparity[..., near].amax(-1))


def test_sobel_is_the_published_one():
    disparity = torch.rand(1, 1, 30, 40) * 50
    assert np.allclose(sobel_magnitude(disparity)[0, 0].numpy(), sobel(disparity[0, 0].numpy()), atol=1e-4)


@settings(max_examples=150, deadline=None)
@given(arrays(np.float32, st.tuples(st.integers(1, 9), st.integers(1, 9)), elements=st.sampled_from([0.0, 1.0, 2.0, 9.0, 30.0])))
def test_every_edge_takes_the_nearest_value_that_is_none(disparity):
    sharp = sharpen_disparity(torch.from_numpy(disparity).view(1, 1, *disparity.shape))[0, 0].numpy()
    edge = sobel_magnitude(torch.from_numpy(disparity).view(1, 1, *disparity.shape))[0, 0].numpy() > 3
    expected = disparity if edge.all() else nearest_sharp(disparity, edge)
    assert np.array_equal(sharp, expected)


@pytest.mark.parametrize("size", [(30, 7), (7, 60), (24, 24)])
def test_an_edge_far_from_every_value_finds_the_nearest(size):
    generator = np.random.default_rng(size[0])
    disparity = generator.random(size, dtype=np.float32) * 100
    for y, x in generator.integers((0, 0), (size[0] - 3, size[1] - 3), (3, 2)):
        disparity[y : y + 3, x : x + 3] = disparity[y, x]
    edge = sobel_magnitude(torch.from_numpy(disparity)[None, None])[0, 0].numpy() > 3
    assert 0.9 < edge.mean() < 1
    sharp = sharpen_disparity(torch.from_numpy(disparity)[None, None])[0, 0].numpy()
    assert np.array_equal(sharp, nearest_sharp(disparity, edge))


def test_a_map_that_is_edge_all_over_stays_as_it_is_beside_one_that_is_not():
    slope = torch.arange(0.0, 200, 10).expand(1, 1, 12, 20)
    step = torch.where(torch.arange(20) < 10, 10.0, 40.0).expand(1, 1, 12, 20)
    assert torch.equal(sharpen_disparity(torch.cat([slope, step, slope])), torch.cat([slope, step, slope]))


def test_a_blurred_step_becomes_a_step():
    ramp = torch.tensor([10.0] * 10 + [15, 20, 25, 30, 35] + [40.0] * 10).expand(1, 1, 8, 25).contiguous()
    sharp = sharpen_disparity(ramp)
    assert set(sharp.unique().tolist()) == {10.0, 40.0}


def test_maps_of_a_batch_do_not_mix():
    maps = torch.rand(3, 1, 12, 14) * 20
    together = sharpen_disparity(maps)
    for i in range(3):
        assert torch.equal(sharpen_disparity(maps[i : i + 1])[0], together[i])
