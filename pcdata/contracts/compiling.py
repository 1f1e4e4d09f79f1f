"""Calls from a program that ``torch.compile`` traces: the program is cut there, once, and goes on behind the call.

Operations and steps read values, choose kernels and check what they are given: nothing that a compiler can make faster,
and tracing them would leave dozens of small graphs.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch

# True only while a program is traced; a plain flag otherwise.
is_traced = torch.compiler.is_compiling


def called_apart(function: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
    """Call a function that the compiler leaves as it is, with all that it calls.

    Not by decorating it where it is defined: that would load the compiler into every process.
    """
    apart = _apart.get(function)
    if apart is None:
        apart = _apart[function] = torch.compiler.disable(function)
    return apart(*args, **kwargs)


_apart: dict[Callable[..., Any], Callable[..., Any]] = {}
