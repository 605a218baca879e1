from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

import zsdata.synthesis.warp as warp_file
from tests.oracles import cubic, warp_row
from zsdata.synthesis.warp import forward_warp


def warp_one_row(disparity, left=None):
    disparity = torch.tensor(disparity, dtype=torch.float32).view(1, 1, 1, -1)
    if left is None:
        left = torch.arange(disparity.shape[-1], dtype=torch.float32).view(1, 1, 1, -1)
    return forward_warp(left, disparity)


def test_a_constant_disparity_shifts_the_photo():
    left = torch.rand(2, 3, 4, 16)
    warp = forward_warp(left, torch.full((2, 1, 4, 16), 5.0))
    assert torch.equal(warp.right[..., :-5], left[..., 5:])
    assert warp.inpaint_mask[..., -5:].all() and not warp.inpaint_mask[..., :-5].any()
    assert not warp.nonocclusion_mask[..., :5].any() and warp.nonocclusion_mask[..., 5:].all()
    assert torch.equal(warp.right_disparity[..., :-5], torch.full((2, 1, 4, 11), 5.0))
    assert not warp.right[..., -5:].any() and not warp.right_disparity[..., -5:].any()


def test_zero_disparity_leaves_the_photo_as_it_is():
    left = torch.rand(1, 3, 5, 7)
    warp = forward_warp(left, torch.zeros(1, 1, 5, 7))
    assert torch.equal(warp.right, left)
    assert warp.nonocclusion_mask.all() and not warp.inpaint_mask.any()


def test_a_uint8_image_is_warped_as_its_float_and_rounded():
    generator = torch.Generator().manual_seed(3)
    left = torch.randint(0, 256, (2, 3, 24, 70), generator=generator, dtype=torch.uint8)
    disparity = torch.rand((2, 1, 24, 70), generator=generator) * torch.tensor([1.5, 12]).view(2, 1, 1, 1)  # stretched, and torn
    warp, as_float = forward_warp(left, disparity, columns=64), forward_warp(left.float(), disparity, columns=64)
    assert warp.right.dtype == torch.uint8
    assert torch.equal(warp.right, as_float.right.round().to(torch.uint8))
    assert all(torch.equal(ours, theirs) for ours, theirs in zip(warp[1:], as_float[1:], strict=True))


def test_other_whole_numbers_are_refused():
    with pytest.raises(TypeError, match="uint8 or a float; got"):
        forward_warp(torch.zeros(1, 3, 4, 8, dtype=torch.int32), torch.zeros(1, 1, 4, 8))


def test_a_subpixel_shift_interpolates_between_the_two_pixels():
    left = torch.rand(1, 1, 1, 32) * 255
    warp = warp_one_row([3.25] * 32, left)
    row = left.flatten().tolist()
    for u in range(1, 27):
        expected = cubic(row[u + 2 : u + 6], 0.25)
        assert warp.right[0, 0, 0, u].item() == pytest.approx(min(max(expected, min(row)), max(row)), abs=1e-3)


@pytest.mark.parametrize("slope", [-0.9, -0.5, -0.1, 0.1, 0.5, 0.9])
def test_a_slanted_plane_stays_whole_and_straight(slope):
    x = np.arange(64)
    disparity = 60 + slope * (x - 32) / 1.0 if slope < 0 else 5 + slope * x
    warp = warp_one_row(disparity.tolist())
    seen = ~warp.inpaint_mask.flatten()
    columns = seen.nonzero().flatten()
    assert seen[columns[0] : columns[-1] + 1].all(), "a crack in a continuous surface"
    # Colour is the left column: the right view of a plane is a plane again.
    u = torch.arange(64.0)
    expected = u + warp.right_disparity.flatten()
    inner = columns[1:-1]
    assert torch.allclose(warp.right.flatten()[inner], expected[inner], atol=2e-3)


