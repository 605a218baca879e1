import pytest
import torch

from zsdata.seeding import rng
from zsdata.synthesis.inpaint import fill


class Noted:
    """Fills holes with what its sample was given, and notes how many samples came at once."""

    needs = ("right_disparity",)

    def __init__(self, factor=1.0):
        self.factor, self.at_once = factor, []

    def __call__(self, right, inpaint_mask, generators, right_disparity):
        self.at_once.append(len(right))
        drawn = torch.tensor([generator.random() for generator in generators]).view(-1, 1, 1, 1)
        return ((drawn + right_disparity) * self.factor).float().expand_as(right)


@pytest.mark.parametrize(("micro_batch", "at_once"), [(None, [3]), (1, [1, 1, 1]), (2, [2, 1])])
def test_each_sample_with_holes_gets_its_own_numbers_and_context_and_the_others_stay(micro_batch, at_once):
    right, holes = torch.rand(5, 3, 6, 8) * 255, torch.rand(5, 1, 6, 8) < 0.4
    holes[0], holes[3] = False, False
    context = {"right_disparity": torch.arange(10.0, 60, 10).view(5, 1, 1, 1).expand(5, 1, 6, 8), "background": right}
    inpainter, before = Noted(), right.clone()
    filled = fill(inpainter, right, holes, [rng(0, 0, i, "inpaint") for i in range(5)], context, micro_batch)
    assert inpainter.at_once == at_once and torch.equal(right, before)
    for i in range(5):
        expected = torch.tensor(rng(0, 0, i, "inpaint").random()) + 10 * (i + 1)
        assert torch.equal(filled[i], torch.where(holes[i], expected.float(), right[i]))


@pytest.mark.parametrize(("factor", "level"), [(1000.0, 255.0), (-1.0, 0.0)])
def test_what_an_inpainter_makes_beyond_the_range_is_clamped(factor, level):
    right, holes = torch.rand(1, 3, 4, 4) * 255, torch.ones(1, 1, 4, 4, dtype=torch.bool)
    filled = fill(Noted(factor), right, holes, [rng(0, 0, 0, "inpaint")], {"right_disparity": torch.ones(1, 1, 4, 4)}, None)
    assert (filled == level).all()
