import cv2
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tests.scenes import jpeg, photo
from zsdata.source.photo import decode_rgb
from zsdata.synthesis.view import View, ViewConfig, draw_view, view_map, view_photo, whole_view

SMALL_SCALES = ViewConfig(min_scale=-3.5, max_scale=0)


def views(config):
    size = st.tuples(st.integers(32, 900), st.integers(32, 900))
    return st.builds(
        lambda photo_size, crop, seed, share: (photo_size, crop, draw_view(photo_size, crop, np.random.default_rng(seed), config, share)),
        size | st.sampled_from([(512, 768), (768, 1024), (480, 640)]),
        st.tuples(st.integers(32, 96), st.integers(32, 128)),
        st.integers(0, 2**32),
        st.floats(0.01, 0.2),
    )


@given(views(ViewConfig()) | views(SMALL_SCALES))
def test_a_view_lies_in_the_photo_and_gives_the_crop_and_what_lands_in_it(case):
    (photo_height, photo_width), (height, width), view = case
    top, left, rows, columns = view.window
    assert top >= 0 and left >= 0 and rows >= 1 and columns >= 1 and top + rows <= photo_height and left + columns <= photo_width
    assert (view.height, view.width - view.margin) == (height, width)
    assert view.rows == (top, top + rows)
    assert all(number % view.reduction == 0 for number in (*view.window, photo_height, photo_width))


@given(views(SMALL_SCALES))
def test_a_reduced_photo_still_has_a_pixel_for_every_pixel_of_the_view(case):
    _, _, view = case
    if view.reduction > 1:
        assert view.window[2] // view.reduction >= view.height
        assert view.window[3] // view.reduction >= view.width - 1  # the margin is rounded to whole columns


def test_small_scales_are_reduced_and_the_usual_ones_are_not():
    reductions = {draw_view((1536, 2048), (384, 512), np.random.default_rng(i), SMALL_SCALES, 0.1).reduction for i in range(200)}
    assert reductions == {1, 2, 4}
    usual = {draw_view((768, 1024), (384, 512), np.random.default_rng(i), ViewConfig(), 0.1).reduction for i in range(200)}
    assert usual == {1}


@pytest.mark.parametrize("crop", [(384, 512), (512, 512)])
def test_a_photo_of_many_pixels_shows_as_much_as_one_of_two_crops_width(crop):
    """Its disparities would be several times as large in the same crop otherwise."""
    for seed in range(50):
        known, large = (draw_view(size, crop, np.random.default_rng(seed), ViewConfig(), 0.1) for size in ((768, 1024), (3072, 4096)))
        assert large.scale_x * 4096 == pytest.approx(known.scale_x * 1024, rel=0.02)
        whole = draw_view((3072, 4096), crop, np.random.default_rng(seed), ViewConfig(max_width=8), 0.1)
        assert whole.scale_x == pytest.approx(known.scale_x, rel=0.02)
    with pytest.raises(ValueError, match=r"max_width is a number of crops, 1 or more; got 0\.5"):
        ViewConfig(max_width=0.5)


def test_windows_lie_anywhere_and_each_draw_is_its_own():
    still = ViewConfig(min_scale=0, max_scale=0, max_stretch=0)
    windows = np.array([draw_view((101, 151), (50, 60), np.random.default_rng(i), still, 0.0).window for i in range(600)])
    assert windows[:, :2].min(0).tolist() == [0, 0]
    assert (windows[:, 0] + windows[:, 2]).max() == 101 and (windows[:, 1] + windows[:, 3]).max() == 151
    assert abs(np.corrcoef(windows[:, 0], windows[:, 1])[0, 1]) < 0.15


def test_views_are_mirrored_and_stretched_as_often_as_asked():
    config = ViewConfig(min_scale=0.5, max_scale=0.5, max_stretch=1, stretch_probability=0.2, mirror_probability=0.9)
    generator = np.random.default_rng(0)
    views = [draw_view((401, 601), (50, 60), generator, config, 0.1) for _ in range(2000)]
    stretched = [not 0.96 < view.scale_x * view.window[2] / view.height < 1.04 for view in views]  # some by next to nothing
    assert np.mean(stretched) == pytest.approx(0.19, abs=0.03)
    assert np.mean([view.mirror for view in views]) == pytest.approx(0.9, abs=0.03)


