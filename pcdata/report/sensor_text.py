"""What is known of depth sensors, as text."""

from __future__ import annotations

import textwrap

from pcdata.report.plain_table import text_table
from pcdata.sensors import SensorProfile, sensor_profile, sensor_profiles

_DERIVED = ("noise_at", "pitch_at", "outlier_radius", "edge_threshold", "voxel_size")


def profiles_text() -> str:
    """Return a table of every profile."""
    rows = [
        [
            name,
            profile.kind,
            f"{profile.size[1]}x{profile.size[0]}",
            f"{profile.range[0]:g} - {profile.range[1]:g}",
            f"{profile.reference_depth:.2f}",
            _millimetres(profile.noise_at(profile.reference_depth)),
            _millimetres(profile.pitch_at(profile.reference_depth)),
            " or ".join(f"{unit:g}" for unit in profile.metres_per_unit),
        ]
        for name, profile in sensor_profiles().items()
    ]
    header = ["sensor", "kind", "size", "range m", "at m", "noise mm", "pitch mm", "metres per unit"]
    return f"{text_table(header, rows)}\n\npcdata profiles NAME shows one with the source of every figure."


def profile_text(name: str) -> str:
    """Return everything about one profile: figures, sources, and what follows from them.

    Raises:
        ConfigError: there is no such profile.
    """
    profile = sensor_profile(name)
    figures = [[figure, _figure(profile, figure)] for figure in profile.sources]
    depths = [profile.range[0], profile.reference_depth, profile.range[1]]
    derived = [[method, *(_millimetres(getattr(profile, method)(depth)) for depth in depths)] for method in _DERIVED]
    sources = [_wrapped(f"{figure}: {source}") for figure, source in profile.sources.items()]
    return "\n\n".join(
        [
            f"{name}: {profile.title}, {profile.kind}",
            text_table(["figure", "value"], figures),
            text_table(["derived, mm", *(f"at {depth:.2f} m" for depth in depths)], derived),
            "\n".join(["sources", "-------", *sources]),
        ]
    )


def _wrapped(line: str) -> str:
    return textwrap.fill(line, 110, subsequent_indent="    ", break_long_words=False, break_on_hyphens=False)


def _figure(profile: SensorProfile, figure: str) -> str:
    if figure == "noise":
        return f"sigma = {profile.noise.formula}"
    value = getattr(profile, figure)
    return ", ".join(f"{one:g}" for one in value) if isinstance(value, tuple) else f"{value:g}"


def _millimetres(metres: float) -> str:
    return f"{metres * 1000:.3g}"
