import io
import json
import os
import re
import struct

import cv2
import numpy as np
import pytest

from tests.scenes import SHARED, photo, write_tar
from trainers.inpaint_data.layouts import LAYOUTS, StereoFolder
from trainers.inpaint_data.stored_maps import StereoFrame, decode_map
from trainers.inpaint_data.tars import StereoTars
from trainers.pairs_on_disk import find_pairs, read_pair
from zsdata.faults import BadPhoto, BadShard

HEIGHT, WIDTH = 12, 20
REAL = SHARED / "data" / "stereo"
THINGS = REAL / "flyingthings3d_train_a0000_0006"


def png(values):
    return cv2.imencode(".png", values[..., ::-1] if values.ndim == 3 else values)[1].tobytes()


def jpg(image):
    return cv2.imencode(".jpg", image[..., ::-1])[1].tobytes()


def webp(image):
    return cv2.imencode(".webp", image[..., ::-1], [cv2.IMWRITE_WEBP_QUALITY, 101])[1].tobytes()


def pfm(values, big_endian=False):
    """As the format says: rows from the bottom up, the sign of the scale is the byte order."""
    header = f"Pf\n{values.shape[1]} {values.shape[0]}\n{'' if big_endian else '-'}1.0\n".encode()
    rows = [struct.pack(f"{'>' if big_endian else '<'}{len(row)}f", *row) for row in values[::-1]]
    return header + b"".join(rows)


def npy(values):
    file = io.BytesIO()
    np.save(file, values)
    return file.getvalue()


def camera(fx):
    return json.dumps({"camera_settings": [{"name": "left", "intrinsic_settings": {"fx": fx, "fy": fx}}, {}]}).encode()


def write(root, files):
    for name, data in files.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_bytes(data)
    return root


def ramp(low, high):
    """A different value in every pixel, so that no two can be mixed up."""
    return np.linspace(low, high, HEIGHT * WIDTH, dtype=np.float64).reshape(HEIGHT, WIDTH)


LEFT, RIGHT = photo(0, HEIGHT, WIDTH), photo(1, HEIGHT, WIDTH)
DISPARITY, RIGHT_DISPARITY = ramp(1, 40), ramp(2, 50)
DEPTH_CM = ramp(50, 65_535).astype(np.uint16)
DEPTH_FAT = ramp(4_000, 60_000).astype(np.uint16)  # tenths of a millimetre

# kind -> a data set of one pair as published, and the disparity of the left view that it means
PUBLISHED = {
    "sceneflow-clean": (
        {
            "FlyingThings3D/frames_cleanpass/TRAIN/A/0000/left/0006.png": png(LEFT),
            "FlyingThings3D/frames_cleanpass/TRAIN/A/0000/right/0006.png": png(RIGHT),
            "FlyingThings3D/disparity/TRAIN/A/0000/left/0006.pfm": pfm(DISPARITY),
            "FlyingThings3D/disparity/TRAIN/A/0000/right/0006.pfm": pfm(-RIGHT_DISPARITY),
            "FlyingThings3D/frames_cleanpass/TEST/A/0000/left/0006.png": b"never read",
            "FlyingThings3D/frames_finalpass/TRAIN/A/0000/left/0006.png": b"another pass",
        },
        DISPARITY,
    ),
    "sceneflow-final": (
        {
            "frames_finalpass/15mm_focallength/scene_forwards/fast/left/0001.png": png(LEFT),
            "frames_finalpass/15mm_focallength/scene_forwards/fast/right/0001.png": png(RIGHT),
            "disparity/15mm_focallength/scene_forwards/fast/left/0001.pfm": pfm(DISPARITY, big_endian=True),
        },
        DISPARITY,
    ),
    "tartanair": (
        {
            "abandonedfactory/abandonedfactory/Easy/P000/image_left/000000_left.png": png(LEFT),
            "abandonedfactory/abandonedfactory/Easy/P000/image_right/000000_right.png": png(RIGHT),
            "abandonedfactory/abandonedfactory/Easy/P000/depth_left/000000_left_depth.npy": npy(ramp(1, 10_000).astype(np.float32)),
        },
        80 / ramp(1, 10_000),
    ),
    "crestereo": (
        {
            "tree/0a_left.jpg": jpg(LEFT),
            "tree/0a_right.jpg": jpg(RIGHT),
            "tree/0a_left.disp.png": png(np.round(32 * DISPARITY).astype(np.uint16)),
            "tree/0a_right.disp.png": png(np.round(32 * RIGHT_DISPARITY).astype(np.uint16)),
        },
        np.round(32 * DISPARITY) / 32,
    ),
    "vkitti2": (
        {
            "Scene01/15-deg-left/frames/rgb/Camera_0/rgb_00000.jpg": jpg(LEFT),
            "Scene01/15-deg-left/frames/rgb/Camera_1/rgb_00000.jpg": jpg(RIGHT),
            "Scene01/15-deg-left/frames/depth/Camera_0/depth_00000.png": png(DEPTH_CM),
        },
        725.0087 * 0.532725 / (DEPTH_CM / 100),
    ),
    "fallingthings": (
        {
            "fat/single/002_master_chef_can_16k/kitchen_0/000000.left.jpg": jpg(LEFT),
            "fat/single/002_master_chef_can_16k/kitchen_0/000000.right.jpg": jpg(RIGHT),
            "fat/single/002_master_chef_can_16k/kitchen_0/000000.left.depth.png": png(DEPTH_FAT),
            "fat/single/002_master_chef_can_16k/kitchen_0/000000.right.depth.png": png(DEPTH_FAT),
            "fat/single/002_master_chef_can_16k/kitchen_0/_camera_settings.json": camera(768.1605834960938),
        },
        768.1605834960938 * 0.06 / (DEPTH_FAT / 10_000),
    ),
}


