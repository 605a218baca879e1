"""Which model, at which revision, under which licence; and what commercial_safe refuses."""

import json
import logging
import os
import subprocess
import sys
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest

from zsdata.licences import NON_COMMERCIAL, NonCommercialModel, model_record, model_records, require_commercial, warn_of_unknown_licences
from zsdata.synthesis.depth.options import DepthNetwork
from zsdata.synthesis.inpaint.builtin import BuiltinInpainter
from zsdata.synthesis.inpaint.options import DiffusionNetwork

COMMIT = "0123456789" * 4
LARGE = "Depth-Anything-V2-Large"


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
        ("---\nlicense: [other]\nlicense_name: mine\n---\n", "mine"),
        ("---\nlicense: other\nlicense_link: https://github.com/facebookresearch/net/LICENSE\n---\n", "other"),
        ("---\nlicense: other\nlicense_link: https://cc.org/by-nc/4.0\n---\n", "other (https://cc.org/by-nc/4.0)"),
        ("---\nlicense: other\nlicense_name: mine\nlicense_link: LICENSE-cc-by-nc.md\n---\n", "mine (LICENSE-cc-by-nc.md)"),
        ("---\nlicense: other\nbase_model: stabilityai/sd-turbo\n---\n", "sai-nc-community"),
        ("---\nlicense: other\nbase_model: Intel/dpt-large\n---\n", "other"),
        ("---\nbase_model: Intel/dpt-large\n---\n", "apache-2.0"),
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
@pytest.mark.parametrize("origin", ["stabilityai/sd-turbo", "./sd-turbo/unet", "/hub/models--stabilityai--sd-turbo/snapshots/01/unet"])
def test_a_renamed_copy_is_known_by_what_it_was_loaded_from(tmp_path, file, origin):
    path = tmp_path / "mine" / file
    path.parent.mkdir(parents=True)
    path.write_text(json.dumps({"_name_or_path": origin}))
    assert model_record(str(tmp_path / "mine"))["licence"] == "sai-nc-community"
    with pytest.raises(NonCommercialModel, match=rf"sai-nc-community \(by its {path.name} it is or comes from stabilityai/sd-turbo\)"):
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


@pytest.mark.parametrize(
    "name",
    [
        LARGE,
        LARGE.upper(),
        f"{LARGE}-hf-local",
        f"{LARGE}.bak",
        f"{LARGE}-hf/snapshot",
        f"{LARGE}-hf/snapshots/0123456789",
        f"depth-anything/{LARGE}/fp16",
        f"depth-anything--{LARGE}-hf/abc",
        f"depth-anything_{LARGE}-hf",
        f"a-mirror--{LARGE}-hf",
        f"models--depth-anything--{LARGE}-hf/snapshots/0123456789/deeper/down",
    ],
)
def test_a_copy_is_known_by_its_name_or_that_of_a_folder_around_it(tmp_path, name):
    (tmp_path / name).mkdir(parents=True)
    with pytest.raises(NonCommercialModel, match=rf"by its folder's name it is or comes from depth-anything/{LARGE}-hf\)"):
        require_commercial(str(tmp_path / name), "depth")
    (tmp_path / "link").symlink_to(tmp_path / name)
    with pytest.raises(NonCommercialModel, match="cc-by-nc"):
        require_commercial(str(tmp_path / "link"), "depth")


def test_a_link_is_known_by_its_own_name_too(tmp_path):
    (tmp_path / "store").mkdir()
    (tmp_path / LARGE).symlink_to(tmp_path / "store")
    with pytest.raises(NonCommercialModel, match="cc-by-nc"):
        require_commercial(str(tmp_path / LARGE), "depth")


@pytest.mark.parametrize(
    ("name", "licence"),
    [
        ("Depth-Anything-V2-Small-hf", "apache-2.0"),
        ("depth-anything--Depth-Anything-V2-Small-hf", "apache-2.0"),
        ("depth-anything-large-hf", "apache-2.0"),
        (f"{LARGE}-hf/Depth-Anything-V2-Small-hf", "apache-2.0"),
        ("Depth-Anything-V2-Small-hf-local", None),
        ("Depth-Anything-V2-Small-hf/mine", None),
        ("Depth-Anything-V2", None),
        (f"{LARGE}st", None),
        ("sd-turbo-experiments/my-depth", None),
        ("sd-turbo/work/runs/my-depth", None),
        ("turbo", None),
        ("models--somebody--sd-turbo/snapshots/0123456789", None),
    ],
)
def test_other_folders_are_not_taken_for_copies(tmp_path, name, licence):
    (tmp_path / name).mkdir(parents=True)
    require_commercial(str(tmp_path / name), "depth")
    assert model_record(str(tmp_path / name))["licence"] == licence


