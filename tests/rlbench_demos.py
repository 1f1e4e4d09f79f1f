"""Demonstrations as RLBench pickles them, without RLBench: the names of its classes in place of those here."""

from __future__ import annotations

import pickle
from typing import Any


class Observation:
    def __init__(self, **attributes: Any) -> None:
        self.__dict__.update(attributes)


class Demo:
    def __init__(self, observations: list[Observation]) -> None:
        self._observations = observations
        self.random_seed = None


def pickled_demo(observations: list[Observation], protocol: int = 2) -> bytes:
    """Protocol 2 has names as lines, which may be replaced by those of another length."""
    program = pickle.dumps(Demo(observations), protocol)
    here = __name__.encode()
    names = ((b"Demo", b"rlbench.demo"), (b"Observation", b"rlbench.backend.observation"))
    for name, module in names:
        program = program.replace(b"c" + here + b"\n" + name + b"\n", b"c" + module + b"\n" + name + b"\n")
    return program
