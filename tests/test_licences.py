"""Which model, at which revision, under which licence; and what commercial_safe refuses."""

import json
import os
import subprocess
import sys
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest

from zsdata.licences import NonCommercialModel, model_record, model_records, require_commercial
from zsdata.synthesis.depth.options import DepthNetwork
from zsdata.synthesis.inpaint.builtin import BuiltinInpainter
from zsdata.synthesis.inpaint.options import DiffusionNetwork

COMMIT = "0123456789" * 4


@pytest.fixture(autouse=True)
def hub_cache(tmp_path, monkeypatch):
    """An empty Hub cache."""
    cache = tmp_path / "hub"
    cache.mkdir()
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(cache))
    return cache


def cached(cache, name, file="config.json", card=None):
    """`name` as huggingface_hub lays it down when its branch main is at COMMIT."""
    repository = cache / f"models--{name.replace('/', '--')}"
    path = repository / "snapshots" / COMMIT / file
    path.parent.mkdir(parents=True)
    path.write_text("{}")
    if card is not None:
        (repository / "snapshots" / COMMIT / "README.md").write_text(card)
    (repository / "refs").mkdir()
    (repository / "refs" / "main").write_text(COMMIT)
    return path.parent


def folder(path, card):
    path.mkdir()
    (path / "README.md").write_text(card)
    return str(path)


def test_a_known_model_that_is_not_here_has_its_licence_and_the_revision_asked_for():
    name = "depth-anything/Depth-Anything-V2-Large-hf"
    assert model_record(name, "v1") == {"id": name, "revision": "v1", "licence": "cc-by-nc-4.0"}
    assert model_record(name.lower())["licence"] == "cc-by-nc-4.0"


def test_a_cached_model_has_its_commit_and_what_its_card_says(hub_cache):
    cached(hub_cache, "somebody/depth", card="---\nlicense: mit\n---\n# A network\n")
    assert model_record("somebody/depth") == {"id": "somebody/depth", "revision": COMMIT, "licence": "mit"}


def test_a_cached_pipeline_in_a_subfolder_is_found(hub_cache):
    cached(hub_cache, "Windsrain/ZeroStereo", "StereoGen/unet/config.json")
    assert model_record("Windsrain/ZeroStereo", subfolder="StereoGen") == {
        "id": "Windsrain/ZeroStereo",
        "revision": COMMIT,
        "licence": "mit",
    }


@pytest.mark.parametrize(
    ("card", "licence"),
    [
        ("---\nlicense: openrail++\n---\n", "openrail++"),
        ("---\nlicense: other\nlicense_name: sai-nc-community\n---\n", "sai-nc-community"),
        ("---\nlicense: other\n---\n", "other"),
        ("---\nlicense: [mit, apache-2.0]\n---\n", "mit, apache-2.0"),
        ("---\ntags: [depth]\n---\n", None),
        ("---\nlicense: [\n---\n", None),
        ("no front matter", None),
    ],
)
def test_a_folder_says_what_its_card_says(tmp_path, card, licence):
    name = folder(tmp_path / "network", card)
    assert model_record(name) == {"id": name, "revision": None, "licence": licence}


def test_a_folder_without_a_card_is_known_by_its_name(tmp_path, hub_cache):
    (tmp_path / "Depth-Anything-V2-Base-hf").mkdir()
    assert model_record(str(tmp_path / "Depth-Anything-V2-Base-hf"))["licence"] == "cc-by-nc-4.0"
    snapshot = cached(hub_cache, "stabilityai/sd-turbo", "unet/config.json").parent
    assert model_record(str(snapshot))["licence"] == "sai-nc-community"
    assert model_record(str(tmp_path))["licence"] is None


@pytest.mark.parametrize("file", ["config.json", "model_index.json", "unet/config.json"])
def test_a_renamed_copy_is_known_by_what_it_was_loaded_from(tmp_path, file):
    path = tmp_path / "mine" / file
    path.parent.mkdir(parents=True)
    path.write_text('{"_name_or_path": "stabilityai/sd-turbo"}')
    assert model_record(str(tmp_path / "mine"))["licence"] == "sai-nc-community"
    with pytest.raises(NonCommercialModel, match="sai-nc-community"):
        require_commercial(DiffusionNetwork(str(tmp_path), subfolder="mine"), "inpaint")
    for text in ('{"_name_or_path": 3}', "[]", "no json"):
        path.write_text(text)
        assert model_record(str(tmp_path / "mine"))["licence"] is None


@pytest.mark.parametrize("name", ["sd_turbo", "SD-Turbo"])
def test_a_copy_in_a_subfolder_is_known_by_its_name(tmp_path, name):
    (tmp_path / name).mkdir()
    for network in (DiffusionNetwork(str(tmp_path), subfolder=name), DiffusionNetwork(str(tmp_path / name))):
        with pytest.raises(NonCommercialModel, match="sai-nc-community"):
            require_commercial(network, "inpaint")


