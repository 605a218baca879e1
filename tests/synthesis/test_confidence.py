import pytest
import torch

from zsdata.synthesis.confidence import flip_confidence, flip_consistency, normalize_inverse_depth
from zsdata.synthesis.depth.maps import depth_maps


def test_each_map_is_brought_to_its_own_range():
    maps = torch.stack([torch.linspace(3, 7, 12).view(1, 3, 4), torch.linspace(-1, 0, 12).view(1, 3, 4)])
    normal = normalize_inverse_depth(maps)
    assert torch.allclose(normal[0], normal[1], atol=1e-6)
    assert normal.amin() == 0 and normal.amax() == 1


def test_a_flat_map_is_zero_and_not_nan():
    assert torch.equal(normalize_inverse_depth(torch.full((2, 1, 3, 3), 5.0)), torch.zeros(2, 1, 3, 3))


def test_an_estimate_that_is_not_finite_is_refused():
    bad = torch.ones(1, 1, 2, 2)
    bad[..., 0, 0] = float("nan")
    with pytest.raises(ValueError, match="finite"):
        normalize_inverse_depth(bad)


def test_confidence_follows_the_papers_equation():
    first, second = torch.rand(2, 1, 5, 6), torch.rand(2, 1, 5, 6)
    for i in range(2):
        u = 1 - (first[i] - second[i]).abs()
        expected = (u - u.min()) / (u.max() - u.min())
        assert torch.allclose(flip_confidence(first, second)[i], expected, atol=1e-6)
        assert flip_consistency(first, second)[i].item() == pytest.approx(u.mean().item(), abs=1e-6)


def test_full_agreement_is_full_confidence():
    first = torch.rand(1, 1, 4, 4)
    assert torch.equal(flip_confidence(first, first), torch.ones_like(first))
    assert flip_consistency(first, first).item() == 1


def test_depth_is_kept_as_the_nearest_whole_numbers():
    estimate, mirrored = torch.rand(1, 1, 20, 30), torch.rand(1, 1, 20, 30)
    kept = depth_maps(estimate, mirrored)
    exact = normalize_inverse_depth(estimate), flip_confidence(normalize_inverse_depth(estimate), normalize_inverse_depth(mirrored))
    for values, expected, steps in zip(kept[:2], exact, (65_535, 255), strict=True):
        assert (values.double() - expected.double() * steps).abs().max() < 0.51
