from __future__ import annotations

import numpy as np
import pytest

from tests.trainers.benchmark_folders import write_benchmark
from trainers.benchmarks_on_disk import BENCHMARKS, find_benchmark

LAYOUTS = [(name, variant) for name, benchmark in BENCHMARKS.items() for variant in benchmark.variants or ("",)]


@pytest.mark.parametrize(("name", "variant"), LAYOUTS)
def test_a_benchmark_is_read_as_it_is_unpacked(tmp_path, name, variant):
    expected = write_benchmark(name, tmp_path, variant)
    found = find_benchmark(name, tmp_path, variant or None)
    assert [files.name for files in found] == list(expected)
    for files, wanted in zip(found, expected.values(), strict=True):
        pair = files.read()
        np.testing.assert_array_equal(pair.left, wanted.left)
        np.testing.assert_array_equal(pair.right, wanted.right)
        valid = np.isfinite(wanted.truth) & (wanted.truth > 0)
        np.testing.assert_array_equal(pair.valid, valid)
        np.testing.assert_array_equal(pair.disparity, np.where(valid, wanted.truth, 0))
        assert valid.any() and not valid.all()
        if wanted.nonoccluded is None:
            assert pair.nonoccluded is None
        else:
            assert pair.nonoccluded is not None
            np.testing.assert_array_equal(pair.valid & pair.nonoccluded, valid & wanted.nonoccluded)


def test_the_first_variant_is_the_one_unless_told_otherwise(tmp_path):
    write_benchmark("middlebury", tmp_path, "H")
    assert [files.left.parent.parent.name for files in find_benchmark("middlebury", tmp_path)] == ["trainingH"] * 2
    with pytest.raises(FileNotFoundError, match=r"no left image of middlebury in .*training\{F,H,Q\}/SCENE"):
        find_benchmark("middlebury", tmp_path, "F")


def test_drivingstereo_is_grouped_by_weather(tmp_path):
    write_benchmark("drivingstereo", tmp_path, "H")
    assert [files.read().group for files in find_benchmark("drivingstereo", tmp_path)] == ["foggy", "rainy"]


def test_sceneflow_may_be_unpacked_without_its_folder(tmp_path):
    expected = write_benchmark("sceneflow", tmp_path, "finalpass")
    assert [files.name for files in find_benchmark("sceneflow", tmp_path / "FlyingThings3D")] == list(expected)


@pytest.mark.parametrize(
    ("name", "variant", "lost", "layout"),
    [
        ("kitti2012", "", "training/disp_noc/000001_10.png", "colored_0,colored_1,disp_occ,disp_noc"),
        ("kitti2015", "", "training/image_3/000001_10.png", "image_2,image_3,disp_occ_0,disp_noc_0"),
        ("middlebury", "Q", "trainingQ/second/mask0nocc.png", "disp0GT.pfm,mask0nocc.png"),
        ("eth3d", "", "two_view_training_gt/first/disp0GT.pfm", "two_view_training_gt/SCENE"),
        ("drivingstereo", "F", "rainy/disparity-map-full-size/second.png", "WEATHER"),
        ("sceneflow", "cleanpass", "FlyingThings3D/disparity/TEST/A/0000/left/0006.pfm", "disparity/TEST"),
    ],
)
def test_a_file_that_is_missing_is_named_before_anything_is_read(tmp_path, name, variant, lost, layout):
    write_benchmark(name, tmp_path, variant)
    (tmp_path / lost).unlink()
    with pytest.raises(FileNotFoundError) as error:
        find_benchmark(name, tmp_path, variant or None)
    assert f"no file {tmp_path / lost} (1 of " in str(error.value) and layout in str(error.value)


@pytest.mark.parametrize("name", BENCHMARKS)
def test_a_folder_of_something_else_is_told_the_layout(tmp_path, name):
    with pytest.raises(FileNotFoundError, match=f"no left image of {name} in .*; {name} lies in ROOT as "):
        find_benchmark(name, tmp_path)
    with pytest.raises(FileNotFoundError, match=r"no folder .*elsewhere"):
        find_benchmark(name, tmp_path / "elsewhere")


def test_names_and_variants_that_do_not_exist_are_refused(tmp_path):
    with pytest.raises(ValueError, match="no benchmark is called 'kitti'; there is kitti2012, kitti2015"):
        find_benchmark("kitti", tmp_path)
    with pytest.raises(ValueError, match="the variants of middlebury are H, F, Q; got X"):
        find_benchmark("middlebury", tmp_path, "X")
    with pytest.raises(ValueError, match="the variants of eth3d are none; got H"):
        find_benchmark("eth3d", tmp_path, "H")
