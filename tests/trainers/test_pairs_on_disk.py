from __future__ import annotations

import json

import numpy as np
import pytest

from tests.scenes import SHARED
from tests.trainers.benchmark_folders import write_image, write_pfm
from trainers.pairs_on_disk import find_pairs, motorcycle, pair_files, read_pair

SHARED_PAIRS = SHARED / "data" / "stereo"
HEIGHT, WIDTH = 4, 6


def colours(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)


def ramp() -> np.ndarray:
    return np.arange(1, HEIGHT * WIDTH + 1, dtype=np.float32).reshape(HEIGHT, WIDTH)


@pytest.fixture
def folder(tmp_path):
    folder = tmp_path / "pairs" / "table"
    write_image(folder / "left.png", colours(0))
    write_image(folder / "right.png", colours(1))
    write_pfm(folder / "disp.pfm", ramp())
    return folder


def test_a_folder_becomes_a_pair(folder):
    mask = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    mask[:, 2:] = 255
    mask[0, 5] = 128
    write_image(folder / "mask_left.png", mask)
    pair = read_pair(folder)
    assert pair.name == "table"
    np.testing.assert_array_equal(pair.left, colours(0))
    np.testing.assert_array_equal(pair.right, colours(1))
    np.testing.assert_array_equal(pair.disparity, ramp())
    assert pair.left.dtype == np.uint8 and pair.disparity.dtype == np.float32 and pair.valid.all()
    assert pair.nonoccluded is not None
    np.testing.assert_array_equal(pair.nonoccluded, mask[..., 0] == 255)


@pytest.mark.parametrize("suffix", ["pfm", "tif", "npy", "npz"])
def test_disparities_may_come_in_any_format(folder, suffix):
    (folder / "disp.pfm").unlink()
    path = folder / f"disp.{suffix}"
    if suffix in ("npy", "npz"):
        (np.save if suffix == "npy" else np.savez)(path, ramp())
    else:
        (write_pfm if suffix == "pfm" else write_image)(path, ramp())
    np.testing.assert_array_equal(read_pair(folder).disparity, ramp())


def test_files_are_found_before_they_are_read(folder):
    (folder / "right.png").write_bytes(b"no image")
    files = pair_files(folder)
    assert [path.name for path in files.paths] == ["left.png", "right.png", "disp.pfm"]
    with pytest.raises(ValueError, match=r"right\.png is no image"):
        files.read()


def test_a_pair_without_a_mask_says_so(folder):
    assert read_pair(folder).nonoccluded is None


def test_the_divisor_comes_from_pair_json_or_a_known_name(folder):
    (folder / "disp.pfm").unlink()
    write_image(folder / "disp.png", ramp().astype(np.uint8))
    with pytest.raises(ValueError, match=r'8-bit .*put \{"divisor": N\} into .*pair\.json'):
        read_pair(folder)
    (folder / "pair.json").write_text(json.dumps({"divisor": 3}))
    np.testing.assert_array_equal(read_pair(folder).disparity, ramp() / np.float32(3))
    known = folder.rename(folder.with_name("middlebury2001_venus"))
    np.testing.assert_array_equal(read_pair(known).disparity, ramp() / np.float32(3))
    (known / "pair.json").unlink()
    np.testing.assert_array_equal(read_pair(known).disparity, ramp() / 8)


@pytest.mark.parametrize("content", ["{", "[]", "{}", '{"divisor": 0}', '{"divisor": "3"}', '{"divisor": true}'])
def test_a_wrong_pair_json_is_named(folder, content):
    (folder / "pair.json").write_text(content)
    with pytest.raises(ValueError, match=r"pair\.json"):
        read_pair(folder)


def test_pairs_are_found_below_a_root_or_at_it(folder):
    other = folder.with_name("chair")
    write_image(other / "left.jpg", colours())
    (folder.parent / "notes").mkdir()
    assert find_pairs(folder.parent) == [other, folder]
    assert find_pairs(folder) == [folder]


def test_what_is_missing_is_named(folder, tmp_path):
    with pytest.raises(FileNotFoundError, match="nowhere"):
        find_pairs(tmp_path / "nowhere")
    (tmp_path / "empty").mkdir()
    with pytest.raises(FileNotFoundError, match=r"no pair in .*empty.*left"):
        find_pairs(tmp_path / "empty")
    (folder / "left.jpg").write_bytes(b"")
    with pytest.raises(FileNotFoundError, match=r"one file left\.\*; found left\.jpg, left\.png"):
        read_pair(folder)
    (folder / "left.jpg").unlink()
    (folder / "disp.pfm").unlink()
    with pytest.raises(FileNotFoundError, match=r"one file disp\.\*; found none"):
        read_pair(folder)


def test_files_that_do_not_fit_together_are_named(folder):
    write_pfm(folder / "disp.pfm", ramp()[:, :-1])
    with pytest.raises(ValueError, match=r"disp\.pfm is 5 x 4 px but left\.png is 6 x 4 px"):
        read_pair(folder)


def warped_difference(pair) -> tuple[float, float]:
    """Mean grey-level difference of the left image to the right one at the true disparity, and at zero."""
    ys, xs = np.nonzero(pair.valid)
    there = np.rint(xs - pair.disparity[ys, xs]).astype(int)
    inside = there >= 0
    left = pair.left[ys, xs].astype(float)[inside]
    matched = np.abs(left - pair.right[ys, there.clip(min=0)][inside]).mean()
    return matched, np.abs(left - pair.right[ys, xs][inside]).mean()


def test_the_motorcycle_is_a_left_view_pair():
    pair = motorcycle()
    assert pair.left.shape == (500, 741, 3) and pair.valid.sum() == 500 * 741 - 27226
    assert 7 < pair.disparity[pair.valid].min() and pair.disparity[pair.valid].max() < 60
    matched, unmatched = warped_difference(pair)
    assert matched < 0.3 * unmatched


@pytest.mark.skipif(not SHARED_PAIRS.is_dir(), reason="no development data")
def test_real_benchmark_pairs_have_their_documented_disparities():
    ranges = {  # name: smallest and largest disparity, density
        "eth3d_terrace": (8.12, 17.42, 53.2),
        "flyingthings3d_train_a0000_0006": (1.21, 152.12, 100.0),
        "kitti2012_000001": (4.24, 124.07, 24.2),
        "middlebury2001_venus": (3.00, 19.75, 100.0),
        "middlebury2003_cones": (5.50, 55.00, 96.8),
        "middlebury2003_teddy": (12.50, 52.75, 98.0),
        "middlebury2005_art": (24.33, 74.67, 99.9),
        "middlebury2005_moebius": (21.33, 72.67, 99.5),
        "middlebury2005_reindeer": (3.67, 67.00, 99.5),
        "middlebury2006_aloe": (43.00, 211.00, 96.5),
        "middlebury2006_cloth3": (22.50, 83.00, 99.2),
        "middlebury2006_wood2": (21.50, 108.50, 98.1),
    }
    folders = find_pairs(SHARED_PAIRS)
    assert {folder.name for folder in folders} == set(ranges)
    for folder in folders:
        pair = read_pair(folder)
        known = pair.disparity[pair.valid]
        assert (known.min(), known.max(), 100 * pair.valid.mean()) == pytest.approx(ranges[folder.name], abs=0.06), folder.name
        assert (pair.nonoccluded is not None) == (folder / "mask_left.png").exists()
        matched, unmatched = warped_difference(pair)
        assert matched < 0.5 * unmatched, folder.name