@pytest.mark.parametrize("kind", LAYOUTS)
def test_a_pair_is_read_as_it_is_published(tmp_path, kind):
    files, disparity = PUBLISHED[kind]
    pairs = StereoFolder(kind, write(tmp_path, files))
    assert len(pairs) == 1
    frame = pairs.read(0)
    for image, stored, other in ((frame.left, LEFT, RIGHT), (frame.right, RIGHT, LEFT)):
        if next(iter(files)).endswith(".png"):
            assert np.array_equal(image, stored)
        assert np.abs(image.astype(int) - stored).mean() < 0.3 * np.abs(image.astype(int) - other).mean()  # JPEG
    assert frame.disparity.dtype == np.float32 and np.allclose(frame.disparity, disparity, rtol=1e-6)
    assert (frame.right_disparity is not None) == (kind in ("sceneflow-clean", "crestereo", "fallingthings"))
    assert pairs.place(0) == (str(tmp_path), next(iter(files)))


@pytest.mark.parametrize("root", ["", "vkitti_2.0.3_rgb"])
def test_virtual_kitti_is_read_as_its_tars_unpack_too(tmp_path, root):
    files, disparity = PUBLISHED["vkitti2"]
    files = files | {"Scene01/15-deg-left/frames/depth/Camera_1/depth_00000.png": png(DEPTH_CM)}
    write(tmp_path, {f"vkitti_2.0.3_{'depth' if '/depth/' in name else 'rgb'}/{name}": data for name, data in files.items()})
    pairs = StereoFolder("vkitti2", tmp_path / root)
    frame = pairs.read(0)
    assert len(pairs) == 1 and frame.right_disparity is not None
    assert np.allclose(frame.disparity, disparity, rtol=1e-6)
    (tmp_path / "vkitti_2.0.3_depth" / "Scene01/15-deg-left/frames/depth/Camera_0/depth_00000.png").unlink()
    with pytest.raises(FileNotFoundError, match=r"no file .*vkitti_2.0.3_depth/Scene01.*depth_00000.png, which belongs to .*rgb_00000.jpg"):
        StereoFolder("vkitti2", tmp_path / root)


def test_disparity_of_the_right_view_is_positive_too(tmp_path):
    frame = StereoFolder("sceneflow-clean", write(tmp_path, PUBLISHED["sceneflow-clean"][0])).read(0)
    assert frame.right_disparity is not None and np.allclose(frame.right_disparity, RIGHT_DISPARITY, rtol=1e-6)


def test_all_of_scene_flow_is_found_from_one_folder_also_as_webp_and_through_links(tmp_path):
    for name, frame in {"Monkaa": "a_rain_of_stones_x2/{}/0048", "Driving": "35mm_focallength/scene_backwards/slow/{}/0001"}.items():
        images = {f"frames_cleanpass_webp/{frame.format(side)}.webp": webp(LEFT) for side in ("left", "right")}
        write(tmp_path / "elsewhere" / name, images | {f"disparity/{frame.format('left')}.pfm": pfm(DISPARITY)})
    write(tmp_path / "all", PUBLISHED["sceneflow-clean"][0])
    for name in ("Monkaa", "Driving"):
        os.symlink(tmp_path / "elsewhere" / name, tmp_path / "all" / name)
    pairs = StereoFolder("sceneflow-clean", tmp_path / "all")
    assert [pairs.place(i)[1].split("/")[0] for i in range(len(pairs))] == ["Driving", "FlyingThings3D", "Monkaa"]
    assert all(np.abs(pairs.read(i).left.astype(int) - LEFT).max() <= 1 for i in range(3))