def test_a_floating_square_hides_the_wall_on_its_left_and_uncovers_it_on_its_right():
    left = torch.full((1, 3, 12, 40), 10.0)
    left[..., 4:8, 20:28] = 200.0
    disparity = torch.full((1, 1, 12, 40), 2.0)
    disparity[..., 4:8, 20:28] = 9.0
    warp = forward_warp(left, disparity)
    row = warp.right[0, 0, 5]
    assert (row[11:19] == 200).all() and row[10] == 10
    assert warp.inpaint_mask[0, 0, 5].nonzero().flatten().tolist() == [*range(19, 26), 38, 39]
    hidden = (~warp.nonocclusion_mask[0, 0, 5]).nonzero().flatten().tolist()
    assert hidden == [0, 1, *range(13, 20)]


def test_a_bar_thinner_than_its_disparity_leaves_a_hole_as_wide_as_itself():
    disparity = [1.0] * 40
    disparity[20:23] = [11.0] * 3
    warp = warp_one_row(disparity)
    assert warp.right.flatten()[9:12].tolist() == [20, 21, 22]
    assert warp.inpaint_mask.flatten().nonzero().flatten().tolist() == [19, 20, 21, 39]
    hidden = (~warp.nonocclusion_mask.flatten()).nonzero().flatten().tolist()
    assert hidden == [0, 10, 11, 12]


def test_the_nearer_surface_wins_even_where_the_farther_one_lands_closer_to_the_pixel():
    disparity = [0.0] * 12
    disparity[8] = 3.4  # lands on 4.6: covers pixel 5, half a pixel off, where the wall lands exactly
    warp = warp_one_row(disparity)
    assert warp.right.flatten()[5] == 8


def test_no_colour_bleeds_across_a_depth_edge():
    left = torch.where(torch.arange(64) < 32, 0.0, 255.0).view(1, 1, 1, -1)
    disparity = torch.where(torch.arange(64) < 32, 3.3, 12.7).view(1, 1, 1, -1)
    right = forward_warp(left, disparity).right
    assert set(right.unique().tolist()) <= {0.0, 255.0}


def scenes(values):
    return arrays(np.float32, st.tuples(st.integers(1, 3), st.integers(1, 24)), elements=values)


dyadic = st.integers(0, 96).map(lambda n: n / 8)  # many exact ties
smooth = st.floats(0, 12, width=32)


@settings(max_examples=300, deadline=None)
@given(scenes(st.one_of(dyadic, smooth)) | scenes(dyadic) | scenes(st.sampled_from([0.0, 0.5, 1.0, 1.5, 2.0, 2.5])))
@example(np.array([[0, 0], [1e-5, 0.99999]], np.float32))  # two pixels land 0.00002 px apart, with a column between them
def test_masks_and_disparity_equal_the_definitions(disparity):
    warp = forward_warp(torch.zeros(1, 1, *disparity.shape), torch.from_numpy(disparity).view(1, 1, *disparity.shape))
    for y, row in enumerate(disparity):
        hole, right_disparity, visible = warp_row(row)
        assert warp.inpaint_mask[0, 0, y].tolist() == hole.tolist()
        assert np.allclose(warp.right_disparity[0, 0, y].numpy(), right_disparity, atol=1e-4)
        differs = warp.nonocclusion_mask[0, 0, y].numpy() != visible
        landing = np.round(row.astype(np.float64) * -1 + np.arange(len(row))).astype(int)
        for x in np.flatnonzero(differs):  # only where "within 1 px" is a matter of rounding
            assert abs(abs(right_disparity[landing[x]] - row[x]) - 1) < 1e-4


@pytest.mark.parametrize("size", [(20, 50), (300, 500)])
def test_a_sample_is_the_same_in_any_batch_and_with_any_number_of_threads(size):
    left, disparity = torch.rand(3, 3, *size) * 255, torch.rand(3, 1, *size) * 20
    disparity = (disparity + disparity[..., :1]).round_(decimals=1).repeat_interleave(2, dim=3)[..., : size[1]]
    threads = torch.get_num_threads()
    try:
        torch.set_num_threads(2)
        together = forward_warp(left, disparity)
        torch.set_num_threads(1)
        for i in range(3):
            alone = forward_warp(left[i : i + 1], disparity[i : i + 1])
            for a, b in zip(alone, together, strict=True):
                assert torch.equal(a[0], b[i])
    finally:
        torch.set_num_threads(threads)


