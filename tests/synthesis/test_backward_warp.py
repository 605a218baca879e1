from __future__ import annotations

import numpy as np
import pytest
import torch
import torch.nn.functional as F

from tests import oracles_loss
from zsdata.synthesis.backward_warp import backward_warp


def grid_sample(image: torch.Tensor, disparity: torch.Tensor, mode: str, padding: str) -> torch.Tensor:
    _, _, height, width = image.shape
    x = torch.arange(width, dtype=disparity.dtype) - disparity[:, 0]
    y = torch.arange(height, dtype=disparity.dtype)[:, None].expand_as(x)
    grid = torch.stack([2 * x / (width - 1) - 1, 2 * y / (height - 1) - 1], dim=-1)
    return F.grid_sample(image, grid, mode=mode, padding_mode=padding, align_corners=True)


def random_pair(seed: int = 0, dtype: torch.dtype = torch.float32) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    image = torch.rand(2, 3, 6, 33, generator=generator, dtype=dtype)
    return image, torch.rand(2, 1, 6, 33, generator=generator, dtype=dtype) * 60 - 20


@pytest.mark.parametrize("shift", [0, 1, 7, 40, -3])
def test_a_whole_numbered_shift_copies_bit_by_bit(shift):
    image, _ = random_pair()
    columns = (torch.arange(33) - shift).clamp(0, 32)
    for mode in ("bilinear", "nearest"):
        assert torch.equal(backward_warp(image, torch.full((2, 1, 6, 33), float(shift)), mode), image[..., columns])


def test_it_agrees_with_plain_linear_interpolation():
    image, disparity = random_pair(1)
    warped = backward_warp(image, disparity)
    for b in range(2):
        expected = oracles_loss.backward_warp(image[b].double().numpy(), disparity[b, 0].double().numpy())
        np.testing.assert_allclose(warped[b].numpy(), expected, atol=1e-5)


@pytest.mark.parametrize("mode", ["bilinear", "nearest"])
@pytest.mark.parametrize("padding", ["border", "zeros"])
def test_it_agrees_with_grid_sample_and_so_do_its_gradients(mode, padding):
    image, disparity = random_pair(2, torch.float64)
    results = []
    for function in (backward_warp, grid_sample):
        a, b = image.clone().requires_grad_(), disparity.clone().requires_grad_()
        warped = function(a, b, mode, padding)
        (warped * torch.linspace(0, 1, warped.numel(), dtype=torch.float64).view_as(warped)).sum().backward()
        results.append((warped, a.grad, b.grad if b.grad is not None else torch.zeros_like(b)))
    for ours, reference in zip(*results, strict=True):
        torch.testing.assert_close(ours, reference, atol=1e-9, rtol=0)


def test_a_prediction_clamped_to_the_border_is_not_pulled():
    image, _ = random_pair()
    disparity = torch.full((2, 1, 6, 33), 50.0, requires_grad=True)
    backward_warp(image, disparity).sum().backward()
    assert disparity.grad is not None and (disparity.grad == 0).all()


def test_masks_stay_masks_and_nothing_is_known_beside_the_image():
    mask = torch.ones(1, 1, 2, 8, dtype=torch.bool)
    warped = backward_warp(mask, torch.full((1, 1, 2, 8), 2.6), mode="nearest", padding="zeros")
    assert warped.dtype == torch.bool
    assert warped[0, 0, 0].tolist() == [False] * 3 + [True] * 5


def test_disparities_that_are_not_finite_do_not_reach_other_pixels():
    image, disparity = random_pair(3)
    broken = disparity.clone()
    broken[0, 0, 0, :3] = torch.tensor([float("nan"), float("inf"), float("-inf")])
    for mode in ("bilinear", "nearest"):
        for padding in ("border", "zeros"):
            ours, intact = backward_warp(image, broken, mode, padding), backward_warp(image, disparity, mode, padding)
            ours[0, :, 0, :3] = intact[0, :, 0, :3] = 0
            assert torch.equal(ours, intact)
    known = backward_warp(torch.ones(2, 1, 6, 33, dtype=torch.bool), broken, "nearest", "zeros")
    assert not known[0, 0, 0, :3].any()


def test_half_precision_disparities_still_find_their_column():
    image = torch.arange(4000.0).view(1, 1, 1, 4000)
    warped = backward_warp(image, torch.full((1, 1, 1, 4000), 0.5, dtype=torch.float16))
    assert warped[0, 0, 0, 3001] == 3000.5


def test_one_pair_of_a_batch_does_not_depend_on_the_others():
    image, disparity = random_pair(4)
    assert torch.equal(backward_warp(image, disparity)[1:], backward_warp(image[1:], disparity[1:]))


def test_what_does_not_fit_is_named():
    image, disparity = random_pair()
    with pytest.raises(ValueError, match=r"\[2, 3, 6, 33\] and \[2, 1, 6, 32\]"):
        backward_warp(image, disparity[..., 1:])
    with pytest.raises(ValueError, match="bicubic"):
        backward_warp(image, disparity, mode="bicubic")
    with pytest.raises(ValueError, match="reflection"):
        backward_warp(image, disparity, padding="reflection")
    with pytest.raises(TypeError, match="uint8"):
        backward_warp(image.byte(), disparity)
    with pytest.raises(TypeError, match="int64"):
        backward_warp(image, disparity.long())
