from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.trainers.benchmark_folders import write_image, write_pfm
from trainers.image_files import read_disparity, read_image, read_mask

HEIGHT, WIDTH = 4, 6


def colours(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)


def ramp() -> np.ndarray:
    return np.arange(1, HEIGHT * WIDTH + 1, dtype=np.float32).reshape(HEIGHT, WIDTH)


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("channels", [1, 3])
def test_pfm_is_read_bottom_up_in_either_byte_order_grey_or_colour(tmp_path, order, channels):
    write_pfm(tmp_path / "disp.pfm", ramp() if channels == 1 else np.repeat(ramp()[..., None], 3, axis=2), order)
    disparity, valid = read_disparity(tmp_path / "disp.pfm")
    np.testing.assert_array_equal(disparity, ramp())
    assert disparity.dtype == np.float32 and valid.all()


@pytest.mark.parametrize("header", ["Pf\r\n6 4\r\n-1\r\n", "Pf 6 4 -.5\n", "Pf\n6\n4\n-1e0\n"])
def test_pfm_headers_of_all_writers_are_understood(tmp_path, header):
    (tmp_path / "disp.pfm").write_bytes(header.encode() + ramp()[::-1].astype("<f4").tobytes())
    np.testing.assert_array_equal(read_disparity(tmp_path / "disp.pfm")[0], ramp())


def write_float(path: Path, stored: np.ndarray) -> None:
    if path.suffix == ".pfm":
        write_pfm(path, stored)
    elif path.suffix == ".npy":
        np.save(path, stored)
    elif path.suffix == ".npz":
        np.savez_compressed(path, depth=stored * 2, disparity=stored)
    else:
        write_image(path, stored)


@pytest.mark.parametrize("suffix", ["pfm", "tif", "tiff", "npy", "npz"])
def test_what_has_no_value_is_not_valid_and_zero(tmp_path, suffix):
    stored = ramp() / 7
    stored[0, :5] = [0, np.inf, np.nan, -3, -np.inf]
    write_float(tmp_path / f"disp.{suffix}", stored)
    disparity, valid = read_disparity(tmp_path / f"disp.{suffix}")
    assert not valid[0, :5].any() and valid.sum() == HEIGHT * WIDTH - 5
    assert (disparity[~valid] == 0).all()
    np.testing.assert_array_equal(disparity[valid], stored[valid])


def test_stored_values_are_divided(tmp_path):
    write_image(tmp_path / "byte.png", ramp().astype(np.uint8))
    write_image(tmp_path / "kitti.png", (ramp() * 256 + 64).astype(np.uint16))
    np.save(tmp_path / "whole.npy", ramp().astype(np.int64))
    np.testing.assert_array_equal(read_disparity(tmp_path / "byte.png", divisor=4)[0], ramp() / 4)
    np.testing.assert_array_equal(read_disparity(tmp_path / "kitti.png")[0], ramp() + 0.25)
    np.testing.assert_array_equal(read_disparity(tmp_path / "kitti.png", divisor=128)[0], 2 * ramp() + 0.5)
    np.testing.assert_array_equal(read_disparity(tmp_path / "whole.npy", divisor=8)[0], ramp() / 8)


def test_integers_of_an_unknown_divisor_are_not_guessed(tmp_path):
    write_image(tmp_path / "byte.png", ramp().astype(np.uint8))
    with pytest.raises(ValueError, match=r'byte\.png is 8-bit .*put \{"divisor": N\} into .*pair\.json'):
        read_disparity(tmp_path / "byte.png")
    np.save(tmp_path / "whole.npy", ramp().astype(np.uint16))
    with pytest.raises(ValueError, match=r"whole\.npy is uint16 and does not say its divisor"):
        read_disparity(tmp_path / "whole.npy")


def test_arrays_may_have_an_axis_of_one_or_one_name(tmp_path):
    np.save(tmp_path / "batch.npy", ramp()[None])
    np.save(tmp_path / "channel.npy", ramp()[..., None])
    np.savez(tmp_path / "only.npz", ramp())
    np.savez(tmp_path / "short.npz", disp=ramp(), calib=np.eye(3))
    for name in ("batch.npy", "channel.npy", "only.npz", "short.npz"):
        np.testing.assert_array_equal(read_disparity(tmp_path / name)[0], ramp())


