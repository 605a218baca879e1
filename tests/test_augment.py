import math
from dataclasses import fields, replace

import numpy as np
import pytest
import torch

from zsdata import augment as augment_module
from zsdata.augment import AugmentConfig, augment
from zsdata.seeding import rng

NONE = AugmentConfig.none()
EVERYTHING = replace(
    AugmentConfig(), **{field.name: 1.0 for field in fields(AugmentConfig) if field.name.endswith("_probability")}, gamma=(0.8, 1.2)
)
PLAIN_JITTER = replace(NONE, jitter_probability=1.0, brightness=(1.0, 1.0), contrast=(1.0, 1.0), saturation=(1.0, 1.0), hue_turns=0.0)
# Sizes with rows that fill no whole vector register.
SIZES = [(384, 512), (37, 53)]


def images(count: int, height: int, width: int, seed: int = 0) -> torch.Tensor:
    """Smooth colour with whole grey levels, as a photo has them."""
    coarse = torch.from_numpy(np.random.default_rng(seed).uniform(0, 255, (count, 3, 5, 6)).astype(np.float32))
    return torch.nn.functional.interpolate(coarse, (height, width), mode="bilinear").round()


def pair(count: int = 3, height: int = 64, width: int = 80) -> tuple[torch.Tensor, torch.Tensor]:
    return images(count, height, width, 1), images(count, height, width, 2)


def generators(count: int, first: int = 0) -> list[np.random.Generator]:
    return [rng(0, 0, first + i, "augment") for i in range(count)]


def run(left, right, config, first=0):
    return augment(left, right, generators(len(left), first), config)


@pytest.fixture
def two_threads():
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)


def test_without_augmentation_the_pair_comes_out_as_it_went_in():
    left, right = pair()
    new_left, new_right = run(left, right, NONE)
    assert torch.equal(new_left, left) and torch.equal(new_right, right)
    assert new_left.data_ptr() != left.data_ptr() and new_right.data_ptr() != right.data_ptr()


@pytest.mark.parametrize("config", [NONE, AugmentConfig(), EVERYTHING], ids=["none", "default", "everything"])
def test_the_clean_images_are_never_written_into(config):
    left, right = pair()
    before = left.clone(), right.clone()
    new_left, new_right = run(left, right, config)
    new_left.zero_()
    new_right.zero_()
    assert torch.equal(left, before[0]) and torch.equal(right, before[1])


@pytest.mark.parametrize("config", [AugmentConfig(), EVERYTHING], ids=["default", "everything"])
@pytest.mark.parametrize("size", SIZES, ids=str)
def test_a_pair_is_the_same_alone_and_anywhere_in_a_batch(config, size):
    left, right = pair(8, *size)
    batched = run(left, right, config)
    for i in range(8):
        alone = run(left[i : i + 1], right[i : i + 1], config, first=i)
        assert torch.equal(alone[0], batched[0][i : i + 1]) and torch.equal(alone[1], batched[1][i : i + 1])


@pytest.mark.parametrize("size", SIZES, ids=str)
def test_the_batched_path_of_other_devices_gives_the_same_pairs(size):
    for config in (AugmentConfig(), EVERYTHING):
        left, right = pair(8, *size)
        drawn = [augment_module._draw(generator, config, *size) for generator in generators(8)]
        together, one_by_one = augment_module._apply(left, right, drawn), run(left, right, config)
        assert torch.equal(together[0], one_by_one[0]) and torch.equal(together[1], one_by_one[1])


@pytest.mark.parametrize("size", SIZES, ids=str)
def test_threads_change_nothing(size, two_threads):
    left, right = pair(4, *size)
    with_two = run(left, right, EVERYTHING)
    torch.set_num_threads(1)
    with_one = run(left, right, EVERYTHING)
    assert torch.equal(with_one[0], with_two[0]) and torch.equal(with_one[1], with_two[1])


