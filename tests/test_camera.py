import colorsys
import math

import numpy as np
import pytest
import torch

from zsdata import camera

LUMA = (0.299, 0.587, 0.114)


def picture(n: int = 2, height: int = 7, width: int = 9, seed: int = 0) -> torch.Tensor:
    return torch.from_numpy(np.random.default_rng(seed).uniform(0, 255, (n, 3, height, width)).astype(np.float32))


def test_rows_shift_by_whole_pixels_exactly_and_the_border_repeats():
    images = picture()
    shifted = camera.shift_rows(images, torch.tensor([2, -1]))
    assert torch.equal(shifted[0, :, :-2], images[0, :, 2:]) and torch.equal(shifted[0, :, -2:], images[0, :, -1:].expand(3, 2, 9))
    assert torch.equal(shifted[1, :, 1:], images[1, :, :-1]) and torch.equal(shifted[1, :, 0], images[1, :, 0])


def test_a_rectification_error_is_the_vertical_field_of_a_plain_loop():
    images = picture()
    H, W = images.shape[-2:]
    parameters = [(0.3, 1.7, -0.6), (-2.4, -0.5, 0.9)]
    expected = np.zeros(images.shape)
    for n, (offset, edge_x, edge_y) in enumerate(parameters):
        for y in range(H):
            for x in range(W):
                source = y + offset + edge_x * (x - (W - 1) / 2) / ((W - 1) / 2) + edge_y * (y - (H - 1) / 2) / ((H - 1) / 2)
                source = min(max(source, 0), H - 1)
                above = min(int(source), H - 2)
                for c in range(3):
                    column = images[n, c, :, x].double().numpy()
                    expected[n, c, y, x] = column[above] * (above + 1 - source) + column[above + 1] * (source - above)
    misaligned = camera.misalign_rows(images, *torch.tensor(parameters).unbind(1))
    np.testing.assert_allclose(misaligned.numpy(), expected, atol=2e-3)


def test_a_rectification_error_moves_nothing_sideways():
    rows_alike = picture(height=1).expand(-1, -1, 8, -1).contiguous()
    misaligned = camera.misalign_rows(rows_alike, *torch.tensor([[0.4, 1.5, -0.7], [0.2, -1.0, 0.3]]).unbind(1))
    torch.testing.assert_close(misaligned, rows_alike)


def test_exposure_multiplies_by_gain_and_loses_the_falloff_half_a_diagonal_from_the_optical_centre():
    images = torch.full((1, 3, 5, 9), 100.0)
    exposed = camera.expose(images, torch.tensor([[1.1, 1.0, 0.9]]), torch.tensor([0.4]), torch.tensor([[0.1, -0.05]]))
    radius = math.hypot(5, 9) / 2
    for y in range(5):
        for x in range(9):
            light = 1 - 0.4 * (((x - 4) / radius - 0.1) ** 2 + ((y - 2) / radius + 0.05) ** 2)
            np.testing.assert_allclose(exposed[0, :, y, x].numpy(), [110 * light, 100 * light, 90 * light], rtol=1e-5)


def test_neutral_exposure_is_exact():
    images = picture()
    assert torch.equal(camera.expose(images, torch.ones(2, 3), torch.zeros(2), torch.full((2, 2), 0.1)), images)


def test_blur_is_the_gaussian_of_a_plain_loop():
    images, sigmas = picture(n=2), [0.6, 1.4]
    H, W = images.shape[-2:]
    blurred = camera.blur(images, camera.gaussian_half_kernels(sigmas))
    for n, sigma in enumerate(sigmas):
        radius = math.ceil(3 * sigma)
        taps = range(-radius, radius + 1)
        total = sum(math.exp(-(k**2) / (2 * sigma**2)) for k in taps)
        for y, x in ((0, 0), (3, 4), (H - 1, 2), (5, W - 1)):
            expected = sum(
                math.exp(-(i**2 + j**2) / (2 * sigma**2)) / total**2 * images[n, :, min(max(y + i, 0), H - 1), min(max(x + j, 0), W - 1)]
                for i in taps
                for j in taps
            )
            torch.testing.assert_close(blurred[n, :, y, x], expected, atol=1e-3, rtol=1e-5)


def test_a_blur_does_not_depend_on_the_sigma_of_its_neighbour():
    images = picture(n=2)
    together = camera.blur(images, camera.gaussian_half_kernels([0.4, 3.0]))
    assert torch.equal(together[:1], camera.blur(images[:1], camera.gaussian_half_kernels([0.4])))


def test_a_blur_of_next_to_nothing_leaves_the_picture():
    images = picture()
    assert torch.equal(camera.blur(images, camera.gaussian_half_kernels([1e-300, 1e-4])), images)