@pytest.mark.parametrize("values", ["one surface", "no two neighbours on one surface"])
def test_an_image_is_the_same_in_whatever_parts_it_is_warped(values, monkeypatch):
    left, disparity = torch.rand(2, 3, 7, 30) * 255, torch.rand(2, 1, 7, 30)
    if values != "one surface":
        disparity += torch.arange(30) % 2 * 5
    whole = forward_warp(left, disparity)
    assert whole.right.amax((1, 2, 3)).le(left.amax((1, 2, 3))).all()
    for name, pixels in (("CPU_PART_PX", 1), ("CPU_PART_PX", 100)):
        monkeypatch.setattr(warp_file, name, pixels)
        for a, b in zip(forward_warp(left, disparity), whole, strict=True):
            assert torch.equal(a, b)


def test_threads_may_warp_at_once():
    generator = torch.Generator().manual_seed(5)
    lefts = torch.rand((4, 1, 3, 120, 160), generator=generator)
    disparities = torch.rand((4, 1, 1, 120, 160), generator=generator) * 20
    expected = [forward_warp(*pair) for pair in zip(lefts, disparities, strict=True)]
    with ThreadPoolExecutor(4) as threads:
        for _ in range(20):
            made = threads.map(forward_warp, lefts, disparities)
            assert all(
                torch.equal(ours, theirs)
                for one, other in zip(made, expected, strict=True)
                for ours, theirs in zip(one, other, strict=True)
            )


def test_a_value_that_is_no_number_covers_nothing():
    disparity = [2.0] * 10
    disparity[5], disparity[7] = float("nan"), float("inf")
    warp = warp_one_row(disparity)
    assert torch.isfinite(warp.right).all() and torch.isfinite(warp.right_disparity).all()
    assert warp.inpaint_mask.flatten().nonzero().flatten().tolist() == [3, 5, 8, 9]
    assert not warp.nonocclusion_mask.flatten()[[5, 7]].any()


@pytest.mark.parametrize("step", [-1.0, 0.5, 1.0, 2.0])
def test_rows_know_nothing_of_each_other(step):
    left, disparity = torch.rand(1, 3, 4, 16) * 255, torch.full((1, 1, 4, 16), 3.0)
    left[..., :2] = torch.tensor([0.0, 255.0])  # one range for all rows
    disparity += step * torch.arange(4.0).view(-1, 1)
    whole = forward_warp(left, disparity)
    for y in range(4):
        for all_rows, one in zip(whole, forward_warp(left[..., y : y + 1, :], disparity[..., y : y + 1, :]), strict=True):
            assert torch.equal(all_rows[..., y : y + 1, :], one)


def test_results_carry_no_gradient():
    left, disparity = torch.rand(1, 3, 4, 16, requires_grad=True), (torch.rand(1, 1, 4, 16) * 4).requires_grad_()
    warp = forward_warp(left, disparity)
    assert not warp.right.requires_grad and not warp.right_disparity.requires_grad


@settings(max_examples=60, deadline=None)
@given(scenes(st.one_of(dyadic, smooth)), st.data())
def test_the_first_columns_are_those_of_the_whole_result(disparity, data):
    columns = data.draw(st.integers(1, disparity.shape[1]))
    disparity = torch.from_numpy(disparity)[None, None]
    left = torch.arange(3.0 * disparity.numel()).view(1, 3, *disparity.shape[2:]).sin()
    for part, whole in zip(forward_warp(left, disparity, columns), forward_warp(left, disparity), strict=True):
        assert torch.equal(part, whole[..., :columns])


@pytest.mark.parametrize("columns", [0, 17])
def test_columns_that_the_image_does_not_have_are_named(columns):
    with pytest.raises(ValueError, match=f"1..16, the width of `left`; got {columns}"):
        forward_warp(torch.zeros(1, 3, 4, 16), torch.zeros(1, 1, 4, 16), columns)


def test_shapes_that_do_not_fit_are_named():
    with pytest.raises(ValueError, match=r"\[1, 3, 4, 5\] and \[1, 1, 4, 6\]"):
        forward_warp(torch.zeros(1, 3, 4, 5), torch.zeros(1, 1, 4, 6))
