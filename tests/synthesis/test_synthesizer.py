import pytest
import torch

from tests.scenes import photo
from zsdata.meter import Meter
from zsdata.synthesis.depth.maps import DepthMaps
from zsdata.synthesis.synthesizer import INPAINT_CONTEXT_PX, SynthesisConfig, Synthesized, estimate_depth, synthesize
from zsdata.synthesis.view import View, view_photo, whole_view

HEIGHT, WIDTH = 40, 120


def made(inverse_depth: torch.Tensor, view: View | None = None, scale: float = 0.1, **options) -> Synthesized:
    view = view or whole_view((HEIGHT, WIDTH))
    shown = torch.from_numpy(view_photo(photo(0, HEIGHT, WIDTH), view).copy()).permute(2, 0, 1)[None]
    whole = (inverse_depth.expand(1, 1, HEIGHT, WIDTH) * 65_535).round().int().to(torch.uint16)
    depth = DepthMaps(whole, torch.full_like(whole, 255, dtype=torch.uint8), torch.ones(1, dtype=torch.float64))
    return synthesize(shown, depth, view, scale, SynthesisConfig(**options), Meter())


def brightness(photos: torch.Tensor) -> torch.Tensor:
    """An estimator that treats left and right alike."""
    return photos.mean(1, keepdim=True)


class BothAtOnce:
    def __call__(self, photos: torch.Tensor) -> torch.Tensor:
        return brightness(photos)

    def with_mirrored(self, photos: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        return brightness(photos), brightness(photos.flip(-1)).flip(-1)


@pytest.mark.parametrize("estimator", [brightness, BothAtOnce()])
def test_an_estimator_that_treats_left_and_right_alike_is_trusted_everywhere(estimator):
    photos = torch.rand(1, 3, 30, 41) * 255
    maps = estimate_depth(estimator, photos, SynthesisConfig())
    assert (maps.confidence == 255).all() and maps.consistency == 1


def test_an_estimate_is_trusted_less_where_the_mirrored_photo_gives_another():
    def left_is_nearer(photos: torch.Tensor) -> torch.Tensor:
        return torch.where(torch.arange(photos.shape[-1]) < 10, 1.0, 0.0).expand(1, 1, *photos.shape[-2:])

    photos = torch.rand(1, 3, 30, 41) * 255
    confidence = estimate_depth(left_is_nearer, photos, SynthesisConfig()).confidence
    assert not confidence[..., :10].any() and not confidence[..., 31:].any() and (confidence[..., 10:31] == 255).all()
    assert (estimate_depth(left_is_nearer, photos, SynthesisConfig(flip_confidence=False)).confidence == 255).all()


def test_a_blurred_depth_edge_becomes_a_step_between_two_surfaces():
    blurred = torch.cat([torch.full((56,), 0.1), torch.linspace(0.1, 0.9, 8), torch.full((56,), 0.9)])
    disparity = made(blurred, scale=0.5).disparity  # 6 and 54 px
    assert ((disparity - 6).abs().minimum((disparity - 54).abs()) < 3).all()  # and no pixel hangs between


def test_a_near_thing_grows_by_the_rim_that_was_asked_for():
    thing = torch.full((HEIGHT, WIDTH), 0.2)
    thing[10:30, 50:70] = 1.0
    wide = [(made(thing, dilate_px=px).disparity[0, 0, 20] > 9).sum().item() for px in (0, 1, 3)]
    assert wide[1] - wide[0] == 2 and wide[2] - wide[0] == 6


def test_the_farthest_point_has_a_disparity_that_is_not_mistaken_for_no_label():
    assert made(torch.zeros(WIDTH)).disparity.min() > 0


def test_the_right_view_goes_on_beyond_the_crop_as_far_as_the_photo_does():
    flat = torch.full((WIDTH,), 0.5)  # of a scale of 0.1: 6 px
    whole = made(flat)
    inside, at_the_end = (
        View(False, (0, 0, HEIGHT, columns + margin), HEIGHT, columns + margin, margin) for columns, margin in ((64, 56), (110, 10))
    )
    for view, known in ((inside, 64 + INPAINT_CONTEXT_PX), (at_the_end, 110 + 10 - 6)):
        pair, width = made(flat, view), view.width - view.margin
        assert pair.left.shape[-1] == pair.disparity.shape[-1] == pair.confidence.shape[-1] == pair.nonocclusion_mask.shape[-1] == width
        assert pair.right.shape[-1] == pair.inpaint_mask.shape[-1] == pair.right_disparity.shape[-1] == width + INPAINT_CONTEXT_PX
        assert torch.equal(pair.right[..., :known], whole.right[..., :known]) and not pair.right[..., known:].any()
        assert not pair.inpaint_mask[..., :known].any() and pair.inpaint_mask[..., known:].all()


def test_disparities_grow_with_the_view():
    flat = torch.full((WIDTH,), 0.5)
    twice = View(False, (0, 0, HEIGHT, 60), 2 * HEIGHT, 120, 0)
    assert made(flat).disparity.mean().item() * 2 == made(flat, twice).disparity.mean().item()
