from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from tests.scenes import SHARED
from zsdata.synthesis.inpaint.builtin import GREY, TEXTURE_LIMIT, BuiltinInpainter
from zsdata.synthesis.warp import Warped, forward_warp

inpaint = BuiltinInpainter()

RED, GREEN = torch.tensor([200.0, 30, 30]), torch.tensor([30.0, 160, 40])


def random_case(seed: int, batch: int, height: int, width: int, hole_share: float) -> tuple[Tensor, Tensor, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    right = torch.rand(batch, 3, height, width, generator=generator) * 255
    disparity = (torch.rand(batch, 1, height, width, generator=generator) * 4).floor() * 5
    blocks = torch.rand(batch, 1, height, max(1, width // 3), generator=generator) < hole_share
    inpaint_mask = torch.nn.functional.interpolate(blocks.float(), (height, width)).bool()
    return right.masked_fill(inpaint_mask, 0), inpaint_mask, disparity.masked_fill(inpaint_mask, 0)


def two_surfaces(noise: float = 0.0) -> tuple[Tensor, Warped]:
    """A red square in front of a green wall: the left image and its warp, whose hole is to the right of the square."""
    generator = torch.Generator().manual_seed(0)
    left = GREEN.view(1, 3, 1, 1) + noise * torch.randn(1, 1, 60, 120, generator=generator)
    left[..., 10:50, 30:70] = RED.view(1, 3, 1, 1)
    disparity = torch.full((1, 1, 60, 120), 4.0)
    disparity[..., 10:50, 30:70] = 16
    return left, forward_warp(left, disparity)


def square_hole(warped: Warped) -> Tensor:
    hole = warped.inpaint_mask[0, 0].clone()
    hole[:, 100:] = False
    assert hole.sum() == 40 * 12
    return hole


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 10_000),
    batch=st.integers(1, 3),
    height=st.integers(1, 9),
    width=st.integers(1, 40),
    hole_share=st.sampled_from([0.0, 0.1, 0.5, 0.9, 1.0]),
    with_disparity=st.booleans(),
)
def test_every_hole_is_filled_and_known_pixels_stay_bit_for_bit(seed, batch, height, width, hole_share, with_disparity):
    right, inpaint_mask, disparity = random_case(seed, batch, height, width, hole_share)
    poisoned = right.masked_fill(inpaint_mask, torch.nan)  # nothing may come out of a hole
    before = [argument.clone() for argument in (right, inpaint_mask, disparity)]
    filled = inpaint(poisoned, inpaint_mask, None, disparity if with_disparity else None)
    assert filled.shape == right.shape and filled.dtype == right.dtype
    assert torch.isfinite(filled).all() and filled.min() >= 0 and filled.max() <= 255
    assert torch.equal(filled.masked_fill(inpaint_mask, 0), right)
    assert all(torch.equal(*pair) for pair in zip(before, (right, inpaint_mask, disparity), strict=True))


def test_a_sample_is_the_same_in_any_batch_and_on_any_number_of_threads():
    right, inpaint_mask, disparity = random_case(1, 3, 200, 301, 0.3)
    threads = torch.get_num_threads()
    try:
        results = []
        for count in (1, 2):
            torch.set_num_threads(count)
            results.append(inpaint(right, inpaint_mask, None, disparity))
            for i in range(3):
                results.append(inpaint(right[i : i + 1], inpaint_mask[i : i + 1], None, disparity[i : i + 1]))
    finally:
        torch.set_num_threads(threads)
    for batch, *alone in (results[:4], results[4:]):
        assert torch.equal(batch, results[0])
        assert torch.equal(torch.cat(alone), batch)


def test_the_generators_change_nothing():
    right, inpaint_mask, disparity = random_case(2, 1, 20, 30, 0.3)
    drawn = inpaint(right, inpaint_mask, [np.random.default_rng(5)], disparity)
    assert torch.equal(drawn, inpaint(right, inpaint_mask, None, disparity))


@pytest.mark.parametrize("with_disparity", [True, False])
def test_a_hole_shows_the_background_and_nothing_of_the_foreground(with_disparity):
    _, warped = two_surfaces()
    filled = inpaint(warped.right, warped.inpaint_mask, None, warped.right_disparity if with_disparity else None)
    assert torch.allclose(filled[0][:, square_hole(warped)], GREEN[:, None], atol=1e-3)


def test_the_farther_end_is_the_one_of_smaller_disparity_on_whichever_side():
    _, warped = two_surfaces()
    right, inpaint_mask, disparity = warped.right.flip(-1), warped.inpaint_mask.flip(-1), warped.right_disparity.flip(-1)
    hole = square_hole(warped).flip(-1)
    assert torch.allclose(inpaint(right, inpaint_mask, None, disparity)[0][:, hole], GREEN[:, None], atol=1e-3)
    unaware = inpaint(right, inpaint_mask)[0][:, hole]  # without disparity: the right end, and textures that may cross surfaces
    assert (unaware - RED[:, None]).abs().max() <= TEXTURE_LIMIT


def test_without_a_right_end_the_left_surface_goes_on():
    _, warped = two_surfaces()
    assert warped.inpaint_mask[..., -4:].all()
    filled = inpaint(warped.right, warped.inpaint_mask, None, warped.right_disparity)
    assert torch.allclose(filled[..., -4:], GREEN.view(1, 3, 1, 1), atol=1e-3)


def test_a_hole_at_the_left_border_takes_its_own_rows_right_surface():
    right = torch.cat([RED.view(1, 3, 1, 1).expand(1, 3, 20, 40), GREEN.view(1, 3, 1, 1).expand(1, 3, 20, 40)], -1)
    disparity = torch.tensor([9.0, 1.0]).repeat_interleave(40).expand(1, 1, 20, 80)
    inpaint_mask = (torch.arange(80) < 6).expand(1, 1, 20, 80)
    filled = inpaint(right, inpaint_mask, None, disparity)  # what lies before column 0 in memory, the row above's end, is farther
    assert torch.allclose(filled[..., :6], RED.view(1, 3, 1, 1), atol=1e-3)


def test_a_speck_of_the_foreground_in_a_hole_is_no_edge():
    _, warped = two_surfaces()
    hole = square_hole(warped)
    row = 30
    column = int(hole[row].nonzero()[5])
    right, inpaint_mask, disparity = (field.clone() for field in (warped.right, warped.inpaint_mask, warped.right_disparity))
    right[0, :, row, column : column + 2] = RED[:, None]
    inpaint_mask[0, 0, row, column : column + 2] = False
    disparity[0, 0, row, column : column + 2] = 16
    for known in (disparity, None):
        filled = inpaint(right, inpaint_mask, None, known)
        assert torch.allclose(filled[0][:, inpaint_mask[0, 0] & hole], GREEN[:, None], atol=1e-3)


def test_a_mixed_pixel_at_the_backgrounds_edge_is_not_smeared_into_the_hole():
    _, warped = two_surfaces()
    hole = square_hole(warped)
    right = warped.right.clone()
    first_behind = int(hole[30].nonzero().max()) + 1
    right[0, :, 10:50, first_behind] = (RED[:, None] + GREEN[:, None]) / 2
    filled = inpaint(right, warped.inpaint_mask, None, warped.right_disparity)
    away_from_corners = hole.clone()
    away_from_corners[:20], away_from_corners[40:] = False, False
    assert (filled[0][:, away_from_corners] - GREEN[:, None]).abs().max() < 15  # half of red is 85 away


def test_texture_goes_on_as_rough_as_it_is():
    _, warped = two_surfaces(noise=8.0)
    filled = inpaint(warped.right, warped.inpaint_mask, None, warped.right_disparity)[0, 1]
    wall = ~warped.inpaint_mask[0, 0]
    wall[:, :80], wall[:, 110:] = False, False
    hole = square_hole(warped)
    for axis in (0, 1):
        ahead = [slice(None, -1) if i == axis else slice(None) for i in (0, 1)]
        behind = [slice(1, None) if i == axis else slice(None) for i in (0, 1)]
        made, true = (filled.diff(dim=axis)[area[tuple(ahead)] & area[tuple(behind)]].square().mean() for area in (hole, wall))
        assert 0.6 < made / true < 1.6


def test_horizontal_stripes_keep_their_colour_far_into_the_hole():
    stripes = torch.where(torch.arange(60) // 15 % 2 == 0, 60.0, 180.0).view(1, 1, 60, 1).expand(1, 3, 60, 120).contiguous()
    inpaint_mask = torch.zeros(1, 1, 60, 120, dtype=torch.bool)
    inpaint_mask[..., 40:70] = True
    filled = inpaint(stripes.masked_fill(inpaint_mask, 0), inpaint_mask)
    assert (filled - stripes)[:, :, 7::15].abs().max() < 30  # in the middle of each stripe, of 120 levels between them


def test_rows_without_a_known_pixel_continue_their_neighbours_and_an_empty_image_is_grey():
    right, inpaint_mask, _ = random_case(3, 2, 12, 10, 0.0)
    inpaint_mask[0, :, 5:8] = True
    inpaint_mask[1] = True
    filled = inpaint(right, inpaint_mask)
    assert torch.equal(filled[0, :, 5:8], right[0][:, [3, 2, 9]])
    assert (filled[1] == GREY).all()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((torch.zeros(3, 4, 4), torch.zeros(1, 1, 4, 4, dtype=torch.bool)), "right is a float"),
        ((torch.zeros(1, 3, 4, 4, dtype=torch.uint8), torch.zeros(1, 1, 4, 4, dtype=torch.bool)), "right is a float"),
        ((torch.zeros(1, 3, 4, 4), torch.zeros(1, 1, 4, 4)), "inpaint_mask is bool"),
        ((torch.zeros(1, 3, 4, 4), torch.zeros(1, 1, 4, 5, dtype=torch.bool)), "inpaint_mask is bool"),
        ((torch.zeros(1, 3, 4, 4), torch.zeros(1, 1, 4, 4, dtype=torch.bool), None, torch.zeros(4, 4)), "right_disparity is"),
    ],
)
def test_arguments_that_do_not_fit_are_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        inpaint(*arguments)


@pytest.mark.skipif(not (SHARED / "data" / "stereo").is_dir(), reason="the real pairs are not here")
def test_on_real_pairs_inner_holes_are_closer_to_the_truth_than_opencvs_and_a_random_background():
    pytest.importorskip("skimage")
    from benchmarks.inpainting import FEWEST_PX, METHODS, cases, score

    names = ("built-in", "cv2 telea", "cv2 ns", "background")
    psnr = []
    for case in cases(SHARED / "data" / "stereo"):
        if case.truth.shape[1] < 1000 and case.inner.sum() >= FEWEST_PX:  # Aloe is large, and left out for time
            psnr.append([score(case, METHODS[name](case), case.inner).psnr for name in names])
    assert len(psnr) >= 5
    ours, *others = np.mean(psnr, axis=0)
    assert ours > max(others) + 1.5
