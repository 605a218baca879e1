"""Whole float32 on a CUDA device: what torch would take TF32 for, and the user's own settings afterwards."""

import subprocess
import sys

import pytest
import torch

from zsdata.synthesis.precision import without_tf32

NEWER = hasattr(torch.backends.cuda.matmul, "fp32_precision")
PROGRAM = """
import torch
from zsdata.synthesis.precision import without_tf32
b = torch.backends
READ = [lambda: b.cudnn.allow_tf32, lambda: b.cuda.matmul.allow_tf32, torch.get_float32_matmul_precision]
if hasattr(b.cuda.matmul, "fp32_precision"):
    for holder in (b.cuda.matmul, b.cudnn.conv, b.cudnn.rnn, b.cudnn, b.mkldnn.matmul, b.mkldnn.conv, b):
        READ.append(lambda holder=holder: holder.fp32_precision)

def state():
    def one(read):
        try:
            return read()
        except RuntimeError:
            return "mixed"
    return [one(read) for read in READ]

{}
before = state()
with without_tf32(torch.device("cpu")):
    assert state() == before
for attempt in range(2):
    try:
        with without_tf32(torch.device("cuda", 0)):
            inside = state()
            raise KeyError
    except KeyError:
        pass
    assert state() == before, (before, state())
if len(READ) == 3:
    assert inside == [False, False, "highest"], inside
else:
    assert inside[3:6] == ["ieee"] * 3, inside
    assert "mixed" in before or "mixed" not in inside, inside
"""
SETTINGS = ["", "torch.set_float32_matmul_precision('high')", "torch.set_float32_matmul_precision('medium')", "b.cudnn.allow_tf32 = False"]
SETTINGS_OF_NEWER = [
    "b.fp32_precision = 'tf32'",
    "b.fp32_precision = 'ieee'",
    "b.cuda.matmul.fp32_precision = 'tf32'",
    "b.cuda.matmul.allow_tf32 = True",
    "b.cudnn.conv.fp32_precision = 'ieee'",
    "b.cudnn.allow_tf32 = False; b.cudnn.conv.fp32_precision = 'tf32'; b.cuda.matmul.allow_tf32 = True",
]


@pytest.mark.parametrize("settings", SETTINGS + SETTINGS_OF_NEWER * NEWER)
def test_tf32_is_off_inside_and_the_users_settings_are_there_again_afterwards(settings):
    result = subprocess.run([sys.executable, "-W", "error", "-c", PROGRAM.format(settings)], capture_output=True, text=True, timeout=120)
    assert result.returncode == 0, result.stderr


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_a_convolution_on_the_gpu_is_as_exact_as_on_the_cpu():
    images, weights = torch.randn(1, 64, 32, 32), torch.randn(64, 64, 3, 3)
    with without_tf32(torch.device("cuda")):
        made = torch.nn.functional.conv2d(images.cuda(), weights.cuda()).cpu()
    assert torch.allclose(made, torch.nn.functional.conv2d(images, weights), rtol=0, atol=1e-3)
