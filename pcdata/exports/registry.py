"""What data sets can be exported as: targets by their names."""

from __future__ import annotations

from pcdata.errors import ConfigError
from pcdata.exports.target import Target
from pcdata.models import contract as contract_named
from pcdata.registry import Registry

TARGETS: Registry[type[Target]] = Registry("target")


def register_target(target: type[Target]) -> type[Target]:
    """Make an export known by its ``name``, to :func:`export_dataset` and ``pcdata export``; a decorator.

    Raises:
        ConfigError: it is no complete dataclass of :class:`Target`, or the name exists.
    """
    where = "register_target"
    if not (isinstance(target, type) and issubclass(target, Target)):
        raise ConfigError(f"{where}: must be a subclass of pcdata.exports.Target, got {target!r:.100}")
    if missing := ", ".join(sorted(target.__abstractmethods__)):
        raise ConfigError(f"{where}: {target.__name__} does not say {missing}; define that")
    for name in ("name", "takes", "layout", "model"):
        if not isinstance(getattr(target, name, None), str):
            raise ConfigError(f"{where}: {target.__name__}.{name} must be a text; see pcdata.exports.Target")
    if target.takes not in ("clouds", "captures"):
        raise ConfigError(f"{where}: {target.__name__}.takes must be 'clouds' or 'captures', got {target.takes!r}")
    for model in target.models():
        contract_named(model)
    TARGETS.add(target.name, target)
    return target


def targets_of(model: str) -> list[str]:
    """Return the targets that the data of a model's preset can be exported to; none where no loader is known.

    Raises:
        ConfigError: no such model.
    """
    contract_named(model)
    return [name for name, target in TARGETS.items() if model in target.models()]