def test_links_that_go_round_or_lead_to_one_folder_count_each_pair_once(tmp_path):
    root = write(tmp_path / "all", PUBLISHED["sceneflow-clean"][0])
    for name, target in {"again": "FlyingThings3D", "current": ".", "latest": ".", "FlyingThings3D/up": ".."}.items():
        os.symlink(target, root / name)  # "again" comes before the folder itself
    pairs = StereoFolder("sceneflow-clean", root)
    assert [pairs.place(i)[1] for i in range(len(pairs))] == ["FlyingThings3D/frames_cleanpass/TRAIN/A/0000/left/0006.png"]


@pytest.mark.skipif(not THINGS.is_dir(), reason="the real pair is not here")
def test_the_real_flyingthings3d_pair_reprojects(tmp_path):
    where = {"left.png": "frames_cleanpass/{}/left/0006.png", "right.png": "frames_cleanpass/{}/right/0006.png"}
    where["disp.pfm"] = "disparity/{}/left/0006.pfm"
    frame = StereoFolder(
        "sceneflow-clean", write(tmp_path, {to.format("TRAIN/A/0000"): (THINGS / name).read_bytes() for name, to in where.items()})
    ).read(0)
    assert frame.disparity.shape == (540, 960) and 1.2 < frame.disparity.min() and frame.disparity.max() < 152.2
    column = np.arange(960) - np.round(frame.disparity).astype(int)
    inside = column >= 0
    shown = np.take_along_axis(frame.right, column.clip(0)[..., None], axis=1)
    difference = np.abs(shown.astype(int) - frame.left).mean(-1)[inside]
    assert np.median(difference) < 3, "left (x, y) is right (x - d, y)"


def test_a_falling_things_camera_of_another_focal_length_is_believed(tmp_path):
    files, disparity = PUBLISHED["fallingthings"]
    name = next(name for name in files if name.endswith(".json"))
    halved = StereoFolder("fallingthings", write(tmp_path, files | {name: camera(384.0802917480469)})).read(0)
    assert np.allclose(halved.disparity, disparity / 2, rtol=1e-6)
    (tmp_path / name).unlink()
    assert np.allclose(StereoFolder("fallingthings", tmp_path).read(0).disparity, disparity, rtol=1e-6)
    (tmp_path / name).write_bytes(b"{}")
    with pytest.raises(BadPhoto, match="gives no focal length"):
        StereoFolder("fallingthings", tmp_path).read(0)


def test_where_the_range_of_falling_things_ends_nothing_is_known(tmp_path):
    files, disparity = PUBLISHED["fallingthings"]
    stored = DEPTH_FAT.copy()
    stored[2, 3:5] = 65_534, 65_535
    changed = {name: png(stored) for name in files if name.endswith(".depth.png")}
    frame = StereoFolder("fallingthings", write(tmp_path, files | changed)).read(0)
    assert frame.right_disparity is not None
    for known in (frame.disparity, frame.right_disparity):
        assert np.argwhere(np.isnan(known)).tolist() == [[2, 4]]
        assert known[2, 3] == pytest.approx(768.1605834960938 * 0.06 / 6.5534) and np.allclose(known[3:], disparity[3:], rtol=1e-6)


def thinned(values, share):
    """As a lidar tells it: 0, unknown, but for the first `share` of every row."""
    return np.where(np.arange(WIDTH) < share * WIDTH, values, 0)


@pytest.mark.parametrize(("side", "name"), [("left", "disparity map"), ("right", "right disparity map")])
def test_a_sparse_truth_is_refused_whichever_view_it_is_of(tmp_path, side, name):
    files = PUBLISHED["sceneflow-clean"][0]
    truth = f"FlyingThings3D/disparity/TRAIN/A/0000/{side}/0006.pfm"
    for share in (0.25, 0.45):
        pairs = StereoFolder("sceneflow-clean", write(tmp_path, files | {truth: pfm(thinned(DISPARITY, share))}))
        with pytest.raises(BadPhoto, match=f"^sparse truth: {100 * share:.0f} % of the {name} is known, half is needed$"):
            pairs.read(0)
    (tmp_path / truth).write_bytes(pfm(thinned(DISPARITY, 0.5)))
    frame = pairs.read(0)
    known = frame.disparity if side == "left" else frame.right_disparity
    assert known is not None and np.isnan(known).mean() == 0.5