def test_images_of_any_depth_become_rgb_bytes(tmp_path):
    image = colours()
    write_image(tmp_path / "wide.png", image.astype(np.uint16) * 257)
    write_image(tmp_path / "float.tif", image.astype(np.float32))
    write_image(tmp_path / "alpha.png", np.dstack([np.full((HEIGHT, WIDTH), 9, np.uint8), image]))  # written with its channels turned
    for name in ("wide.png", "float.tif"):
        np.testing.assert_array_equal(read_image(tmp_path / name), image)
    np.testing.assert_array_equal(read_image(tmp_path / "alpha.png"), image)
    write_image(tmp_path / "grey.png", image[..., 0])
    np.testing.assert_array_equal(read_image(tmp_path / "grey.png"), np.repeat(image[..., :1], 3, axis=2))


def test_a_mask_tells_what_is_seen_and_what_is_unknown(tmp_path):
    stored = np.array([[255, 128, 0], [254, 1, 255]], np.uint8)
    write_image(tmp_path / "mask.png", stored)
    write_image(tmp_path / "colour.png", np.repeat(stored[..., None], 3, axis=2))
    for name in ("mask.png", "colour.png"):
        nonoccluded, unknown = read_mask(tmp_path / name)
        np.testing.assert_array_equal(nonoccluded, stored == 255)
        np.testing.assert_array_equal(unknown, stored == 0)
    write_image(tmp_path / "disp_noc.png", np.array([[0, 255, 9000]], np.uint16))
    nonoccluded, unknown = read_mask(tmp_path / "disp_noc.png")
    assert nonoccluded.tolist() == [[False, True, True]] and not unknown.any()


def test_damaged_files_are_named(tmp_path):
    write_pfm(tmp_path / "disp.pfm", ramp())
    whole = (tmp_path / "disp.pfm").read_bytes()
    (tmp_path / "disp.pfm").write_bytes(whole[:-8])
    with pytest.raises(ValueError, match=r"disp\.pfm holds 88 of the 96 bytes of 6 x 4"):
        read_disparity(tmp_path / "disp.pfm")
    for start in (b"P5\n6 4\n255\n", b"Pf\n6 4\n-.-\n", b"Pf\n6\n"):
        (tmp_path / "disp.pfm").write_bytes(start + bytes(24))
        with pytest.raises(ValueError, match=r"disp\.pfm does not begin"):
            read_disparity(tmp_path / "disp.pfm")
    (tmp_path / "disp.pfm").write_bytes(b"")
    with pytest.raises(ValueError, match=r"disp\.pfm is empty$"):
        read_disparity(tmp_path / "disp.pfm")
    with pytest.raises(FileNotFoundError, match=r"no file .*nothing\.npz"):
        read_disparity(tmp_path / "nothing.npz")
    write_image(tmp_path / "colour.png", colours())
    with pytest.raises(ValueError, match="3 channels that differ"):
        read_disparity(tmp_path / "colour.png")
    write_pfm(tmp_path / "colour.pfm", colours().astype(np.float32))
    with pytest.raises(ValueError, match=r"colour\.pfm has 3 channels that differ"):
        read_disparity(tmp_path / "colour.pfm")
    (tmp_path / "right.png").write_bytes(b"no image")
    with pytest.raises(ValueError, match=r"right\.png is no image"):
        read_image(tmp_path / "right.png")


def test_arrays_that_are_no_disparity_are_named(tmp_path):
    np.save(tmp_path / "list.npy", ramp()[0])
    with pytest.raises(ValueError, match=r"list\.npy has the shape \[6\]"):
        read_disparity(tmp_path / "list.npy")
    np.save(tmp_path / "objects.npy", np.array([{"code": "runs"}]), allow_pickle=True)
    with pytest.raises(ValueError, match=r"objects\.npy is no array .*allow_pickle"):
        read_disparity(tmp_path / "objects.npy")
    np.save(tmp_path / "complex.npy", ramp() * 1j)
    with pytest.raises(ValueError, match=r"complex\.npy holds complex"):
        read_disparity(tmp_path / "complex.npy")
    np.savez(tmp_path / "two.npz", left=ramp(), right=ramp())
    with pytest.raises(ValueError, match=r'two\.npz .*holds left, right, and none is called "disparity"'):
        read_disparity(tmp_path / "two.npz")
    (tmp_path / "cut.npz").write_bytes((tmp_path / "two.npz").read_bytes()[:200])
    with pytest.raises(ValueError, match=r"cut\.npz is no array that NumPy can read"):
        read_disparity(tmp_path / "cut.npz")
    (tmp_path / "cut.npy").write_bytes((tmp_path / "list.npy").read_bytes()[:-4])
    with pytest.raises(ValueError, match=r"cut\.npy is no array that NumPy can read"):
        read_disparity(tmp_path / "cut.npy")
