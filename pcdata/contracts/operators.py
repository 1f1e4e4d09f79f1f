"""Operations that a compiler keeps whole: what they give has shapes that follow from what they are given.

Such an operation is an operator of torch too (``torch.ops.pcdata``), with a function that tells the shapes without
computing: a network that calls it is compiled in one piece. Where a call has arguments that an operator cannot take, or
wants a gradient, the compiled program is cut as for any other operation.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor


def _own_library() -> torch.library.Library | None:
    try:
        return torch.library.Library("pcdata", "DEF")
    except RuntimeError:
        return None


# None in a second copy of pcdata in one process: the operators are the first one's, and of this one programs are cut.
_LIBRARY = _own_library()
# Of arguments in schemas: what they may be in a call.
_TYPES: dict[str, tuple[type, ...]] = {
    "Tensor": (Tensor,),
    "Tensor?": (Tensor, type(None)),
    "int": (int,),
    "bool": (bool,),
    "float": (float, int),
    "float?": (float, int, type(None)),
    "str": (str,),
}


class Traced:
    """What makes an operation an operator.

    Args:
        arguments: those that an operator takes, as in ``"Tensor points, Tensor? ptr, int k"``, in the order of the
            operation's; a call in which any other is not None is no call of the operator.
        results: as in ``"Tensor index, Tensor distance"``.
        shapes: gives empty tensors like the results, given all arguments by name.
    """

    def __init__(self, arguments: str, results: str, shapes: Callable[..., Any]) -> None:
        self.arguments, self.results, self.shapes = arguments, results, shapes

    def register(self, name: str, call: Callable[..., Any], *, gradient: bool) -> Callable[..., Any]:
        """Make the operator; return what a traced program calls: its results, or None where it cannot take the call."""
        if _LIBRARY is None:
            return lambda *_: None
        pairs = [one.split(" ") for one in self.arguments.split(", ")]
        types = {own: _TYPES[kind] for kind, own in pairs}
        order = tuple(types)
        _LIBRARY.define(
            f"{name}({self.arguments}, str backend) -> ({self.results})", tags=(torch.Tag.pt2_compliant_tag,)
        )

        def run(*values: Any) -> Any:
            *given, backend = values
            return call(**dict(zip(order, given)), backend=backend)

        def fake(*values: Any) -> Any:
            return self.shapes(**dict(zip(order, values)))

        _LIBRARY.impl(name, run, "CompositeExplicitAutograd")
        torch.library.register_fake(f"pcdata::{name}", fake, lib=_LIBRARY)
        operator = getattr(torch.ops.pcdata, name).default

        def traced(defaults: dict[str, Any], args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
            values = {**defaults, **dict(zip(defaults, args)), **kwargs}
            backend = values.pop("backend")
            for key, value in values.items():
                if key not in types:
                    if value is not None:
                        return None
                elif not isinstance(value, types[key]):
                    return None
            tensors = [value for value in values.values() if isinstance(value, Tensor)]
            if gradient and torch.is_grad_enabled() and any(value.requires_grad for value in tensors):
                return None
            given = [values[key] for key in order]
            return operator(*[value.detach() if isinstance(value, Tensor) else value for value in given], backend)

        return traced
