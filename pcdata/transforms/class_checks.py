"""Does the class of a transform do what it says: checked when it is written, and when it is first used.

A step that draws from anything but its streams gives other data with another number of workers, and a step that draws
without saying ``is_random`` would be stored in a dataset as if it always gave the same. Both are told, with the lines
to write. What cannot be seen is a generator that the step makes itself without a seed.
"""

from __future__ import annotations

import dataclasses
import functools
import inspect
import pickle
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from random import getstate
from types import CodeType
from typing import Any, NoReturn

import torch
from numpy.random import get_state
from torch import Generator, nn
from torch.overrides import TorchFunctionMode

from pcdata.errors import ConfigError
from pcdata.rng import Streams

_MODULE_NAMES = frozenset(dir(nn.Module()))
_HOOKS = {"make_params": "data, streams", "transform": "data, params", "pick": "cloud, streams"}

# What draws whenever it is called; what draws in training alone (dropout) shows in the state of the generator.
_DRAWING = {
    "rand", "rand_like", "randn", "randn_like", "randint", "randint_like", "randperm", "normal", "normal_", "bernoulli",
    "bernoulli_", "binomial", "multinomial", "poisson", "uniform_", "random_", "exponential_", "cauchy_", "geometric_",
    "log_normal_", "_standard_gamma", "_sample_dirichlet",
}  # fmt: skip

# One for each family, complete: whoever writes them has a step that runs.
_DECIDE = (
    '        return {"drawn": streams.uniform(0.0, 1.0)}  # (B,), one number per cloud; transform reads params["drawn"]'
)
_MOVE = (
    '        return {"matrix": torch.eye(4, dtype=torch.float64) + torch.nn.functional.pad('
    "streams.uniform(-0.01, 0.01, 3, 1), (3, 0, 0, 1))}  # (B, 4, 4): every cloud by up to 1 cm along each axis"
)
_PICK = (
    "        return cloud.ptr[:-1] + (streams.uniform(0.0, 1.0) * cloud.counts).long(), "
    "torch.arange(cloud.num_clouds + 1)  # the index, one random row of each cloud, and its ptr"
)


def check_class(cls: type[nn.Module]) -> None:
    """Check what a class that is being written defines itself; ``cls`` is a dataclass already.

    Raises:
        ConfigError: a method that cannot be called as a chain calls it, or a field that hides what every step has.
    """
    own = vars(cls)
    name = cls.__name__
    if "apply" in own:
        raise ConfigError(
            f"{name}.apply: that name is nn.Module's, which calls it on every module of a policy; "
            "the method of a step is\n    def transform(self, data, params):"
        )
    for hook, arguments in _HOOKS.items():
        if hook in own and callable(own[hook]) and not _takes(own[hook], None, None, None):
            raise ConfigError(f"{name}.{hook}: is called with two arguments; write\n    def {hook}(self, {arguments}):")
    if "pick" in own and (decides := _decides_without_picking(cls)) is not None:
        raise ConfigError(
            f"{name}.pick: is never called, as {decides}.make_params decides which rows stay; write that instead\n"
            "    def make_params(self, data, streams):"
        )
    if "forward" in own and not _takes(own["forward"], None, None, generator=None):
        raise ConfigError(
            f"{name}.forward: chains and datasets call it with generator=...; most steps need no forward, as "
            "that of Transform runs make_params, then transform, and writes the history. To do something around it:\n"
            "    def forward(self, data, *, generator=None):\n"
            "        result = super().forward(data, generator=generator)\n"
            "        return result"
        )
    bases = cls.__mro__[1:]
    inherited = {attribute for base in bases for attribute in vars(base)} | _MODULE_NAMES
    known = {field.name for base in bases if dataclasses.is_dataclass(base) for field in dataclasses.fields(base)}
    stated = {
        key for base in bases for key, hint in vars(base).get("__annotations__", {}).items() if "ClassVar" in str(hint)
    }
    for field in (field.name for field in dataclasses.fields(cls)):  # type: ignore[arg-type]
        if field in inherited and field not in known:
            hint = f"; as a statement about the class it has no type: {field} = ..." if field in stated else ""
            raise ConfigError(f"{name}.{field}: every step has something of this name; call the field otherwise{hint}")


