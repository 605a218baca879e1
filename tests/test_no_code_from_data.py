"""The sources never run code from data: no shell, no pickle, no unpacking, no evaluation."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
SOURCES = sorted([*(ROOT / "zsdata").rglob("*.py"), *(ROOT / "trainers").rglob("*.py")])

MODULES = {"pickle", "cPickle", "_pickle", "dill", "cloudpickle", "joblib", "marshal", "shelve", "code", "pty", "commands", "xmlrpc"}
CALLS = {"eval", "exec", "compile", "__import__", "execfile"}
ATTRIBUTES = {  # by their last name, whatever they are called on
    "popen", "popen2", "getoutput", "getstatusoutput", "check_shell",
    "extract", "extractall", "unpack_archive", "_extract_member",
    "read_pickle", "unsafe_load", "full_load", "mktemp", "runpy", "run_path", "run_module", "import_module",
    *(f"exec{kind}" for kind in ("l", "le", "lp", "lpe", "v", "ve", "vp", "vpe")),
    *(f"spawn{kind}" for kind in ("l", "le", "lp", "lpe", "v", "ve", "vp", "vpe")),
}  # fmt: skip
TRUE_ARGUMENTS = {"shell", "allow_pickle", "trust_remote_code"}  # may not be anything but a literal False


ALLOWED = {  # what would be a fault elsewhere, and why it is none there
    (
        "zsdata/parcel.py",
        "import pickle",
    ): "between a worker and its parent over a socket that has no name: never from a file or the network",
    ("zsdata/pool.py", "import pickle"): "whether an error can travel from a worker to its parent",
    ("trainers/ranks.py", ".execv"): "starts this very program once per rank, from the arguments that the user gave",
    ("trainers/predictors.py", ".import_module"): "the function that the user names on the command line, to judge a network of their own",
}


def faults(tree):
    """(line, what is wrong) of one source."""
    for node in ast.walk(tree):
        line = getattr(node, "lineno", 0)
        if isinstance(node, ast.Import):
            yield from ((line, f"import {name.name}") for name in node.names if name.name.split(".")[0] in MODULES)
        elif isinstance(node, ast.ImportFrom) and node.level == 0 and (node.module or "").split(".")[0] in MODULES:
            if {name.name for name in node.names} != {"UnpicklingError"}:
                yield line, f"from {node.module} import"
        elif isinstance(node, ast.Attribute) and (node.attr in ATTRIBUTES or ast.unparse(node) == "os.system"):
            yield line, f".{node.attr}"
        elif isinstance(node, ast.Call):
            yield from ((line, what) for what in call_faults(node))


def call_faults(call):
    if isinstance(call.func, ast.Name) and call.func.id in CALLS:
        yield call.func.id
    given = {argument.arg: argument.value for argument in call.keywords}
    for name in TRUE_ARGUMENTS & given.keys():
        if not (isinstance(given[name], ast.Constant) and given[name].value is False):
            yield f"{name}={ast.unparse(given[name])}"
    if isinstance(call.func, ast.Attribute) and call.func.attr == "load":
        owner = ast.unparse(call.func.value)
        safe = given.get("weights_only")
        if owner in ("torch", "torch.jit", "torch.hub") and not (
            owner == "torch" and isinstance(safe, ast.Constant) and safe.value is True
        ):
            yield f"{owner}.load without weights_only=True"
        if owner == "yaml":
            yield "yaml.load"


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: str(path.relative_to(ROOT)))
def test_nothing_in_the_sources_runs_code_from_data(path):
    name = path.relative_to(ROOT).as_posix()
    found = faults(ast.parse(path.read_text(encoding="utf-8")))
    assert [(line, what) for line, what in found if (name, what) not in ALLOWED] == []


@pytest.mark.parametrize(
    "source",
    [
        "import pickle",
        "import pickle as p",
        "from pickle import loads",
        "import joblib.memory",
        "from marshal import *",
        "from pickle import UnpicklingError, loads",
        "eval(x)",
        "exec(x)",
        "compile(x, '', 'exec')",
        "__import__(x)",
        "os.system(x)",
        "os.popen(x)",
        "system = os.system",
        "os.execvp(x, y)",
        "subprocess.run(x, shell=True)",
        "subprocess.Popen(x, shell=flag)",
        "subprocess.getoutput(x)",
        "tarfile.open(x).extractall()",
        "archive.extract(member)",
        "shutil.unpack_archive(x)",
        "torch.load(x)",
        "torch.load(x, weights_only=False)",
        "torch.load(x, weights_only=flag)",
        "torch.jit.load(x)",
        "torch.hub.load(x, y)",
        "np.load(x, allow_pickle=True)",
        "pd.read_pickle(x)",
        "yaml.load(x)",
        "AutoModel.from_pretrained(x, trust_remote_code=True)",
        "importlib.import_module(x)",
    ],
)
def test_each_way_to_run_code_from_data_is_seen(source):
    assert list(faults(ast.parse(source)))


def test_the_safe_ways_are_left_alone():
    safe = """
torch.load(x, map_location="cpu", weights_only=True)
np.load(x); np.load(x, allow_pickle=False)
re.compile(x); json.loads(x); subprocess.run(["ffmpeg", x]); model.eval(); os.execute; times.system
from pickle import UnpicklingError
AutoModel.from_pretrained(x, trust_remote_code=False)
"""
    assert not list(faults(ast.parse(safe)))


def test_there_are_sources_to_look_at():
    assert len(SOURCES) > 40
