"""Count what a program asks of a GPU: kernels, operations of PyTorch, copies and waits.

It counts in Triton's interpreter too, where all tensors are on the CPU. A tensor that is made from numbers of
Python or from an array, without a device, counts as one of the host, as do results of such tensors alone.
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import patch

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

import cleargs

KINDS = ("kernel", "operation", "copy", "wait")
"""A launch of a Triton kernel; an operation of PyTorch that launches at least one; a copy from the host to
the device; a wait of the host for the device."""

_PACKAGE = str(Path(cleargs.__file__).parent)
_FROM_HOST = ("tensor", "from_numpy", "frombuffer", "as_tensor")
_WAITS = ("item", "tolist", "cpu", "numpy", "__int__", "__float__", "__bool__", "__index__", "nonzero")


class DeviceCalls:
    """Numbers of calls by kind and by the function of the package that makes them."""

    def __init__(self) -> None:
        self.counts: Counter[tuple[str, str]] = Counter()
        self._host: dict[int, Tensor] = {}  # by id; kept, so that no id is used again
        self._paused = 0

    def total(self, *kinds: str) -> int:
        """Return the number of calls of these kinds, or of all."""
        return sum(count for (kind, _), count in self.counts.items() if kind in (kinds or KINDS))

    def table(self) -> str:
        """Return a line per function, with a column per kind."""
        places = sorted({place for _, place in self.counts})
        rows = [[place, *(self.counts[kind, place] for kind in KINDS)] for place in places]
        rows.append(["total", *(self.total(kind) for kind in KINDS)])
        head = f"{'':52}" + "".join(f"{kind:>11}" for kind in KINDS)
        lines = (f"{row[0]:52}" + "".join(f"{count or '':>11}" for count in row[1:]) for row in rows)
        return "\n".join([head, *lines])

    @contextmanager
    def counting(self, kernel: Any) -> Iterator[None]:
        """Count until the block ends. ``kernel`` is any Triton kernel."""
        kind = type(kernel)
        run = kind.run

        def launch(fn: Any, *given: Any, **options: Any) -> Any:
            self._note("kernel", fn.__name__)
            self._paused += 1
            try:
                return run(fn, *given, **options)
            finally:
                self._paused -= 1

        with ExitStack() as stack:
            stack.enter_context(patch.object(kind, "run", launch))
            stack.enter_context(_Functions(self))
            stack.enter_context(_Operations(self))
            yield

    def function(self, func: Callable[..., Any], given: Any, options: dict[str, Any]) -> Any:
        """Call a function of PyTorch, and count a copy or a wait."""
        if self._paused:
            return func(*given, **options)
        name = func.__name__
        tensors = [leaf for leaf in tree_leaves((given, options)) if isinstance(leaf, Tensor)]
        on_host = bool(tensors) and all(id(tensor) in self._host for tensor in tensors)
        if name in _WAITS and not on_host:
            self._note("wait", _place())
        targets = (*given[1:], *options.values())
        moves = name == "to" and any(isinstance(target, (torch.device, str)) for target in targets)
        if moves and on_host:
            self._note("copy", _place())
        pauses = on_host or moves or name in (*_FROM_HOST, *_WAITS)
        if name in _FROM_HOST and "device" in options:
            self._note("copy", _place())
        self._paused += pauses
        try:
            result = func(*given, **options)
        finally:
            self._paused -= pauses
        for leaf in tree_leaves(result):
            if moves:
                self._host.pop(id(leaf), None)  # in the interpreter, `to` returns the same tensor
            elif isinstance(leaf, Tensor) and (on_host or (name in _FROM_HOST and "device" not in options)):
                self._host[id(leaf)] = leaf
        return result

    def operation(self, func: Any) -> None:
        """Count an operation if it launches a kernel: if it makes no view, and does more than to allocate."""
        name = func.overloadpacket.__name__
        views = any(found.alias_info and not found.alias_info.is_write for found in func._schema.returns)
        if not self._paused and not views and "empty" not in name and name != "_local_scalar_dense":
            self._note("operation", f"{_place()}: {name}")

    def _note(self, kind: str, place: str) -> None:
        self.counts[kind, place] += 1


class _Functions(TorchFunctionMode):
    def __init__(self, calls: DeviceCalls) -> None:
        super().__init__()
        self._calls = calls

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return self._calls.function(func, args, kwargs or {})


class _Operations(TorchDispatchMode):
    def __init__(self, calls: DeviceCalls) -> None:
        super().__init__()
        self._calls = calls

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        self._calls.operation(func)
        return func(*args, **(kwargs or {}))


def _place() -> str:
    """Return module and function of the package's innermost frame."""
    frame = sys._getframe(1)
    while frame is not None:
        code = frame.f_code
        if code.co_filename.startswith(_PACKAGE):
            return f"{Path(code.co_filename).stem}.{code.co_name}"
        frame = frame.f_back  # type: ignore[assignment]
    return "test"
