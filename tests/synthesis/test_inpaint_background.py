from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from tests.scenes import photo
from zsdata.synthesis.inpaint.background import RandomBackground

inpaint = RandomBackground()


def image(seed: int, height: int = 60, width: int = 90) -> Tensor:
    return torch.from_numpy(photo(seed, height, width)).permute(2, 0, 1)[None].float()


def holes(seed: int, batch: int = 1, height: int = 60, width: int = 90) -> Tensor:
    return torch.rand(batch, 1, height, width, generator=torch.Generator().manual_seed(seed)) < 0.2


def test_holes_show_the_other_photo_in_the_known_pixels_colours():
    right, other, inpaint_mask = image(1) * 0.4 + 60, image(2) * 0.3 + 20, holes(0)
    filled = inpaint(right.masked_fill(inpaint_mask, 0), inpaint_mask, None, other)
    for channel in range(3):
        known = right[0, channel][~inpaint_mask[0, 0]].double()
        source = other[0, channel].double()
        expected = (source - source.mean()) / source.std() * known.std() + known.mean()
        made = filled[0, channel][inpaint_mask[0, 0]].double()
        assert torch.allclose(made, expected[inpaint_mask[0, 0]].clamp(0, 255), atol=0.5)


@settings(max_examples=30, deadline=None)
@given(
    seed=st.integers(0, 1000),
    height=st.integers(1, 8),
    width=st.integers(1, 8),
    share=st.sampled_from([0.0, 0.4, 1.0]),
    own=st.booleans(),
    flat=st.booleans(),
)
def test_every_hole_is_filled_and_known_pixels_stay_bit_for_bit(seed, height, width, share, own, flat):
    generator = torch.Generator().manual_seed(seed)
    right, other = torch.rand(2, 2, 3, height, width, generator=generator) * 255
    inpaint_mask = torch.rand(2, 1, height, width, generator=generator) < share
    right = right.masked_fill(inpaint_mask, 0)
    if flat:
        other = torch.full_like(other, 77.0)
    filled = inpaint(right, inpaint_mask, [np.random.default_rng(seed), None], None if own else other)
    assert torch.isfinite(filled).all() and filled.min() >= 0 and filled.max() <= 255
    assert torch.equal(filled.masked_fill(inpaint_mask, 0), right)


def test_what_stands_in_the_holes_does_not_matter():
    right, holes, other = torch.rand(2, 3, 20, 24) * 255, torch.rand(2, 1, 20, 24) < 0.3, torch.rand(2, 3, 20, 24) * 255
    emptied = right.masked_fill(holes, 0)
    for background in (other, None):
        assert torch.equal(
            RandomBackground()(right, holes, background=background), RandomBackground()(emptied, holes, background=background)
        )


def test_without_a_known_pixel_the_other_photo_is_shown_as_it_is():
    other = image(3)
    filled = inpaint(torch.zeros_like(other), torch.ones(1, 1, 60, 90, dtype=torch.bool), None, other)
    assert torch.allclose(filled, other, atol=1e-3)


def test_a_sample_is_the_same_in_any_batch_and_on_any_number_of_threads():
    right, other = (torch.cat([image(seed) for seed in seeds]) + 0.1234 for seeds in ((1, 2, 3), (4, 5, 6)))
    inpaint_mask = holes(1, 3)
    threads = torch.get_num_threads()
    try:
        results = []
        for count in (1, 2):
            torch.set_num_threads(count)
            results.append(inpaint(right, inpaint_mask, None, other))
            results.append(torch.cat([inpaint(right[i : i + 1], inpaint_mask[i : i + 1], None, other[i : i + 1]) for i in range(3)]))
    finally:
        torch.set_num_threads(threads)
    assert all(torch.equal(result, results[0]) for result in results[1:])


def test_without_another_photo_the_generator_of_each_sample_decides_where_the_mirrored_image_lies():
    right, inpaint_mask = image(7).expand(3, -1, -1, -1), holes(2).expand(3, -1, -1, -1)
    filled = inpaint(right, inpaint_mask, [np.random.default_rng(seed) for seed in (1, 2, 1)])
    assert torch.equal(filled[0], filled[2]) and not torch.equal(filled[0], filled[1])
    assert torch.equal(inpaint(right, inpaint_mask), inpaint(right, inpaint_mask))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"right": torch.zeros(3, 60, 90)}, "right is a float"),
        ({"inpaint_mask": torch.zeros(1, 1, 60, 90)}, "inpaint_mask is bool"),
        ({"background": torch.zeros(1, 3, 60, 91)}, "background has the shape"),
        ({"generators": [None, None]}, "generators has one entry"),
    ],
)
def test_arguments_that_do_not_fit_are_named(change, message):
    arguments = {"right": image(1), "inpaint_mask": holes(1), "generators": None, "background": image(2)}
    with pytest.raises(ValueError, match=message):
        inpaint(**{**arguments, **change})
