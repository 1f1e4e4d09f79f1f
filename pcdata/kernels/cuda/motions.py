"""Augmentation: points of ragged batches moved and jittered in one pass, directions turned, a box cut out.

What is drawn for a batch (motions, which rows are dropped) is drawn on the host, and sent in one copy.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

import pcdata.functional.motions
import pcdata.functional.noise
import pcdata.functional.rows
import pcdata.geometry.rigid  # noqa: F401 - the functions must be registered before their kernels
from pcdata.contracts.dispatch import INNER, kernel
from pcdata.contracts.known import FINITE, is_known, note
from pcdata.contracts.on_host import bounds_of, on_host, read_together, uploaded
from pcdata.functional.noise import PointStep
from pcdata.kernels.cuda.launching import launcher_of


@kernel("move_points", "cuda")
def move_points(
    points: Tensor,
    ptr: Tensor,
    steps: Sequence[PointStep],
    kept: tuple[Tensor, Tensor] | None = None,
    *,
    in_place: bool = False,
    sources: Tensor | None = None,
) -> Tensor:
    """Take every point through all steps at once."""
    if sources is not None or not steps or not _covers(points, ptr) or (in_place and not points.is_contiguous()):
        found: Tensor = INNER["move_points"].reference(points, ptr, steps, kept, in_place=in_place, sources=sources)
        return found
    count, ends, mask = len(points), None, None
    if kept is not None:
        count, mask = bounds_of(kept[1])[-1], kept[0].contiguous()
        ends = mask.cumsum(0)
    # What one thread writes in place another may have yet to read, if rows change their places.
    is_same = in_place and kept is None
    moved = points if is_same else torch.empty((count, 3), dtype=torch.float32, device=points.device)
    given = points.contiguous(), ptr.contiguous(), len(ptr) - 1, len(points), len(steps)
    launcher = launcher_of(points)
    launcher.launch(
        "pc_take_through", len(points), *given, *_table(steps, len(ptr) - 1, points.device), mask, ends, moved
    )
    return points[:count].copy_(moved) if in_place and not is_same else moved


def _table(steps: Sequence[PointStep], clouds: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """Return rules (S, 3) and numbers (S, B, 16) float64, as pc_take_through has them, sent in one copy."""
    count = len(steps)
    table = torch.zeros(count * (3 + 16 * clouds), dtype=torch.float64, device="cpu")
    rules, numbers = table[: 3 * count].view(count, 3), table[3 * count :].view(count, clouds, 16)
    there: list[tuple[int, Tensor]] = []
    for rule, own, (number, step) in zip(rules, numbers, enumerate(steps)):
        if not isinstance(step, Tensor):
            seeds, sigma, clip = step
            rule[:] = torch.tensor([1.0, sigma, torch.inf if clip is None else clip], dtype=torch.float64, device="cpu")
            own[:, 0] = on_host(seeds).view(torch.float64)
        elif step.device.type == "cpu":
            own[:] = step.detach().reshape(clouds, 16)
        else:
            there.append((number, step))
    sent = uploaded(table, device)
    numbers = sent[3 * count :].view(count, clouds, 16)
    for number, step in there:
        numbers[number] = step.detach().reshape(clouds, 16)
    return sent[: 3 * count], numbers


@kernel("transform_points", "cuda")
def transform_points(points: Tensor, ptr: Tensor, matrix: Tensor) -> Tensor:
    """Move every point once; other dtypes are the reference's."""
    if not _covers(points, ptr) or matrix.shape != (len(ptr) - 1, 4, 4):
        found: Tensor = INNER["transform_points"].reference(points, ptr, matrix)
        return found
    return move_points(points, ptr, [matrix])


@kernel("transform_directions", "cuda")
def transform_directions(directions: Tensor, ptr: Tensor, matrix: Tensor) -> Tensor:
    """Invert the motions on the host, which mostly knows them, then turn every direction once."""
    if not _covers(directions, ptr) or matrix.shape != (len(ptr) - 1, 4, 4):
        found: Tensor = INNER["transform_directions"].reference(directions, ptr, matrix)
        return found
    linear = torch.linalg.inv(on_host(matrix)[:, :3, :3].double()).mT.contiguous()
    turned = torch.empty(directions.shape, dtype=torch.float32, device=directions.device)
    given = directions.contiguous(), ptr.contiguous(), len(ptr) - 1, len(directions)
    sent = uploaded(linear, directions.device)
    launcher_of(directions).launch("pc_turn_directions", len(directions), *given, sent, turned)
    return turned


@kernel("inside_box", "cuda")
def inside_box(points: Tensor, lower: Sequence[float], upper: Sequence[float]) -> Tensor | None:
    """Look at every point once; the host waits only where it does not know that all are finite."""
    if points.dtype is not torch.float32 or points.shape[1:] != (3,):
        found: Tensor | None = INNER["inside_box"].reference(points, lower, upper)
        return found
    inside = torch.empty(len(points), dtype=torch.bool, device=points.device)
    infinite = torch.zeros(1, dtype=torch.int32, device=points.device)
    given = points.detach().contiguous(), len(points), *map(float, lower), *map(float, upper)
    launcher_of(points).launch("pc_mark_inside", len(points), *given, inside, infinite)
    if not is_known(FINITE, points):
        if read_together([infinite])[0][0]:
            return None
        note(FINITE, points)
    return inside


@kernel("led_back", "cuda")
def led_back(source_from_cloud: Tensor, matrices: Tensor) -> Tensor:
    """Go back on the host, which mostly knows the few numbers of each cloud: it need not wait for them."""
    back = INNER["led_back"].public(on_host(source_from_cloud), on_host(matrices))
    return uploaded(back, source_from_cloud.device)


@kernel("are_plain_motions", "cuda")
def are_plain_motions(matrices: Tensor) -> bool:
    """Look at them on the host."""
    plain: bool = INNER["are_plain_motions"].public(on_host(matrices))
    return plain


def _covers(points: Tensor, ptr: Tensor) -> bool:
    """Whether these are float32 points that the row pointers cut completely."""
    fits = points.dtype is torch.float32 and points.shape[1:] == (3,) and ptr.dtype is torch.int64 and len(ptr) > 1
    return fits and bounds_of(ptr)[0] == 0 and bounds_of(ptr)[-1] == len(points)