def _decides_without_picking(cls: type[nn.Module]) -> str | None:
    """Return the class of pcdata whose ``make_params`` decides for a new step, if nothing there looks up ``pick``."""
    decides = next(base for base in cls.__mro__ if "make_params" in vars(base))
    if not decides.__module__.startswith("pcdata.") or not any("pick" in vars(base) for base in cls.__mro__[1:]):
        return None
    written = [made for name, made in vars(cls).items() if name != "pick"]
    looked_up = _looked_up(vars(decides)["make_params"]).union(*map(_looked_up, written))
    return None if looked_up & {"pick", "make_params"} else decides.__name__


def _looked_up(function: Any) -> set[str]:
    code = getattr(inspect.unwrap(function), "__code__", None) if callable(function) else None
    found: set[str] = set()
    waiting = [] if code is None else [code]
    while waiting:
        code = waiting.pop()
        found.update(code.co_names)
        waiting += [one for one in code.co_consts if isinstance(one, CodeType)]
    return found


def _takes(function: Callable[..., Any], *args: Any, **kwargs: Any) -> bool:
    try:
        inspect.signature(function).bind(*args, **kwargs)
    except TypeError:
        return False
    return True


class _UndeclaredStreams(Streams):
    """What a step that does not say ``is_random`` gets for its streams: any use of them tells its author so."""

    def __init__(self, cls: type[nn.Module]) -> None:
        self._cls = cls

    def _next(self, count: int) -> NoReturn:
        """Every method of :class:`Streams` draws by this one."""
        _refuse(self._cls, "draws from its streams but does not say that it is random")


def undeclared_streams(cls: type[nn.Module]) -> Streams:
    """Return what a step that does not say ``is_random`` gets for its streams."""
    return _UndeclaredStreams(cls)


def watched(forward: Callable[..., Any]) -> Callable[..., Any]:
    """Wrap the ``forward`` of a class so that the first use of every instance is watched for draws from elsewhere."""

    @functools.wraps(forward)
    def watching(self: nn.Module, *args: Any, **kwargs: Any) -> Any:
        if "_was_watched" in vars(self):
            return forward(self, *args, **kwargs)
        vars(self)["_was_watched"] = True
        with _only_declared_draws(self, kwargs.get("generator")):
            return forward(self, *args, **kwargs)

    return watching


@contextmanager
def _only_declared_draws(step: nn.Module, generator: Any) -> Iterator[None]:
    given = [] if isinstance(generator, Streams) else [generator] if isinstance(generator, Generator) else generator
    given = list(given or ())
    offered = [] if step.is_random else [one.get_state() for one in given if isinstance(one, Generator)]
    # Another thread may draw from these meanwhile, which nobody can tell from the step's own draws.
    # Not by TorchDispatchMode, which would see every draw: the first one in a process loads torch's compiler.
    alone = threading.active_count() == 1
    before = _states() if alone else {}
    with _TorchDraws() as torch_draws:
        yield
    if any(not torch.equal(state, one.get_state()) for state, one in zip(offered, given)):
        _refuse(type(step), "draws from the generator but does not say that it is random")
    after = _states() if alone else {}
    drawn = [*torch_draws.names, *(name for name in before if before[name] != after[name])]
    if drawn:
        _refuse(
            type(step),
            f"draws from {drawn[0]}, which is another in every worker of a DataLoader and unknown to seed and epoch",
        )


class _TorchDraws(TorchFunctionMode):
    """Note what this thread calls that draws from torch's global generator."""

    def __init__(self) -> None:
        super().__init__()
        self.names: list[str] = []

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """Note and run."""
        kwargs = kwargs or {}
        name = getattr(func, "__name__", "")
        if name in _DRAWING and kwargs.get("generator") is None:
            self.names.append(f"torch's global generator ({name})")
        return func(*args, **kwargs)


def _states() -> dict[str, Any]:
    return {
        "torch's global generator": torch.random.get_rng_state().numpy().tobytes(),
        "numpy's global generator (np.random)": pickle.dumps(get_state(legacy=False)),  # noqa: NPY002 - read, not drawn from
        "Python's global generator (random)": getstate(),
    }


def _refuse(cls: type[nn.Module], what: str) -> NoReturn:
    families = {base.__name__ for base in cls.__mro__}
    hook, line = "make_params(self, data, streams)", _DECIDE
    if "SelectTransform" in families:
        hook, line = "pick(self, cloud, streams)", _PICK
    elif "SpatialTransform" in families:
        line = _MOVE
    raise ConfigError(
        f"{cls.__name__} {what}. Write into the class, with the draws that you need in the last line:\n"
        f"    is_random = True\n    def {hook}:\n{line}\n"
        "For a draw per point take streams.seeds(), one per cloud, and pcdata.rng.seeded(seed) where the points are."
    )