@pytest.mark.parametrize("size", [(60, 300), (300, 60), (40, 50)])
def test_a_photo_smaller_than_the_crop_is_enlarged_and_keeps_its_aspect(size):
    for seed in range(20):
        view = draw_view(size, (96, 128), np.random.default_rng(seed), ViewConfig(max_stretch=0), 0.1)
        assert view.scale_x == pytest.approx(view.height / view.window[2], rel=0.05)


@pytest.mark.parametrize("size", [(768, 1024), (480, 640), (3072, 4096)])
def test_the_margin_reaches_as_far_as_the_largest_disparity_or_the_photo_goes(size):
    for seed in range(50):
        view = draw_view(size, (96, 128), np.random.default_rng(seed), ViewConfig(), 0.1)
        largest_px = 0.1 * size[1] * view.scale_x
        room_px = (size[1] - view.window[1]) * view.scale_x - (view.width - view.margin)
        assert view.margin >= min(largest_px, room_px) - 1


@pytest.mark.parametrize("orientation", [1, 3, 6])
@pytest.mark.parametrize("reduction", [2, 4])
def test_a_view_of_a_jpeg_decoded_at_a_fraction_is_the_view_of_the_whole_one(orientation, reduction):
    smooth = cv2.GaussianBlur(photo(0, 256, 384), (0, 0), 3)
    exif = b"Exif\0\0MM\0*\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01" + bytes([0, orientation, 0, 0, 0, 0, 0, 0])
    data = jpeg(smooth)
    data = data[:2] + b"\xff\xe1" + (len(exif) + 2).to_bytes(2, "big") + exif + data[2:]
    whole = decode_rgb(data)
    view = View(True, (64, 32, 128, 160), 128 // reduction, 160 // reduction, 0, reduction)
    small = decode_rgb(data, reduction)
    assert small.shape[:2] == (whole.shape[0] // reduction, whole.shape[1] // reduction)
    difference = np.abs(view_photo(small, view, reduction).astype(int) - view_photo(whole, view))
    assert difference.mean() < 1 and difference.max() < 12


@pytest.mark.parametrize("mirror", [False, True])
def test_photo_and_map_show_the_same_place(mirror):
    ramp = np.add.outer(np.arange(100.0), 0.5 * np.arange(150.0)).astype(np.float32)
    view = View(mirror, (10, 20, 60, 80), 45, 100, 0)
    shown = view_map(torch.from_numpy(ramp)[None, None], view)[0, 0].numpy()
    expected = cv2.resize(ramp[10:70, 50:130] if mirror else ramp[10:70, 20:100], (100, 45), interpolation=cv2.INTER_LINEAR)
    assert np.allclose(shown, expected[:, ::-1] if mirror else expected, atol=1e-3)
    assert np.abs(view_photo(np.repeat(ramp.round().astype(np.uint8)[..., None], 3, 2), view)[..., 1] - shown).max() < 1.5
    rows = ramp[8:75]
    assert np.array_equal(view_map(torch.from_numpy(rows)[None, None], view, first_row=8)[0, 0].numpy(), shown)


def test_a_photo_that_shrinks_to_less_than_half_of_its_pixels_is_averaged():
    checked = np.where(np.add.outer(np.arange(120), np.arange(160)) % 2, 255, 0).astype(np.uint8)
    shown = view_photo(np.repeat(checked[..., None], 3, 2), View(False, (0, 0, 120, 160), 40, 52, 0))
    assert np.abs(shown.astype(float) - 127.5).max() < 30  # finer than a pixel of the view: grey, and no pattern


def test_a_whole_view_changes_nothing():
    image = photo(1, 40, 60)
    view = whole_view((40, 60))
    assert np.array_equal(view_photo(image, view), image) and view.scale_x == 1 and view.margin == 0


@pytest.mark.parametrize("size", [(60, 96), (30, 48), (17, 90), (30, 24)])
@pytest.mark.parametrize("mirror", [False, True])
def test_maps_are_bilinear_with_pixel_centres_where_torch_has_them(size, mirror):
    values = torch.randint(0, 65_535, (2, 3, 40, 64), dtype=torch.int32)
    view = View(mirror=mirror, window=(5, 10, 30, 48), height=size[0], width=size[1], margin=0)
    window = values[..., 5:35, 6:54].flip(-1) if mirror else values[..., 5:35, 10:58]
    expected = torch.nn.functional.interpolate(window.double(), size, mode="bilinear", align_corners=False)
    assert torch.allclose(view_map(values, view).double(), expected, atol=0.5)  # of 65,535: float32 holds the place to 1e-5 px