def test_switching_one_effect_off_leaves_the_draws_of_the_others():
    with_all = [augment_module._draw(generator, EVERYTHING, 64, 80) for generator in generators(3)]
    config = replace(EVERYTHING, gain_probability=0.0, blur_probability=0.0, eraser_probability=0.0, brightness=(0.5, 0.5), gamma=(1, 1))
    without = [augment_module._draw(generator, config, 64, 80) for generator in generators(3)]
    for a, b in zip(with_all, without, strict=True):
        for name in ("key", "order", "shift", "misalignment", "falloff", "centre", "noise_std", "grey"):
            assert np.array_equal(a[name], b[name]), name
        assert np.array_equal(a["colour"][:, 1:], b["colour"][:, 1:])


def test_other_samples_are_augmented_otherwise():
    left, right = (view.expand(4, -1, -1, -1) for view in pair(1))
    new_left, new_right = run(left, right, AugmentConfig())
    assert all(not torch.equal(new[i], new[j]) for new in (new_left, new_right) for i in range(4) for j in range(i))


def test_symmetric_jitter_does_the_same_to_both_images():
    left, _ = pair(6)
    config = replace(AugmentConfig.none(), jitter_probability=1.0, gamma=(0.8, 1.2))
    new_left, new_right = run(left, left, config)
    assert torch.equal(new_left, new_right) and not torch.equal(new_left, left)


def test_asymmetric_jitter_gives_each_image_numbers_of_its_own():
    left, _ = pair(6)
    new_left, new_right = run(left, left, replace(NONE, jitter_probability=1.0, asymmetric_probability=1.0))
    assert all((new_left[i] - new_right[i]).abs().mean() > 1 for i in range(6))


def test_contrast_turns_about_the_mean_of_both_images_unless_asymmetric():
    left, right = torch.full((1, 3, 8, 8), 80.0), torch.full((1, 3, 8, 8), 120.0)
    config = replace(PLAIN_JITTER, contrast=(0.5, 0.5))
    new_left, new_right = run(left, right, config)
    torch.testing.assert_close(new_left, torch.full_like(left, 90.0))
    torch.testing.assert_close(new_right, torch.full_like(left, 110.0))
    new_left, new_right = run(left, right, replace(config, asymmetric_probability=1.0))
    torch.testing.assert_close(new_left, left)
    torch.testing.assert_close(new_right, right)


def test_the_jitter_runs_in_every_order():
    orders = {tuple(augment_module._draw(generator, AugmentConfig(), 8, 8)["order"][0]) for generator in generators(400)}
    assert len(orders) == math.factorial(4)


def test_vertical_jitter_moves_the_right_image_alone_by_whole_pixels():
    left, right = pair(40)
    new_left, new_right = run(left, right, replace(NONE, vertical_jitter_px=2))
    assert torch.equal(new_left, left)
    moves = []
    for old, new in zip(right, new_right, strict=True):
        matches = [dy for dy in range(-2, 3) if torch.equal(new[:, 2:-2], old[:, 2 + dy : 62 + dy])]
        assert len(matches) == 1
        moves += matches
    assert set(moves) == {-2, -1, 0, 1, 2}


def test_a_rectification_error_stays_within_its_bound_and_on_the_right():
    ramp = torch.arange(64.0).view(1, 1, 64, 1).expand(30, 3, 64, 80) * 4  # 4 levels a row: the value tells the row
    new_left, new_right = run(ramp, ramp, replace(NONE, rectification_probability=1.0, rectification_error_px=0.5))
    assert torch.equal(new_left, ramp)
    rows = ((new_right - ramp) / 4)[:, 0, 2:-2]
    assert 0.5 < rows.abs().max() <= 1.5
    assert rows.abs().amax((1, 2)).min() > 0.01


