"""The contact sheet."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from zsdata.preview import COLUMNS, HIDDEN, INVENTED, PAPER, contact_sheet
from zsdata.sample import Masks, StereoBatch

from .scenes import photo

META = {
    "seed": 0, "epoch": 3, "index": 41, "source": "photos", "shard": "/data/shard-000007.tar", "key": "garden/0123",
    "photo_size": [480, 640], "mirror": True, "disparity_scale": 0.1, "flip_consistency": 0.93,
}  # fmt: skip


def pair(seed=0, height=64, width=420, **changes):
    """A pair whose disparity grows from left to right and whose masks are two separate blocks."""

    def image(number):
        return torch.from_numpy(photo(number, height, width)).permute(2, 0, 1).float()

    hidden, invented = torch.zeros(2, 1, height, width, dtype=torch.bool)
    hidden[:, 10:30, 20:60] = True
    invented[:, 40:50, 300:380] = True
    disparity = torch.linspace(5, 45, width).expand(1, height, width).contiguous()
    made = StereoBatch(
        left=image(4 * seed),
        right=image(4 * seed + 1),
        disparity=disparity,
        confidence=torch.linspace(0, 1, height).view(1, height, 1).expand(1, height, width).contiguous(),
        masks=Masks(~hidden, invented, torch.ones_like(hidden)),
        left_clean=image(4 * seed + 2),
        right_clean=image(4 * seed + 3),
        meta=META,
    )
    return replace(made, **changes)


def uint8(image):
    return image.permute(1, 2, 0).byte().numpy()


def tiles(sheet, first):
    """The pictures of a sheet's first row, found by the left image."""
    wanted = uint8(first.left)
    _, _, (x, y), _ = cv2.minMaxLoc(cv2.matchTemplate(sheet, wanted, cv2.TM_SQDIFF))
    height, width = wanted.shape[:2]
    columns = [x + round(i * (sheet.shape[1] - x) / len(COLUMNS)) for i in range(len(COLUMNS))]
    return [sheet[y : y + height, column : column + width] for column in columns]


def test_left_and_right_are_on_the_sheet_pixel_by_pixel():
    made = pair()
    sheet = contact_sheet([made])
    assert sheet.dtype == np.uint8 and sheet.ndim == 3 and sheet.shape[2] == 3
    left, right, *_ = tiles(sheet, made)
    assert np.array_equal(left, uint8(made.left))
    assert np.array_equal(right, uint8(made.right))


def test_disparity_is_red_where_near_blue_where_far_and_black_without_a_label():
    made = pair()
    made.masks.valid[:, :, 200:210] = False
    disparity = tiles(contact_sheet([made]), made)[2].astype(int)
    far, near = disparity[:, :20].mean((0, 1)), disparity[:, -20:].mean((0, 1))
    assert far[2] > far[0] and near[0] > near[2]
    assert not disparity[:, 200:210].any() and disparity[:, 190:200].any(-1).all()


def test_confidence_goes_from_black_to_white():
    made = pair()
    confidence = tiles(contact_sheet([made]), made)[3]
    assert not confidence[0].any() and (confidence[-1] == 255).all()


@pytest.mark.parametrize(("column", "color"), [(4, HIDDEN), (5, INVENTED)])
def test_masks_are_marked_in_colour_and_the_rest_is_grey(column, color):
    made = pair()
    tile = tiles(contact_sheet([made]), made)[column].astype(int)
    marked = (~made.masks.nonocclusion if column == 4 else made.masks.inpaint)[0].numpy()
    colored = tile.max(-1) != tile.min(-1)
    assert np.array_equal(colored, marked)
    toward = [np.argmax(color), np.argmin(color)]
    assert (tile[marked][:, toward[0]] - tile[marked][:, toward[1]] > 100).all()
    picture = cv2.cvtColor(uint8(made.left_clean if column == 4 else made.right_clean), cv2.COLOR_RGB2GRAY)
    assert np.array_equal(tile[~marked][:, 0], picture[~marked])


def test_each_pair_has_a_row_of_its_own():
    first, second = pair(0), pair(1)
    one, two, three = contact_sheet([first]), contact_sheet([first, second]), contact_sheet([first, second, first])
    row = len(two) - len(one)
    assert len(three) - len(two) == row > 64
    assert np.array_equal(three[:-row], two)
    assert np.array_equal(three[-row:], one[-row:]) and not np.array_equal(two[-row:], one[-row:])


def test_a_sheet_tells_samples_apart_by_name():
    first, other = pair(), pair(meta={**META, "index": 42})
    assert not np.array_equal(contact_sheet([first]), contact_sheet([other]))


@pytest.mark.parametrize("width", [32, 420, 1500])
def test_nothing_is_cut_off_at_the_margins(width):
    meta = {**META, "key": "a/very/long/name" * 40, "shard": "/folder/" + "shard" * 40 + ".tar", "photo_size": [65535, 65535]}
    sheet = contact_sheet([pair(width=width, meta=meta)])
    for edge in (sheet[:4], sheet[-4:], sheet[:, :4], sheet[:, -4:]):
        assert (edge == PAPER).all()


def test_odd_names_and_flat_pairs_are_drawn():
    flat = pair(disparity=torch.full((1, 64, 420), 7.0), meta={**META, "key": "gärten/\udcff猫\n"})
    assert contact_sheet([flat]).shape == contact_sheet([pair()]).shape
    unlabelled = pair()
    unlabelled.masks.valid[:] = False
    assert not tiles(contact_sheet([unlabelled]), unlabelled)[2].any()


def test_the_pairs_are_not_written_into():
    made, same = pair(), pair()
    contact_sheet([made])
    for name in ("left", "right", "disparity", "confidence", "left_clean", "right_clean"):
        assert torch.equal(getattr(made, name), getattr(same, name))
    assert all(map(torch.equal, made.masks, same.masks))


def test_what_is_no_list_of_equal_pairs_is_refused():
    with pytest.raises(ValueError, match="at least one pair"):
        contact_sheet([])
    with pytest.raises(ValueError, match="of one size"):
        contact_sheet([pair(width=420), pair(width=430)])
    with pytest.raises(ValueError, match="single pairs"):
        contact_sheet([StereoBatch.stack([pair(), pair()])])