def test_noise_is_splitmix64_of_key_and_pixel():
    key, height, width = -(2**62) - 12345, 3, 5
    with np.errstate(over="ignore"):
        bits = np.uint64(key % 2**64) + np.arange(1, height * width + 1, dtype=np.uint64) * np.uint64(0x9E3779B97F4A7C15)
        bits = (bits ^ (bits >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        bits = (bits ^ (bits >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        bits ^= bits >> np.uint64(31)
    noise = camera.white_noise(torch.tensor([key]), height, width)
    for channel in range(3):
        field = (bits >> np.uint64(16 * channel)) & np.uint64(0xFFFF)
        expected = torch.special.ndtri((torch.from_numpy(field.astype(np.float64)) + 0.5) / 65536).float()
        torch.testing.assert_close(noise[0, channel].flatten(), expected)


def test_noise_is_normal_and_uncorrelated_between_pixels_channels_and_images():
    noise = camera.white_noise(torch.tensor([1, 2, 2**40, -7]), 384, 512).double()
    per_image = noise[0].numel()
    tolerance = 5 / math.sqrt(per_image)  # five standard errors of a mean of independent normal numbers
    assert (noise.mean((1, 2, 3)).abs() < tolerance).all()
    assert ((noise**2).mean((1, 2, 3)) - 1).abs().max() < tolerance * math.sqrt(2)
    assert ((noise**4).mean((1, 2, 3)) - 3).abs().max() < tolerance * math.sqrt(96)
    for share, bound in ((0.3173, 1), (0.0455, 2), (0.0027, 3)):
        assert abs((noise.abs() > bound).double().mean().item() - share) < tolerance
    for dy, dx in ((0, 1), (1, 0), (1, 1), (0, 2), (0, 64), (128, 0)):
        product = noise[..., dy:, dx:] * noise[..., : 384 - dy, : 512 - dx]
        assert product.mean((1, 2, 3)).abs().max() < tolerance * 1.3, (dy, dx)
    plane = 5 / math.sqrt(384 * 512)
    for a, b in ((0, 1), (0, 2), (1, 2)):
        assert (noise[:, a] * noise[:, b]).mean((1, 2)).abs().max() < plane
        assert abs((noise[a] * noise[b]).mean().item()) < tolerance


@pytest.mark.parametrize("turns", [-0.159, 0.0, 0.05, 1 / 3, 0.5])
def test_hue_turns_as_in_hsv(turns):
    corners = [(r, g, b) for r in (0, 255) for g in (0, 255) for b in (0, 255)] + [(90, 90, 20), (20, 90, 90), (90, 20, 90), (77, 77, 77)]
    images = torch.cat([torch.tensor(corners).float().T.view(1, 3, 4, 3), picture(1, 4, 3)], -1)
    rotated = camera.rotate_hue(images, torch.tensor([turns]))
    for y in range(4):
        for x in range(6):
            h, s, v = colorsys.rgb_to_hsv(*images[0, :, y, x].tolist())
            expected = colorsys.hsv_to_rgb((h + turns) % 1, s, v)
            np.testing.assert_allclose(rotated[0, :, y, x].numpy(), expected, atol=1e-3)


def test_brightness_contrast_and_saturation_are_distances_from_black_pivot_and_grey():
    images, factor = picture(1, 4, 5), 1.3
    pixel = images[0, :, 2, 3].double().numpy()
    grey = float(np.dot(LUMA, pixel))
    for changed, origin in (
        (camera.scale_brightness(images, torch.tensor([factor])), 0),
        (camera.scale_contrast(images, torch.tensor([factor]), torch.tensor([117.0])), 117),
        (camera.scale_saturation(images, torch.tensor([factor])), grey),
    ):
        np.testing.assert_allclose(changed[0, :, 2, 3].numpy(), np.clip(origin + factor * (pixel - origin), 0, 255), atol=1e-3)


def test_means_are_those_of_the_rounded_values():
    images = picture(2, 50, 70)
    np.testing.assert_allclose(camera.mean_colour(images).numpy(), images.round().double().mean((2, 3)).numpy(), rtol=1e-6)
    luma = np.tensordot(images.double().numpy(), LUMA, (1, 0))
    np.testing.assert_allclose(camera.mean_luma(images).numpy(), luma.mean((1, 2)), atol=0.05)


def test_a_gamma_curve_is_exact_at_whole_levels():
    levels = torch.arange(256.0).expand(1, 3, 1, 256)
    curve = 255 * (torch.arange(256.0) / 255) ** 1.7
    torch.testing.assert_close(camera.apply_curve(levels, curve[None])[0, 0, 0], curve)


def test_grey_has_three_equal_channels_of_the_luma():
    grey = camera.to_grey(torch.tensor([200.0, 100.0, 50.0]).view(1, 3, 1, 1))
    np.testing.assert_allclose(grey.flatten().numpy(), [200 * 0.299 + 100 * 0.587 + 50 * 0.114] * 3, rtol=1e-6)


def test_boxes_are_erased_and_cut_off_by_the_frame():
    images, colour = picture(1, 6, 8), torch.tensor([[1.0, 2.0, 3.0]])
    erased = camera.erase(images, torch.tensor([[[1, 2, 4, 5], [6, 4, 60, 50], [0, 0, 0, 0]]]), colour)
    inside = torch.zeros(6, 8, dtype=torch.bool)
    inside[2:5, 1:4] = True
    inside[4:, 6:] = True
    assert torch.equal(erased[0, :, ~inside], images[0, :, ~inside])
    assert torch.equal(erased[0, :, inside], colour[0, :, None].expand(3, int(inside.sum())))


def test_interpolation_does_not_leave_the_range_by_rounding():
    near_white = torch.linspace(254.5, 255, 64 * 512).view(1, 1, 64, 512).expand(1, 3, 64, 512)
    assert camera.misalign_rows(torch.full_like(near_white, 255.0), *torch.tensor([[0.3, 0.7, 0.4]]).unbind(1)).max() <= 255
    for gamma in (0.71, 0.9, 1.3):
        curve = 255 * (torch.arange(256.0) / 255) ** gamma
        assert camera.apply_curve(near_white, curve[None]).max() <= 255