@pytest.mark.parametrize("licence", ["", "license: other\n", "license: apache-2.0\n"])
@pytest.mark.parametrize(
    "base",
    [
        f"depth-anything/{LARGE}-hf",
        f"depth-anything/{LARGE}",
        f"[Intel/dpt-large, depth-anything/{LARGE}-hf]",
        f"https://huggingface.co/depth-anything/{LARGE}-hf",
    ],
)
def test_a_model_is_known_by_the_base_model_of_its_card(tmp_path, hub_cache, licence, base):
    card = f"---\n{licence}base_model: {base}\n---\n"
    cached(hub_cache, "somebody/depth", card=card)
    for name in (folder(tmp_path / "mine", card), "somebody/depth"):
        with pytest.raises(
            NonCommercialModel, match=rf"under cc-by-nc-4\.0 \(by its model card it is or comes from depth-anything/{LARGE}-hf\)"
        ):
            require_commercial(name, "depth")


@pytest.mark.parametrize(
    "link", ["https://creativecommons.org/licenses/by-nc/4.0/", "LICENSE-cc-by-nc-4.0", "https://host/non-commercial.txt"]
)
@pytest.mark.parametrize("licence", ["", "license: other\n", "license: other\nlicense_name: mine\n"])
def test_a_link_to_a_non_commercial_licence_is_read(tmp_path, licence, link):
    with pytest.raises(NonCommercialModel, match=rf"under (other|mine) \({link}\), which allows no commercial use"):
        require_commercial(folder(tmp_path / "mine", f"---\n{licence}license_link: {link}\n---\n"), "depth")


def test_every_card_of_a_pipeline_is_read(tmp_path):
    name = folder(tmp_path / "mine", "---\nlicense: mit\n---\n")
    folder(tmp_path / "mine" / "turbo", "---\nlicense: cc-by-nc-4.0\n---\n")
    with pytest.raises(NonCommercialModel, match="cc-by-nc"):
        require_commercial(DiffusionNetwork(name, subfolder="turbo"), "inpaint")
    (tmp_path / "mine" / "README.md").write_text("---\nlicense: other\n---\n")
    assert model_record(name, subfolder="turbo")["licence"] == "cc-by-nc-4.0"


@pytest.mark.parametrize(
    ("licence", "refused"),
    [
        *((name, True) for name in ("cc-by-nc-4.0", "cc-by-nc-sa-4.0", "CC BY-NC 4.0", "cc-by-nc, mit", "apple-amlr", "apple-amlr, mit")),
        *((name, True) for name in ("sai-nc-community", "sai_nc_community", "stabilityai-nc-research-community", "intel-research")),
        *((name, True) for name in ("flux-1-dev-non-commercial-license", "polyform-noncommercial", "Non Commercial", "non_commercial")),
        *((name, False) for name in ("openrail++", "creativeml-openrail-m", "apache-2.0", "mit", "bsd-3-clause", "llama3", "gemma")),
        *((name, False) for name in ("ncsa", "apple-ascl", "cc-by-4.0", "commercial", "Example Inc")),
    ],
)
def test_a_non_commercial_licence_is_known_by_its_name(licence, refused):
    assert bool(NON_COMMERCIAL.search(licence)) == refused


def test_a_model_of_unknown_licence_is_warned_of_once(tmp_path, monkeypatch, caplog):
    monkeypatch.setattr("zsdata.licences._told", set())
    other = folder(tmp_path / "other", "---\nlicense: other\n---\n")
    named = folder(tmp_path / "named", "---\nlicense: other\nlicense_name: mine\n---\n")
    with caplog.at_level(logging.WARNING, "zsdata"):
        for _ in range(2):
            for step in ("somebody/depth", other, "stored", named, "Intel/dpt-large", "builtin", _estimator):
                require_commercial(step, "depth")
                warn_of_unknown_licences(step, "depth")
        warn_of_unknown_licences(DiffusionNetwork("Windsrain/ZeroStereo", autoencoder="somebody/vae"), "inpaint")
    assert [record.getMessage().partition(",")[0] for record in caplog.records] == [
        'the licence of depth="somebody/depth" is not known',
        f'the licence of depth="{other}" is not known',
        'the licence of depth="stored" is not known',
        'the licence of autoencoder="somebody/vae" is not known',
    ]


def test_a_folder_named_as_a_built_in_step_says_nothing_of_it(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("builtin", "stored"):
        folder(tmp_path / name, "---\nlicense: cc-by-nc-4.0\nbase_model: stabilityai/sd-turbo\n---\n")
        require_commercial(name, "depth")


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
        "from zsdata import DepthNetwork\n"
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
        pinned = DepthNetwork("Intel/dpt-large")

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
        (
            DiffusionNetwork("Windsrain/ZeroStereo", autoencoder="stabilityai/sd-turbo"),
            "inpaint",
            r'autoencoder="stabilityai/sd-turbo".*taesd',
        ),
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