def test_the_eraser_fills_boxes_of_the_right_image_with_its_mean_colour():
    left, right = pair(30, 200, 240)
    new_left, new_right = run(left, right, replace(NONE, eraser_probability=1.0, eraser_side_px=(50, 100)))
    assert torch.equal(new_left, left)
    for old, new in zip(right, new_right, strict=True):
        changed = (old != new).any(0)
        mean = old.double().mean((1, 2)).float()
        assert changed.any()
        torch.testing.assert_close(new[:, changed], mean[:, None].expand(3, int(changed.sum())))
        assert changed.sum() <= 2 * 100 * 100


def test_how_often_and_how_large_boxes_are_is_as_configured():
    boxes = np.stack([augment_module._draw(generator, AugmentConfig(), 384, 512)["box"] for generator in generators(2000)])
    assert not boxes[:, 0].any()
    sides = boxes[:, 1, :, 2:] - boxes[:, 1, :, :2]
    counts = (sides[..., 0] > 0).sum(1)
    for count, share in ((0, 0.5), (1, 0.25), (2, 0.25)):
        assert abs((counts == count).mean() - share) < 5 * math.sqrt(share * (1 - share) / 2000)
    used = sides[sides[..., 0] > 0]
    assert used.min() == 50 and used.max() == 100


def test_noise_has_the_drawn_strength_and_the_left_stays_clean():
    grey = torch.full((4, 3, 128, 128), 128.0)
    new_left, new_right = run(grey, grey, replace(NONE, noise_probability=1.0, noise_std=(5.1, 5.1)))
    assert torch.equal(new_left, grey)
    noise = (new_right - grey).double()
    standard_error = 5.1 / math.sqrt(noise[0].numel())
    assert noise.mean((1, 2, 3)).abs().max() < 5 * standard_error
    assert (noise.std((1, 2, 3)) - 5.1).abs().max() < 5 * standard_error
    assert (noise[0] * noise[1]).mean().abs() < 5 * 5.1**2 / math.sqrt(noise[0].numel())


def test_sensor_noise_of_the_two_cameras_is_independent():
    grey = torch.full((1, 3, 128, 128), 128.0)
    left, right = run(grey, grey, replace(NONE, sensor_noise_probability=1.0, sensor_noise_std=(3.0, 3.0)))
    left, right = (left - grey).double(), (right - grey).double()
    assert abs(left.std().item() - 3) < 0.1 and abs(right.std().item() - 3) < 0.1
    assert (left * right).mean().abs() < 5 * 9 / math.sqrt(left.numel())


def test_the_right_image_has_both_noises_whose_variances_add_up():
    grey = torch.full((1, 3, 128, 128), 128.0)
    both = replace(NONE, sensor_noise_probability=1.0, sensor_noise_std=(3.0, 3.0), noise_probability=1.0, noise_std=(4.0, 4.0))
    left, right = ((image - grey).double().std().item() for image in run(grey, grey, both))
    assert abs(left - 3) < 0.1 and abs(right - 5) < 0.15


def test_gains_and_optical_centres_differ_between_the_cameras():
    grey = torch.full((1, 3, 64, 80), 100.0)
    left, right = run(grey, grey, replace(NONE, gain_probability=1.0))
    for image in (left, right):
        assert (image == image[..., :1, :1]).all() and not torch.equal(image[:, 0], image[:, 1])
        assert 85 * 0.95 <= image.min() and image.max() <= 115 * 1.05 + 1e-3
    assert not torch.equal(left, right)
    left, right = run(grey, grey, replace(NONE, vignetting_probability=1.0, vignetting_falloff=(0.4, 0.4)))
    assert left.argmax() != right.argmax()
    for image in (left, right):
        assert 40 < image.min() < 75 and 99.9 < image.max() <= 100


