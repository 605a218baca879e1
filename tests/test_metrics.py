from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from tests import oracles_loss
from tests.oracles_scores import plain_edges
from zsdata.metrics import bad_pixel_rate, d1, disparity_edges, end_point_error, reconstruction_error, reconstruction_maps


def plain_metrics(prediction, disparity, valid, threshold):
    errors = [(abs(float(p) - float(d)), float(d)) for p, d, v in zip(prediction, disparity, valid, strict=True) if v]
    n = len(errors)
    return (
        sum(e for e, _ in errors) / n,
        sum(e > threshold for e, _ in errors) / n,
        sum(e > 3 and e / d > 0.05 for e, d in errors) / n,
    )


@pytest.mark.parametrize("threshold", [1.0, 2.0, 3.0])
def test_the_metrics_are_those_of_plain_loops(threshold):
    rng = np.random.default_rng(0)
    disparity = rng.uniform(1, 150, (2, 1, 9, 13)).astype(np.float32)
    prediction = disparity + rng.normal(0, 4, disparity.shape).astype(np.float32)
    valid = rng.random(disparity.shape) < 0.7
    expected = plain_metrics(prediction.ravel(), disparity.ravel(), valid.ravel(), threshold)
    maps = [torch.from_numpy(array) for array in (prediction, disparity, valid)]
    assert (end_point_error(*maps), bad_pixel_rate(*maps, threshold), d1(*maps)) == pytest.approx(expected, rel=1e-12)


def test_an_error_at_the_threshold_is_not_bad():
    disparity = torch.tensor([10.0, 10.0, 100.0, 100.0])
    prediction = torch.tensor([13.0, 13.5, 104.0, 106.0])
    valid = torch.ones(4, dtype=torch.bool)
    assert bad_pixel_rate(prediction, disparity, valid, 3) == 0.75
    assert d1(prediction, disparity, valid) == 0.5  # 4 px of 100 are within 5 %


def test_what_is_not_valid_is_not_looked_at():
    disparity = torch.tensor([5.0, math.inf, math.nan, 0.0])
    prediction = torch.tensor([7.0, 1.0, math.nan, math.inf])
    valid = torch.tensor([True, False, False, False])
    assert end_point_error(prediction, disparity, valid) == 2.0
    assert bad_pixel_rate(prediction, disparity, valid, 1) == 1.0


def test_a_picture_without_a_valid_pixel_has_no_error():
    disparity = torch.ones(3, 4)
    nothing = torch.zeros(3, 4, dtype=torch.bool)
    assert math.isnan(end_point_error(disparity, disparity, nothing))
    assert math.isnan(bad_pixel_rate(disparity, disparity, nothing, 1))
    assert math.isnan(d1(disparity, disparity, nothing))


def test_a_large_picture_loses_no_precision():
    disparity = torch.full((2000, 3000), 100.0)
    prediction = disparity + 0.125
    assert end_point_error(prediction, disparity, torch.ones(2000, 3000, dtype=torch.bool)) == 0.125


def test_what_does_not_fit_is_named():
    disparity = torch.ones(2, 3)
    valid = torch.ones(2, 3, dtype=torch.bool)
    with pytest.raises(ValueError, match=r"\[2, 2\], \[2, 3\]"):
        end_point_error(disparity[:, 1:], disparity, valid)
    with pytest.raises(TypeError, match="float32"):
        d1(disparity, disparity, valid.float())
    with pytest.raises(ValueError, match="prediction is not finite at 6 of 6"):
        d1(disparity * math.nan, disparity, valid)
    with pytest.raises(ValueError, match="disparity is not finite at 6 of 6"):
        bad_pixel_rate(disparity, disparity * math.inf, valid, 1)
    with pytest.raises(ValueError, match="threshold_px"):
        bad_pixel_rate(disparity, disparity, valid, 0)


@pytest.mark.parametrize("density", [1.0, 0.7, 0.25, 0.02])
@pytest.mark.parametrize(("jump", "reach", "margin"), [(2.0, 4, 5), (1.0, 1, 0), (3.0, 30, 2)])
def test_edges_are_those_of_plain_loops(density, jump, reach, margin):
    rng = np.random.default_rng(1)
    disparity = np.repeat(np.repeat(rng.uniform(1, 12, (3, 4)), 7, axis=0), 6, axis=1).astype(np.float32)
    valid = rng.random(disparity.shape) < density
    disparity[~valid] = rng.choice([0, np.inf, np.nan], (~valid).sum())
    found = disparity_edges(torch.from_numpy(disparity), torch.from_numpy(valid), jump_px=jump, reach_px=reach, margin_px=margin)
    np.testing.assert_array_equal(found.numpy(), plain_edges(disparity, valid, jump, reach, margin))