def test_a_card_of_the_hub_is_looked_at_before_the_model_is_loaded(hub_cache, tmp_path, monkeypatch):
    """The Hub is a web server of this machine that has one file."""
    card = b"---\nlicense: cc-by-nc-4.0\n---\n"

    class Hub(BaseHTTPRequestHandler):
        def do_HEAD(self):
            there = self.path == "/somebody/depth/resolve/main/README.md"
            self.send_response(200 if there else 404)
            if there:
                for name, value in (("ETag", '"1"'), ("X-Repo-Commit", COMMIT), ("Content-Length", str(len(card)))):
                    self.send_header(name, value)
            else:
                self.send_header("X-Error-Code", "EntryNotFound")
            self.end_headers()

        def do_GET(self):
            self.do_HEAD()
            self.wfile.write(card)

        def log_message(self, *_):
            pass

    program = (
        "from zsdata.licences import *\n"
        'fetch_cards("somebody/depth", "somebody/else", "builtin", "stored", "Intel/dpt-large", DepthNetwork("not an id"))\n'
        'print(model_record("somebody/depth"))\n'
        'require_commercial("somebody/else", "depth")\n'
        'require_commercial(DepthNetwork("somebody/depth"), "depth")\n'
    )
    with ThreadingHTTPServer(("127.0.0.1", 0), Hub) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        environment = {name: value for name, value in os.environ.items() if name not in ("HF_HUB_OFFLINE", "TRANSFORMERS_OFFLINE")}
        environment |= {"HF_ENDPOINT": f"http://127.0.0.1:{server.server_port}", "HF_HUB_CACHE": str(hub_cache)}
        done = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True, timeout=120)
        server.shutdown()
    assert str({"id": "somebody/depth", "revision": COMMIT, "licence": "cc-by-nc-4.0"}) in done.stdout, done.stderr
    assert 'NonCommercialModel: depth="somebody/depth" is under cc-by-nc-4.0' in done.stderr


def test_every_model_of_a_step_is_recorded():
    pipeline = DiffusionNetwork("sd2-community/stable-diffusion-2-inpainting", revision="main", autoencoder="madebyollin/taesd")
    assert [record["licence"] for record in model_records(pipeline)] == ["openrail++", "mit"]
    assert model_records(DepthNetwork("somebody/depth", revision="v2")) == [{"id": "somebody/depth", "revision": "v2", "licence": None}]
    assert model_records("builtin") == [{"id": "builtin", "revision": None, "licence": "apache-2.0"}]
    assert model_records(BuiltinInpainter())[0]["licence"] == "apache-2.0"
    assert model_records(_estimator) == [{"id": f"{__name__}._estimator", "revision": None, "licence": None}]

    class Loaded:
        network = DepthNetwork("Intel/dpt-large")

    assert model_records(Loaded())[0]["id"] == "Intel/dpt-large"
    json.dumps(model_records(pipeline))


def _estimator(images):
    return images[:, :1]


@pytest.mark.parametrize(
    ("step", "argument", "message"),
    [
        ("depth-anything/Depth-Anything-V2-Base-hf", "depth", r"under cc-by-nc-4\.0.*Take \"depth-anything/Depth-Anything-V2-Small-hf\""),
        (DepthNetwork("depth-anything/Depth-Anything-V2-Large-hf"), "depth", "cc-by-nc"),
        ("depth-anything/Depth-Anything-V2-Metric-Indoor-Large-hf", "depth", "cc-by-nc"),
        ("apple/DepthPro-hf", "depth", "apple-amlr"),
        ("stabilityai/sd-turbo", "inpaint", r'under sai-nc-community.*Take "Windsrain/ZeroStereo" with subfolder "StereoGen" \(mit\)'),
        (DiffusionNetwork("Windsrain/ZeroStereo", autoencoder="stabilityai/sd-turbo"), "inpaint", "sd-turbo"),
    ],
)
def test_non_commercial_models_are_refused_with_alternatives(step, argument, message):
    with pytest.raises(NonCommercialModel, match=message):
        require_commercial(step, argument)


def test_a_card_can_forbid_but_not_allow(tmp_path, hub_cache):
    with pytest.raises(NonCommercialModel, match="cc-by-nc-sa"):
        require_commercial(folder(tmp_path / "mine", "---\nlicense: cc-by-nc-sa-4.0\n---\n"), "depth")
    name = "depth-anything/Depth-Anything-V2-Large-hf"
    cached(hub_cache, name, card="---\nlicense: apache-2.0\n---\n")
    with pytest.raises(NonCommercialModel, match="cc-by-nc"):
        require_commercial(name, "depth")


@pytest.mark.parametrize(
    "step", ["builtin", "background", "depth-anything/Depth-Anything-V2-Small-hf", "Windsrain/ZeroStereo", "somebody/else", _estimator]
)
def test_other_models_pass(step):
    require_commercial(step, "depth")


def test_a_name_that_cannot_be_one_is_said():
    with pytest.raises(ValueError, match="neither a folder nor a Hub id"):
        model_record("no/such/folder")
