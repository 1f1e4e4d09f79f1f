"""What may close a difference, found one after another: a unit, a size, a crop, an offset, noise, a density.

Each looks at both sources as they are after the changes before it, and returns what to try, or None.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from pcdata.structures import DepthFrame, PointCloud
from pcdata.transforms import (
    CropCenter,
    CropWorkspace,
    MaskDepth,
    RandomTranslation,
    ResizeDepth,
    Transform,
)
from pcdata.validation.comparison.sides import Change, Side
from pcdata.validation.comparison.statistics import FEWEST
from pcdata.validation.comparison.tables import Table, bad, bad_families

Finder = Callable[[tuple[Side, Side], Table], Change | None]

# Ratios of lengths that are read in a wrong unit, and how near to one they must come (as a logarithm): scenes differ.
_UNITS = ((1000.0, 0.7), (100.0, 0.35), (10.0, 0.35), (25.4, 0.2), (39.37, 0.2), (5.0, 0.1), (4.0, 0.1))
_SURE = 10.0  # times: scenes of one kind may be 4 or 5 times farther away, and no unit is wrong
_SAME = 0.01  # of two numbers that are meant to be equal
_SHARP = 0.03  # of a distance: captures that all end there are cut off
_SAME_END = 0.01  # metres
_BEYOND = 1.05  # times where one source ends: the other goes on


def find_unit(sides: tuple[Side, Side], table: Table) -> Change | None:
    """Lengths of one source are a usual factor larger."""
    if not bad_families(table) & {"distances", "extent"}:
        return None
    sizes = [_size(side) for side in sides]
    if not all(size > 0 for size in sizes):
        return None
    ratio = math.log(sizes[1] / sizes[0])
    near = [(abs(abs(ratio) - math.log(one)), one) for one, most in _UNITS if abs(abs(ratio) - math.log(one)) < most]
    if not near:
        return None
    factor = min(near)[1]
    # The wrong one is what is farther from a metre.
    side = max((0, 1), key=lambda one: abs(math.log(sizes[one])))
    times = 1 / factor if (ratio > 0) == (side == 1) else factor
    poses = _lengths_of_poses(sides)
    move = bool(poses) and abs(abs(math.log(poses[1] / poses[0])) - math.log(factor)) < 0.35
    return Change(
        name="unit",
        side=side,
        families=frozenset({"distances", "extent"}),
        apply=lambda capture, _: _scaled(capture, times, poses=move),
        advice=(
            f"read {'AB'[side]} with its metres_per_unit (--metres-per-unit) times {times:g}: then its lengths agree "
            f"with those of {'BA'[side]}"
        ),
        needs_more=factor < _SURE,
        found=f"lengths in {'AB'[side]} are {factor:g} times too {'large' if times < 1 else 'small'} "
        f"({sizes[0]:.3g} m in A, {sizes[1]:.3g} m in B)",
    )


def _size(side: Side) -> float:
    """A length that grows with the unit: the median distance, or the diagonal of the cloud."""
    median = side.middle("median")
    if median > 0:
        return median
    return math.hypot(*(side.middle(f"upper_{axis}") - side.middle(f"lower_{axis}") for axis in "xyz"))


def _lengths_of_poses(sides: tuple[Side, Side]) -> list[float]:
    found = [math.hypot(*(side.middle(f"camera_{axis}") for axis in "xyz")) for side in sides]
    return found if all(one > 0 for one in found) else []


def _scaled(capture: Any, times: float, *, poses: bool) -> Any:
    if isinstance(capture, PointCloud):
        matrix = torch.diag(torch.tensor([times, times, times, 1.0], dtype=torch.float64, device="cpu"))
        return capture.transformed(matrix.repeat(capture.num_clouds, 1, 1).to(capture.device))
    moved = capture.world_from_camera
    if poses and moved is not None:
        moved = moved.clone()
        moved[:, :3, 3] *= times
    return replace(capture, depth=capture.depth * times, world_from_camera=moved)


def find_size(sides: tuple[Side, Side], table: Table) -> Change | None:
    """Images of another size: of the same view, or a window of it."""
    texts = [side.fact("size") for side in sides]
    if not all(texts) or texts[0] == texts[1]:
        return None
    sizes = [tuple(int(part) for part in reversed(text.split(" x "))) for text in texts]
    side = max((0, 1), key=lambda one: sizes[one][0] * sizes[one][1])
    (rows, columns), small = sizes[side], sizes[1 - side]
    focal = [math.sqrt(max(one.middle("density"), 0.0)) for one in sides]
    fits = small[0] <= rows and small[1] <= columns
    if fits and abs(focal[0] / max(focal[1], 1e-9) - 1) < _SAME:
        step: Transform = CropCenter(size=(small[0], small[1]))
    else:
        # The nearest reading: averages would be less noisy than what is compared.
        step = ResizeDepth(size=(small[0], small[1]), max_jump=None)
    return step_change("image size", side, {"lens", "density"}, step, f"{texts[0]} pixels in A, {texts[1]} in B")


def find_crop(sides: tuple[Side, Side], table: Table) -> Change | None:
    """One source ends sharply where the other goes on."""
    families = bad_families(table)
    if "extent" in families:
        return _box(sides, table)
    if not families & {"distances", "holes"} or sides[0].fact("kind") != "depth images":
        return None
    fields: dict[str, float] = {}
    chosen = None
    for field, name, largest in (("far", "farthest", True), ("near", "nearest", False)):
        for side in (0, 1):
            cut, other = sides[1 - side].extreme(name, largest), sides[side].middle(name)
            usual = sides[1 - side].middle(name)
            goes_on = other > cut * _BEYOND if largest else other < cut / _BEYOND
            keeps_most = (sides[side].middle("median") < cut) == largest
            if goes_on and keeps_most and abs(cut / usual - 1) < _SHARP and chosen in (None, side):
                # The numbers leave out a thousandth of the readings at either end.
                fields[field] = math.ceil(cut * 1e3) / 1e3 if largest else math.floor(cut * 1e3) / 1e3
                chosen = side
    if chosen is None:
        return None
    return step_change(
        "crop",
        chosen,
        {"distances", "holes"},
        MaskDepth(near=fields.get("near"), far=fields.get("far"), use_mask=False),
    )


def _box(sides: tuple[Side, Side], table: Table) -> Change | None:
    """The box of the source that ends earlier, for the other."""
    if sides[0].fact("frame") != sides[1].fact("frame"):
        return None
    worse = [key[0] for key in bad(table) if table[key].family == "extent"]
    inner = [0, 0]  # ends that lie within those of the other source
    for name in worse:
        gap = table[name, None].b - table[name, None].a
        inner[1 if (gap > 0) == name.startswith("lower") else 0] += 1
    side = 0 if inner[1] > inner[0] else 1  # which is to be cropped
    own = sides[1 - side]
    if not all(_is_sharp(own, name) for name in worse):
        return None
    lower, upper = [], []
    for axis in "xyz":
        low, high = own.extreme(f"min_{axis}", largest=False), own.extreme(f"max_{axis}", largest=True)
        if not (math.isfinite(low) and math.isfinite(high)):
            return None
        lower.append(round(low - 1e-4, 4))
        upper.append(round(high + 1e-4, 4))
    if any(low >= high for low, high in zip(lower, upper)):
        return None
    step = CropWorkspace(
        frame=own.fact("frame"), lower=(lower[0], lower[1], lower[2]), upper=(upper[0], upper[1], upper[2])
    )
    return step_change("crop", side, {"extent"}, step)


def _is_sharp(side: Side, name: str) -> bool:
    """Whether the clouds of all captures end at one place, as those that were cropped do."""
    kind, _, axis = name.partition("_")
    ends = side.series.values(f"{'min' if kind == 'lower' else 'max'}_{axis}", None)
    return len(ends) >= FEWEST and float(np.nanstd(ends)) < _SAME_END


def find_offset(sides: tuple[Side, Side], table: Table) -> Change | None:
    """The table, and all on it, lies elsewhere in the frame."""
    heights = [one for key, one in table.items() if key[0] == "table_height" and one.differs]
    if not heights:
        return None
    up = sum(one.b - one.a for one in heights) / len(heights)
    shift = [0.0, 0.0, up]
    for axis, name in enumerate("xy"):
        ends = [table[key] for key in bad(table) if key[0] in (f"lower_{name}", f"upper_{name}")]
        eyes = [table[key] for key in bad(table) if key[0] == f"camera_{name}"]
        for both in (ends if len(ends) == 2 else [], eyes):
            gaps = [one.b - one.a for one in both]
            if gaps and max(gaps) - min(gaps) < 0.01:
                shift[axis] = sum(gaps) / len(gaps)
    offset = (round(shift[0], 4), round(shift[1], 4), round(shift[2], 4))
    step = RandomTranslation(min_offset=offset, max_offset=offset)
    where = sides[0].fact("frame")
    words = " ".join(f"{1e3 * one:+.1f}" for one in offset)
    return Change(
        name="offset",
        side=0,
        families=frozenset({"table"}),
        apply=lambda capture, _: _shifted(capture, offset),
        step=step.to_config(),
        advice=f"the poses, or the frame {where!r}, of one lie off: correct its calibration; or move A's clouds in "
        f"{where!r} by {step!r}",
        found=f"all of B lies ({words}) mm off A in {where!r}",
    )


def _shifted(capture: Any, offset: Sequence[float]) -> Any:
    matrix = torch.eye(4, dtype=torch.float64, device="cpu")
    matrix[:3, 3] = torch.tensor(offset, dtype=torch.float64, device="cpu")
    if isinstance(capture, PointCloud):
        return capture.transformed(matrix.repeat(capture.num_clouds, 1, 1).to(capture.device))
    if capture.world_from_camera is None:
        return capture
    return replace(capture, world_from_camera=matrix.to(capture.device) @ capture.world_from_camera)


def step_change(name: str, side: int, families: set[str], step: Transform, found: str = "") -> Change:
    """Return the change that runs a step, which draws nothing, on every capture."""
    return Change(
        name=name,
        side=side,
        families=frozenset(families),
        apply=lambda capture, _: _run(step, capture),
        step=step.to_config(),
        advice=f"put {step!r} into the pipeline of {'AB'[side]}",
        found=found,
    )


def _run(step: Transform, capture: DepthFrame | PointCloud) -> Any:
    return step(capture)