@pytest.mark.skipif(not REAL.is_dir(), reason="the real pairs are not here")
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_of_the_real_pairs_only_those_of_a_lidar_are_sparse():
    refused = []
    for folder in find_pairs(REAL):
        pair = read_pair(folder)
        try:
            StereoFrame(pair.left, pair.right, np.where(pair.valid, pair.disparity, np.nan), None).checked()
        except BadPhoto as fault:
            refused.append((pair.name, fault.reason))
    assert refused == [("kitti2012_000001", "sparse truth: 24 % of the disparity map is known, half is needed")]


def test_values_that_mean_nothing_are_unknown(tmp_path):
    stored = DISPARITY.copy()
    stored[0, :3] = 0, np.inf, np.nan
    frame = StereoFolder(
        "sceneflow-clean",
        write(tmp_path, PUBLISHED["sceneflow-clean"][0] | {"FlyingThings3D/disparity/TRAIN/A/0000/left/0006.pfm": pfm(stored)}),
    ).read(0)
    assert np.isnan(frame.disparity[0, :3]).all() and np.isnan(frame.disparity).sum() == 3


@pytest.mark.parametrize("kind", LAYOUTS)
def test_a_folder_without_pairs_or_with_half_of_them_says_what_it_should_hold(tmp_path, kind):
    with pytest.raises(FileNotFoundError, match=re.escape(LAYOUTS[kind].example)):
        StereoFolder(kind, tmp_path)
    with pytest.raises(FileNotFoundError, match="no folder"):
        StereoFolder(kind, tmp_path / "nowhere")
    files = list(PUBLISHED[kind][0].items())
    write(tmp_path, dict(files[:2]))
    with pytest.raises(FileNotFoundError, match=f"no file .*{re.escape(files[2][0].rsplit('/', 1)[1])}"):
        StereoFolder(kind, tmp_path)


def test_the_example_of_each_layout_fits_it():
    for kind, layout in LAYOUTS.items():
        assert layout.left.fullmatch(layout.example.split(",")[0]), kind


def test_an_unknown_data_set_is_refused_with_the_known_ones(tmp_path):
    with pytest.raises(ValueError, match=r"'kitti'; there is sceneflow-clean, sceneflow-final, tartanair"):
        StereoFolder("kitti", tmp_path)


def test_damaged_files_of_a_pair_are_told_apart(tmp_path):
    files = PUBLISHED["sceneflow-clean"][0]
    truth = "FlyingThings3D/disparity/TRAIN/A/0000/left/0006.pfm"
    cases = {
        "damaged map: it holds 96 of the 960 bytes of 20 x 12 values": {truth: files[truth][: -(960 - 96)]},
        "sizes differ: the disparity is 19 x 12, the left image 20 x 12": {truth: pfm(DISPARITY[:, 1:])},
        "no truth: nothing of the disparity map is known": {truth: pfm(0 * DISPARITY)},
        "empty file": {"FlyingThings3D/frames_cleanpass/TRAIN/A/0000/right/0006.png": b""},
    }
    for message, change in cases.items():
        pairs = StereoFolder("sceneflow-clean", write(tmp_path, files | change))
        with pytest.raises(BadPhoto, match=message):
            pairs.read(0)
    pairs = StereoFolder("sceneflow-clean", write(tmp_path, files))
    (tmp_path / truth).unlink()
    with pytest.raises(BadPhoto, match="no file"):
        pairs.read(0)


def test_no_map_runs_code(tmp_path):
    class Trap:
        def __reduce__(self):
            return os.mkdir, (str(tmp_path / "trapped"),)

    with pytest.raises(BadPhoto, match="damaged map"):
        decode_map(npy(np.array([Trap()], object)), "npy")
    assert not (tmp_path / "trapped").exists()


@pytest.mark.parametrize(
    ("data", "extension"),
    [
        (b"", "png"),
        (png(LEFT), "png"),
        (png(LEFT[..., 0]), "png"),
        (b"PF\n1 1\n-1.0\n" + bytes(12), "pfm"),
        (b"", "pfm"),
        (b"PK\x03\x04", "npy"),
        (npy(np.zeros((2, 3, 4))), "npy"),
        (npy(DISPARITY)[:-1], "npy"),
        (npy(np.array([["a"]])), "npy"),
    ],
)
def test_what_is_no_map_is_refused(data, extension):
    with pytest.raises(BadPhoto, match="damaged map"):
        decode_map(data, extension)


def tar_members(key, left=LEFT, disparity=None):
    return {f"{key}.left.png": png(left), f"{key}.right.webp": webp(RIGHT), f"{key}.disp.pfm": disparity or pfm(DISPARITY)}