def test_right_blur_leaves_the_left_image_and_defocus_takes_both():
    left, right = pair(1)
    left, right = torch.rand_like(left) * 255, torch.rand_like(right) * 255
    new_left, new_right = run(left, right, replace(NONE, blur_probability=1.0, blur_sigma_px=(0.8, 0.8)))
    assert torch.equal(new_left, left) and new_right.std() < 0.7 * right.std()
    new_left, new_right = run(left, right, replace(NONE, defocus_probability=1.0, defocus_sigma_px=(0.8, 0.8)))
    assert new_left.std() < 0.7 * left.std() and new_right.std() < 0.7 * right.std()


def test_grey_pairs_have_three_equal_channels():
    for image in run(*pair(), replace(NONE, grey_probability=1.0)):
        assert torch.equal(image[:, 0], image[:, 1]) and torch.equal(image[:, 0], image[:, 2]) and image.std() > 1


@pytest.mark.parametrize("size", [(1, 1), (1, 9), (8, 8), (50, 3)], ids=str)
@pytest.mark.parametrize("value", [0.0, 255.0, None], ids=["black", "white", "checkered"])
def test_extreme_images_stay_finite_and_in_range(size, value):
    left = torch.full((6, 3, *size), 0.0 if value is None else value)
    if value is None:
        left[..., ::2, ::2] = 255.0
    for config in (AugmentConfig(), EVERYTHING):
        for image in run(left, left.flip(-1), config):
            assert image.shape == left.shape and image.dtype == torch.float32
            assert image.isfinite().all() and image.min() >= 0 and image.max() <= 255


def test_values_beyond_the_range_are_clamped():
    left, right = pair()
    for new, old in zip(run(left * 2 - 100, right * 2 - 100, NONE), (left, right), strict=True):
        assert torch.equal(new, (old * 2 - 100).clamp(0, 255))


def test_an_empty_batch_stays_empty():
    left, right = run(torch.zeros(0, 3, 8, 8), torch.zeros(0, 3, 8, 8), AugmentConfig())
    assert left.shape == right.shape == (0, 3, 8, 8)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("jitter_probability", 1.2),
        ("blur_probability", math.nan),
        ("grey_probability", True),
        ("noise_probability", "often"),
        ("brightness", (1.4, 0.6)),
        ("contrast", 0.4),
        ("saturation", (-0.1, 1.0)),
        ("hue_turns", 0.7),
        ("gamma", (0.0, 1.0)),
        ("vertical_jitter_px", 1.5),
        ("vertical_jitter_px", -1),
        ("eraser_boxes", (0, 2)),
        ("eraser_side_px", (50.0, 100.0)),
        ("noise_std", (0.0, math.inf)),
        ("blur_sigma_px", (0.0, 50.0)),
        ("vignetting_falloff", (0.0, 1.5)),
        ("rectification_error_px", -0.5),
        ("exposure_gain", (0.9, 1.0, 1.1)),
    ],
)
def test_a_wrong_setting_is_named_with_what_it_got(name, value):
    with pytest.raises(ValueError, match=name) as caught:
        AugmentConfig(**{name: value})
    wrong = value if not isinstance(value, tuple) else next((v for v in value if repr(v) in str(caught.value)), value)
    assert repr(wrong) in str(caught.value)


@pytest.mark.parametrize(
    ("left", "right", "count", "message"),
    [
        (torch.zeros(1, 3, 8, 8, dtype=torch.uint8), torch.zeros(1, 3, 8, 8), 1, "uint8"),
        (torch.zeros(1, 3, 8, 8), torch.zeros(1, 3, 8, 9), 1, r"\[1, 3, 8, 9\]"),
        (torch.zeros(3, 8, 8), torch.zeros(3, 8, 8), 3, r"\[3, 8, 8\]"),
        (torch.zeros(2, 3, 8, 8), torch.zeros(2, 3, 8, 8), 1, "1 for 2 pairs"),
    ],
)
def test_images_and_generators_that_do_not_fit_are_an_error(left, right, count, message):
    with pytest.raises(ValueError, match=message):
        augment(left, right, generators(count), AugmentConfig())
