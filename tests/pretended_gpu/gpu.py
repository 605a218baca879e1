"""The pretended GPU itself: its tensors, and what torch.cuda says of it."""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, nullcontext
from types import SimpleNamespace
from typing import Any
from unittest import mock

import safetensors
import safetensors.torch
import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode, _disable_current_modes, return_and_correct_aliasing
from torch.utils._pytree import tree_leaves, tree_map

CPU, GPU = torch.device("cpu"), torch.device("cuda", 0)
COPIES = ("_to_copy", "copy_", "to")  # take tensors of two devices; inference mode has "to"
INDEXED = ("index", "index_put_", "_index_put_impl_")  # take indices that lie on the CPU
WAITING = ("_local_scalar_dense", "nonzero", "masked_select", "equal")  # end when the GPU has an answer
OURS = ("zsdata", "trainers")

waits: Counter[str] = Counter()  # for the GPU, by the function of ours that had to: "trainers.loop.train"
brought: Counter[str] = Counter()  # likewise, copies to the GPU that wait until all is done that it was given before


class OnGpu(Tensor):
    """Says that it is on the GPU; `inner` has its numbers."""

    inner: Tensor
    __torch_function__ = torch._C._disabled_torch_function_impl

    @staticmethod
    def __new__(cls, inner: Tensor) -> OnGpu:
        with torch.inference_mode(inner.is_inference()):
            made = Tensor._make_wrapper_subclass(
                cls,
                inner.size(),
                strides=inner.stride(),
                storage_offset=inner.storage_offset(),
                dtype=inner.dtype,
                device=GPU,
                requires_grad=inner.requires_grad,
            )
            made.inner = inner.detach()
        return made

    def __repr__(self) -> str:
        return f"OnGpu({self.inner!r})"

    def __tensor_flatten__(self) -> tuple[list[str], None]:  # torch.nn.Module.to asks whether it is there
        return ["inner"], None

    @staticmethod
    def __tensor_unflatten__(parts: dict[str, Tensor], *_: Any) -> OnGpu:
        return OnGpu(parts["inner"])

    @classmethod
    def __torch_dispatch__(cls, operation: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return compute(operation, args, kwargs or {})


def compute(operation: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    """The CPU's result, where a GPU would give one."""
    name, device = operation.overloadpacket.__name__, kwargs.get("device")
    tensors = [leaf for leaf in tree_leaves((args, kwargs)) if isinstance(leaf, Tensor)]
    on_gpu = [tensor for tensor in tensors if isinstance(tensor, OnGpu)]
    if on_gpu and name not in COPIES:
        checked = tensors[:1] if name in INDEXED else tensors
        strays = [tensor for tensor in checked if not isinstance(tensor, OnGpu) and tensor.dim() > 0]
        if strays:
            raise RuntimeError(f"{operation}: all tensors must be on one device; on the CPU are {[list(stray.shape) for stray in strays]}")
    to_gpu = bool(on_gpu) if device is None else torch.device(device).type == "cuda"
    leaves = name in COPIES and on_gpu and (not to_gpu or not isinstance(args[0], OnGpu))
    by_mask = name in INDEXED and any(tensor.dtype == torch.bool for tensor in tensors[1:])
    if on_gpu and (name in WAITING or leaves or by_mask):
        waits[_waiting()] += 1
    if to_gpu and _is_brought(name, args, kwargs):
        brought[_waiting()] += 1

    def inner(leaf: Any) -> Any:
        if isinstance(leaf, torch.device):
            return CPU if leaf.type == "cuda" else leaf
        return leaf.inner if isinstance(leaf, OnGpu) else leaf

    made = operation(*tree_map(inner, args), **tree_map(inner, kwargs))
    if not to_gpu:
        return made
    made = tree_map(lambda leaf: OnGpu(leaf) if isinstance(leaf, Tensor) else leaf, made)
    return return_and_correct_aliasing(operation, args, kwargs, made) if on_gpu else made


def _is_brought(name: str, args: Any, kwargs: dict[str, Any]) -> bool:
    """Whether it is a copy from the CPU that is not `non_blocking`."""
    if name not in COPIES:
        return False
    source, non_blocking = (args[1], args[2:3] == (True,)) if name == "copy_" else (args[0], False)
    return not isinstance(source, OnGpu) and not (non_blocking or kwargs.get("non_blocking"))


def _waiting() -> str:
    frame = sys._getframe()
    while frame is not None:
        module = frame.f_globals.get("__name__", "")
        if module.split(".")[0] in OURS:
            return f"{module}.{frame.f_code.co_name}"
        frame = frame.f_back
    return "elsewhere"


class Operations(TorchDispatchMode):
    """Sees what makes tensors on a device out of none."""

    def __torch_dispatch__(self, operation: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return compute(operation, args, kwargs or {})


class Functions(TorchFunctionMode):
    """What torch does in C++ before, or without, an operation."""

    def __torch_function__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = {name: _with_index(value) for name, value in (kwargs or {}).items()}
        first = args[0] if args else None
        if function in (torch.tensor, torch.as_tensor, torch.asarray) and kwargs.get("device") == GPU:
            return first if isinstance(first, OnGpu) else function(*args, **{**kwargs, "device": CPU}).to(GPU)
        if function is Tensor.pin_memory:
            return first.clone()
        if isinstance(first, OnGpu):
            special = SPECIAL.get(function)
            if special is not None:
                return special(*args, **kwargs)
        if function in (Tensor.to, Tensor.cuda):
            return Tensor.to(*(_with_index(value) for value in (args if function is Tensor.to else (*args, GPU))), **kwargs)
        return function(*args, **kwargs)


def _with_index(value: Any) -> Any:
    cuda = isinstance(value, (str, torch.device)) and str(value).startswith("cuda")
    return GPU if cuda else value


def _to_list(tensor: OnGpu) -> Any:
    waits[_waiting()] += 1
    return tensor.inner.tolist()


def _to_numpy(tensor: OnGpu, *_: Any, **__: Any) -> None:
    raise TypeError("can't convert cuda:0 device type tensor to numpy. Use Tensor.cpu() to copy the tensor to host memory first.")


def _new_tensor(tensor: OnGpu, data: Any, dtype: torch.dtype | None = None, **_: Any) -> Tensor:
    return torch.tensor(data, dtype=dtype or tensor.dtype).to(GPU)


def _deepcopy(tensor: OnGpu, known: dict[int, Any]) -> Tensor:
    if id(tensor) not in known:
        copied = tensor.detach().clone()
        parameter = isinstance(tensor, torch.nn.Parameter)
        known[id(tensor)] = torch.nn.Parameter(copied, tensor.requires_grad) if parameter else copied.requires_grad_(tensor.requires_grad)
    return known[id(tensor)]


def _get_item(tensor: OnGpu, index: Any) -> Tensor:
    return Tensor.__getitem__(tensor, _without_lists(index))


def _set_item(tensor: OnGpu, index: Any, value: Any) -> None:
    value = value if isinstance(value, Tensor) else torch.tensor(value, dtype=tensor.dtype).to(GPU)
    Tensor.__setitem__(tensor, _without_lists(index), value)


def _without_lists(index: Any) -> Any:
    """Lists of numbers as tensors."""
    if isinstance(index, tuple):
        return tuple(_without_lists(part) for part in index)
    return torch.tensor(index).to(GPU) if isinstance(index, list) else index


SPECIAL: dict[Any, Callable[..., Any]] = {
    Tensor.tolist: _to_list,
    Tensor.numpy: _to_numpy,
    Tensor.__array__: _to_numpy,
    Tensor.untyped_storage: lambda tensor: tensor.inner.untyped_storage(),
    Tensor.new_tensor: _new_tensor,
    Tensor.__deepcopy__: _deepcopy,
    Tensor.__getitem__: _get_item,
    Tensor.__setitem__: _set_item,
}


@contextmanager
def _as_if_there_were_no_gpu() -> Iterator[None]:
    """For what reads and writes memory by its address."""
    modes = [torch._C._pop_torch_function_stack() for _ in range(torch._C._len_torch_function_stack())]
    try:
        with _disable_current_modes():
            yield
    finally:
        for mode in reversed(modes):
            torch._C._push_on_torch_function_stack(mode)


def _in_memory(tree: Any) -> Any:
    """Every tensor of the tree as a plain one of the CPU."""
    return tree_map(lambda leaf: leaf.inner.clone() if isinstance(leaf, OnGpu) else leaf, tree)


class _SafeOpen:
    """safetensors.safe_open, which writes into memory."""

    real = staticmethod(safetensors.safe_open)

    def __init__(self, path: Any, framework: str = "pt", device: Any = "cpu", **options: Any) -> None:
        self._file, self._device = self.real(path, framework="pt", device="cpu", **options), device

    def __enter__(self) -> _SafeOpen:
        self._file.__enter__()
        return self

    def __exit__(self, *error: Any) -> None:
        self._file.__exit__(*error)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._file, name)

    def get_tensor(self, name: str) -> Tensor:
        with _as_if_there_were_no_gpu():
            tensor = self._file.get_tensor(name)
        return tensor.to(self._device)

    def get_tensors(self) -> dict[str, Tensor]:
        return {name: self.get_tensor(name) for name in self._file.keys()}


PROPERTIES = SimpleNamespace(name="pretended", major=9, minor=0, total_memory=80 << 30, multi_processor_count=132)
CUDA: dict[str, Any] = {
    "_lazy_init": lambda: None,
    "is_available": lambda: True,
    "is_initialized": lambda: True,
    "device_count": lambda: 1,
    "current_device": lambda: 0,
    "set_device": lambda device: None,
    "device": lambda device: nullcontext(),
    "synchronize": lambda device=None: None,
    "empty_cache": lambda: None,
    "memory_allocated": lambda device=None: 0,
    "memory_reserved": lambda device=None: 0,
    "max_memory_allocated": lambda device=None: 1 << 30,
    "reset_peak_memory_stats": lambda device=None: None,
    "mem_get_info": lambda device=None: (70 << 30, 80 << 30),
    "get_device_name": lambda device=None: PROPERTIES.name,
    "get_device_capability": lambda device=None: (PROPERTIES.major, PROPERTIES.minor),
    "get_device_properties": lambda device=None: PROPERTIES,
    "is_bf16_supported": lambda including_emulation=True: True,
    "manual_seed_all": lambda seed: None,
    "default_generators": (torch.Generator(),),
}


@contextmanager
def gpu() -> Iterator[Counter[str]]:
    """While it lasts, torch sees one GPU. What is given counts the waits."""
    save = torch.save
    save_file = safetensors.torch.save_file
    replaced: dict[str, Any] = {
        **{f"torch.cuda.{name}": says for name, says in CUDA.items()},
        "torch.save": lambda tree, *args, **kwargs: save(_in_memory(tree), *args, **kwargs),
        "safetensors.safe_open": _SafeOpen,
        "safetensors.torch.safe_open": _SafeOpen,
    }
    writes_weights = lambda tensors, *args, **kwargs: save_file(_in_memory(dict(tensors)), *args, **kwargs)  # noqa: E731
    for module in list(sys.modules.values()):  # whoever has imported them by name
        for name, value in (("save_file", writes_weights), ("safe_save_file", writes_weights), ("safe_open", _SafeOpen)):
            if getattr(module, name, None) in (save_file, _SafeOpen.real):
                replaced[f"{module.__name__}.{name}"] = value
    waits.clear()
    brought.clear()
    overwrites = torch.__future__.get_overwrite_module_params_on_conversion()
    with ExitStack() as stack:
        for name, value in replaced.items():
            stack.enter_context(mock.patch(name, value))
        torch.__future__.set_overwrite_module_params_on_conversion(True)
        stack.callback(torch.__future__.set_overwrite_module_params_on_conversion, overwrites)
        stack.enter_context(torch.autograd.set_multithreading_enabled(False))  # a device has a thread of its own; this one has none
        stack.enter_context(Functions())
        stack.enter_context(Operations())
        yield waits