def test_pairs_come_from_tars_as_from_folders(tmp_path):
    stored = np.round(DISPARITY * 256).astype(np.uint16)
    first = write_tar(
        tmp_path / "a.tar",
        {
            **tar_members("scene/0001"),
            "scene/0001.disp_right.npy": npy(RIGHT_DISPARITY.astype(np.float32)),
            "scene/0001.txt": b"anything",
            "scene/0001.json": b"{}",
        },
    )
    second = write_tar(tmp_path / "b.tar", {"0.LEFT.JPG": jpg(LEFT), "0.right.jpeg": jpg(RIGHT), "0.disp.png": png(stored)})
    pairs = StereoTars([first, second])
    assert [pairs.place(i) for i in range(len(pairs))] == [(first, "scene/0001"), (second, "0")]
    frame, other = pairs.read(0), pairs.read(1)
    assert np.array_equal(frame.left, LEFT) and np.abs(frame.right.astype(int) - RIGHT).max() <= 1
    assert np.allclose(frame.disparity, DISPARITY, rtol=1e-6)
    assert frame.right_disparity is not None and np.allclose(frame.right_disparity, RIGHT_DISPARITY, rtol=1e-6)
    assert np.allclose(other.disparity, stored / 256) and other.right_disparity is None
    assert pairs.digest != StereoTars(first).digest == StereoTars(str(tmp_path / "a.tar")).digest
    (tmp_path / "new").mkdir()
    anew = write_tar(tmp_path / "new" / "b.tar", {"0.LEFT.JPG": jpg(LEFT), "0.right.jpeg": jpg(LEFT), "0.disp.png": png(stored)})
    assert StereoTars(second).digest != StereoTars(anew).digest, "the same names, other bytes"


@pytest.mark.parametrize(("extension", "stored"), [("pfm", pfm), ("npy", npy)])
def test_a_sign_that_is_the_direction_of_the_shift_counts_for_nothing(tmp_path, extension, stored):
    """As some releases of Scene Flow write the right view's disparity; what nobody knows stays unknown."""
    truth = -RIGHT_DISPARITY
    truth[1, :4] = 0, np.inf, -np.inf, np.nan
    members = tar_members("0001") | {f"0001.disp_right.{extension}": stored(truth)}
    known = StereoTars(write_tar(tmp_path / "a.tar", members)).read(0).right_disparity
    assert known is not None and np.isnan(known[1, :4]).all() and np.isnan(known).sum() == 4
    assert np.allclose(known[2:], RIGHT_DISPARITY[2:], rtol=1e-6)


def test_a_map_of_one_value_below_0_knows_nothing(tmp_path):
    members = tar_members("0001") | {"0001.disp_right.pfm": pfm(np.full_like(DISPARITY, -1))}
    with pytest.raises(BadPhoto, match="no truth: nothing of the right disparity map is known"):
        StereoTars(write_tar(tmp_path / "a.tar", members)).read(0)


def test_what_is_below_0_among_positive_disparities_is_unknown(tmp_path):
    """Such as -1, by which many say that nobody knows."""
    truth = DISPARITY.copy()
    truth[3, 5:7] = -1
    members = tar_members("0001", disparity=pfm(truth))
    known = StereoTars(write_tar(tmp_path / "a.tar", members)).read(0).disparity
    assert np.argwhere(np.isnan(known)).tolist() == [[3, 5], [3, 6]]


def test_incomplete_pairs_and_damage_in_tars_are_told(tmp_path, caplog):
    members = tar_members("0001") | {"0002.left.png": png(LEFT)} | tar_members("0003")
    path = write_tar(tmp_path / "a.tar", members)
    whole = (tmp_path / "a.tar").read_bytes()
    (tmp_path / "a.tar").write_bytes(whole[: whole.rindex(b"0003.disp.pfm")])
    pairs = StereoTars(path)
    assert len(pairs) == 1 and "3 faults in the tars of pairs" in caplog.text
    with pytest.raises(ValueError, match=r'no stereo pair in .*"0002" in .*b.tar lacks 0002.right.\*, 0002.disp.\*'):
        StereoTars(write_tar(tmp_path / "b.tar", {"0002.left.png": png(LEFT)}))


def test_a_tar_that_loses_its_end_later_is_a_fault_of_that_pair(tmp_path):
    path = write_tar(tmp_path / "a.tar", tar_members("0001"))
    pairs = StereoTars(path)
    whole = (tmp_path / "a.tar").read_bytes()
    (tmp_path / "a.tar").write_bytes(whole[: whole.index(b"Pf\n20 12") + 100])
    with pytest.raises(BadShard, match=r'ends inside "0001.disp" \(100 of 974 bytes\)'):
        pairs.read(0)
