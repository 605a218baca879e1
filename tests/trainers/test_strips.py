from __future__ import annotations

import pytest
import torch
import torch.nn.functional as F

from trainers.strips import CUT_ROWS, LEAST_ROWS, OVERLAP_ROWS, in_strips


def blurred(radius: int):
    """A matcher that looks `radius` rows up and down."""

    def predict(left, right):
        padded = F.pad((left - right)[:, :1].double(), (0, 0, radius, radius), mode="replicate")
        return F.avg_pool2d(padded, (2 * radius + 1, 1), stride=1)

    return predict


def images(height: int, width: int = 24):
    generator = torch.Generator().manual_seed(0)
    return [torch.rand(1, 3, height, width, generator=generator) * 255 for _ in range(2)]


@pytest.mark.parametrize("height", [LEAST_ROWS + 1, 2 * LEAST_ROWS - OVERLAP_ROWS, 700, 1111])
def test_strips_have_no_seams_where_the_matcher_sees_no_further_than_the_cut(height):
    left, right = images(height)
    seen = []

    def predict(left, right):
        seen.append(left.shape[-2:])
        return blurred(CUT_ROWS)(left, right)

    whole = blurred(CUT_ROWS)(left, right).float()
    stitched = in_strips(predict, LEAST_ROWS)(left, right)
    assert stitched.shape == whole.shape and stitched.dtype == torch.float32
    torch.testing.assert_close(stitched, whole, rtol=0, atol=1e-4)
    assert len(seen) > 1 and set(seen) == {(LEAST_ROWS, 24)}  # whole rows: no match is cut off


def test_strips_fade_into_each_other():
    left, right = images(2 * LEAST_ROWS)
    count = 0

    def disagreeing(left, right):
        nonlocal count
        count += 1
        return torch.full_like(left[:, :1], 10.0 * count)

    stitched = in_strips(disagreeing, LEAST_ROWS)(left, right)[0, 0, :, 0]
    assert stitched[0] == 10 and stitched[-1] == 10 * count
    assert (stitched.diff() >= 0).all() and stitched.diff().max() < 1


def test_an_image_that_fits_is_matched_whole():
    left, right = images(LEAST_ROWS)
    assert torch.equal(in_strips(blurred(40), LEAST_ROWS)(left, right), blurred(40)(left, right))


def test_strips_that_are_too_low_are_refused():
    with pytest.raises(ValueError, match="at least 256 rows high; got 100"):
        in_strips(blurred(1), 100)