def test_an_edge_is_as_wide_as_its_margin_and_a_slope_is_none():
    step = torch.full((1, 1, 20, 40), 10.0)
    step[..., 20:] = 12.5
    everywhere = torch.ones_like(step, dtype=torch.bool)
    edges = disparity_edges(step, everywhere)
    assert edges.shape == step.shape and edges[..., 14:26].all() and edges.sum() == 12 * 20
    slope = torch.arange(40.0).mul(1.9).expand(20, 40)
    assert not disparity_edges(slope, everywhere[0, 0]).any()
    hole = everywhere.clone()
    hole[..., 17:23] = False  # wider than an edge can be told
    assert not disparity_edges(step, hole).any()


def test_edges_of_tiny_and_empty_maps():
    assert not disparity_edges(torch.ones(1, 1), torch.ones(1, 1, dtype=torch.bool)).any()
    assert not disparity_edges(torch.ones(5, 6), torch.zeros(5, 6, dtype=torch.bool)).any()


def test_edges_of_what_does_not_fit_are_refused():
    disparity, valid = torch.ones(2, 3), torch.ones(2, 3, dtype=torch.bool)
    with pytest.raises(ValueError, match=r"\[2, 3\] and \[2, 2\]"):
        disparity_edges(disparity, valid[:, 1:])
    with pytest.raises(TypeError, match="float32"):
        disparity_edges(disparity, disparity)
    for wrong in ({"jump_px": 0}, {"reach_px": 0}, {"margin_px": -1}):
        with pytest.raises(ValueError, match="jump_px is positive"):
            disparity_edges(disparity, valid, **wrong)


def pair_with_label(seed, batch=2, height=9, width=14):
    generator = np.random.default_rng(seed)
    left, right = generator.uniform(0, 255, (2, batch, 3, height, width)).astype(np.float32)
    disparity = generator.uniform(0, 6, (batch, 1, height, width)).astype(np.float32)
    return left, right, disparity, generator.random(disparity.shape) < 0.6


def test_the_reconstruction_errors_are_those_of_the_paper_as_plain_loops():
    left, right, disparity, mask = pair_with_label(0)
    found = reconstruction_error(*(torch.from_numpy(array) for array in (left, right, disparity, mask)))
    whole = reconstruction_error(*(torch.from_numpy(array) for array in (left, right, disparity)))
    for i in range(len(left)):
        photometric, abs_err, dissimilarity = (
            oracles_loss.photometric_loss(left[i] / 255.0, right[i] / 255.0, disparity[i, 0], beta) for beta in (0.85, 0.0, 1.0)
        )
        for means, counted in ((found, mask[i, 0]), (whole, np.ones_like(mask[i, 0]))):
            assert float(means.abs_err[i]) == pytest.approx(abs_err[counted].mean(), abs=1e-6)
            assert float(means.ssim[i]) == pytest.approx(1 - 2 * dissimilarity[counted].mean(), abs=1e-5)
            assert float(means.photometric[i]) == pytest.approx(photometric[counted].mean(), abs=1e-5)


def test_a_photo_that_is_its_own_right_view_is_reconstructed_exactly():
    left = torch.from_numpy(pair_with_label(1)[0])
    means = reconstruction_error(left, left, torch.zeros_like(left[:, :1]))
    assert means.abs_err.tolist() == [0, 0]
    assert means.ssim.tolist() == pytest.approx([1, 1], abs=1e-6)
    assert means.photometric.tolist() == pytest.approx([0, 0], abs=1e-6)


def test_the_errors_of_one_image_do_not_reach_the_others():
    left, right, disparity, mask = (torch.from_numpy(array) for array in pair_with_label(2, batch=3))
    mask[1] = False
    means = reconstruction_error(left, right, disparity, mask)
    for i in (0, 2):
        alone = reconstruction_error(left[i : i + 1], right[i : i + 1], disparity[i : i + 1], mask[i : i + 1])
        assert [float(values[i]) for values in means] == [float(values) for values in alone]
    assert all(math.isnan(values[1]) for values in means)


def test_what_does_not_fit_for_a_reconstruction_is_named():
    left, right, disparity, mask = (torch.from_numpy(array) for array in pair_with_label(3))
    with pytest.raises(ValueError, match=r"\[2, 3, 9, 14\] and \[2, 3, 9, 13\]"):
        reconstruction_maps(left, right[..., 1:], disparity)
    with pytest.raises(ValueError, match="at least 4 px"):
        reconstruction_maps(left[..., :3, :], right[..., :3, :], disparity[..., :3, :])
    with pytest.raises(ValueError, match=r"disparity \[B, 1, H, W\]"):
        reconstruction_maps(left, right, disparity[..., 1:])
    with pytest.raises(ValueError, match="finite everywhere"):
        reconstruction_maps(left, right, torch.where(mask, disparity, math.nan))
    with pytest.raises(ValueError, match=r"\[2, 1, 9, 13\] and \[2, 1, 9, 14\]"):
        reconstruction_error(left, right, disparity, mask[..., 1:])
    with pytest.raises(TypeError, match="float32"):
        reconstruction_error(left, right, disparity, mask.float())
