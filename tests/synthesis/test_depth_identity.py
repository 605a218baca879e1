"""Which estimator it is: the same string for the same output, another one for another."""

import functools
import os
import shutil

import pytest

from zsdata.synthesis.depth.identity import depth_identity, hub_commit

COMMITS = "0123456789abcdef" * 2 + "01234567", "fedcba9876543210" * 2 + "01234567"


@pytest.fixture
def folder(tmp_path):
    """As transformers saves a network: configuration, pre-processing, weights in two files with their index, and a text."""
    folder = tmp_path / "network"
    folder.mkdir()
    (folder / "config.json").write_text('{"model_type": "depth_anything"}')
    (folder / "preprocessor_config.json").write_text('{"size": 518}')
    (folder / "model-00001-of-00002.safetensors").write_bytes(bytes(range(256)) * 1000)
    (folder / "model-00002-of-00002.safetensors").write_bytes(b"tensors")
    (folder / "model.safetensors.index.json").write_text("{}")
    (folder / "README.md").write_text("A network.")
    return folder


def test_the_built_in_estimator_has_a_version():
    assert depth_identity("builtin") == "builtin 1"


def test_a_folder_keeps_its_identity_where_it_is_moved_or_described(folder, tmp_path):
    identity = depth_identity(folder)
    assert identity.startswith("folder network ") and depth_identity(str(folder)) == identity
    (folder / "README.md").write_text("A very good network.")
    moved = tmp_path / "elsewhere" / "network"
    shutil.copytree(folder, moved)  # keeps the times
    assert depth_identity(moved) == depth_identity(f"{moved}/") == identity


@pytest.mark.parametrize("name", ["config.json", "preprocessor_config.json", "model-00002-of-00002.safetensors"])
def test_other_contents_are_another_estimator(folder, name):
    identity, path = depth_identity(folder), folder / name
    status = os.stat(path)
    data = path.read_bytes()
    path.write_bytes(data[:-1] + bytes([data[-1] ^ 1]))
    os.utime(path, ns=(status.st_atime_ns, status.st_mtime_ns))  # as archives do that give all files one time
    assert depth_identity(folder) != identity


def test_weights_of_another_time_or_number_are_another_estimator(folder):
    seen = {depth_identity(folder)}
    os.utime(folder / "model-00001-of-00002.safetensors", ns=(1, 1))
    seen.add(depth_identity(folder))
    (folder / "model-00002-of-00002.safetensors").rename(folder / "pytorch_model.bin")
    seen.add(depth_identity(folder))
    (folder / "pytorch_model.bin").unlink()
    seen.add(depth_identity(folder))
    (folder / "preprocessor_config.json").unlink()
    seen.add(depth_identity(folder))
    assert len(seen) == 5


def test_a_folder_without_a_configuration_is_said(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"has no config\.json"):
        depth_identity(tmp_path)


def in_hub_cache(folder, name, commit):
    """`name` as huggingface_hub lays it down when its main branch is at `commit`."""
    repository = folder / f"models--{name.replace('/', '--')}"
    snapshot = repository / "snapshots" / commit
    snapshot.mkdir(parents=True, exist_ok=True)
    (snapshot / "config.json").write_text("{}")
    (repository / "refs").mkdir(exist_ok=True)
    (repository / "refs" / "main").write_text(commit)


@pytest.fixture
def hub_cache(tmp_path, monkeypatch):
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path))
    return tmp_path


def test_a_hub_id_is_the_commit_in_the_local_cache(hub_cache):
    in_hub_cache(hub_cache, "owner/network", COMMITS[0])
    in_hub_cache(hub_cache, "owner/other", COMMITS[0])
    assert depth_identity("owner/network") == f"hub owner/network {COMMITS[0]} 3"
    assert depth_identity("owner/other") != depth_identity("owner/network")
    in_hub_cache(hub_cache, "owner/network", COMMITS[1])  # main went on; the old snapshot is still there
    assert hub_commit("owner/network") == COMMITS[1] and COMMITS[1] in depth_identity("owner/network")


def test_a_hub_id_that_was_not_downloaded_yet_is_an_error_with_the_cure(hub_cache):
    with pytest.raises(FileNotFoundError, match=r'depth="owner/network" .* local Hub cache .*: hf download owner/network;'):
        depth_identity("owner/network")


def test_a_string_that_is_neither_folder_nor_hub_id_is_said(tmp_path):
    with pytest.raises(ValueError, match="neither a folder nor a Hub id"):
        depth_identity(tmp_path / "nowhere")


def test_a_callable_is_known_by_its_cache_name():
    def estimator(images):
        return images[:, :1]

    for wrong in (None, "", 3):
        estimator.cache_name = wrong
        with pytest.raises(ValueError, match=r'estimator\.cache_name = "mynet-v3", or leave out depth_cache'):
            depth_identity(estimator)
    with pytest.raises(ValueError, match="cache_name"):
        depth_identity(functools.partial(estimator))
    estimator.cache_name = "mynet-v3"
    assert depth_identity(estimator) == "callable mynet-v3"
    estimator.cache_name = "builtin 1"
    assert depth_identity(estimator) != depth_identity("builtin")
