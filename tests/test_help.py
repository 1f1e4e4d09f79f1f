"""Every field of what users construct is explained where ``help()`` shows it."""

from __future__ import annotations

import dataclasses
import inspect
import re

import pytest

import pcdata
from pcdata.transforms.base import REGISTRY


def _constructed() -> dict[str, type]:
    """Transforms, and the public dataclasses."""
    public = {name: getattr(pcdata, name) for name in pcdata.__all__}
    found = {name: one for name, one in public.items() if inspect.isclass(one) and dataclasses.is_dataclass(one)}
    return {**found, **{name: one for name, one in REGISTRY.items() if one.__module__.startswith("pcdata.")}}


@pytest.mark.parametrize("name", sorted(_constructed()))
def test_the_docstring_explains_every_field(name):
    cls = _constructed()[name]
    words = set(re.findall(r"\w+", " ".join(inspect.getdoc(base) or "" for base in cls.__mro__ if base is not object)))
    fields = {field.name for field in dataclasses.fields(cls) if not field.name.startswith("_") and field.init}
    assert fields <= words, f"{name} does not say what {sorted(fields - words)} mean"
