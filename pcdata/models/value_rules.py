"""Rules that read the values: ranges, scale, normalization, crop, duplicates, the table."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor

from pcdata.contracts.lengths import WIDEST, plausible_units
from pcdata.functional.planes import ransac_plane
from pcdata.models.batch import ModelBatch
from pcdata.models.catalog import is_camera
from pcdata.models.contract import MIN_POINTS, Channel, InputTensor, ModelContract, Role
from pcdata.models.declared_rules import denser, layout_fault, ruled
from pcdata.structures import METRE
from pcdata.verdicts import Finding, Verdict, graded

# The longest side of a cloud in metres. Below: a cloud in kilometres or a lone point; above: millimetres, where a cup
# is 80 and a table 800.
EXTENT = (0.005, WIDEST)

_STRAY = 0.01  # share of values that sensor noise may put outside a crop or behind the camera
_TOLERANCE = 1e-3  # of a normalized coordinate
_PLANE_SAMPLE = 2000  # points that the search for a table looks at
OBJECT_STEPS = {"RemovePlane", "ClusterObjects", "SplitObjects"}

# Of colors by their extremes: the encodings that they can have, narrowest first.
_ENCODINGS = {"rgb": (0.0, 1.0), "rgb_signed": (-1.0, 1.0), "rgb_imagenet": (-2.118, 2.6401), "rgb_255": (0.0, 255.0)}


def value_checks(batch: ModelBatch, contract: ModelContract) -> Iterator[Finding]:
    """Yield one check per rule; tensors of a wrong layout or kind of number, which other rules say, are left out."""
    sound = [
        spec
        for spec in contract.tensors
        if spec.key in batch.tensors
        and not layout_fault(batch[spec.key], spec, contract)
        and batch[spec.key].is_floating_point() == spec.dtype.startswith("float")
    ]
    yield _finite(batch)
    if any(not bool(torch.isfinite(tensor).all()) for tensor in batch.values() if tensor.is_floating_point()):
        return  # means and extremes of NaN would only repeat it
    yield _ranges(batch, sound)
    if contract.main not in sound:
        return
    if contract.takes == "depth image":
        yield from _image_depth(batch[contract.main.key], contract)
        return
    clouds = [cloud for cloud in positions(batch, contract) if len(cloud)]
    if not clouds:
        yield ruled("scale", "there are no points", "check crop and frame", found="")
        return
    yield _scale(clouds, contract)
    yield _normalization(clouds, contract)
    if is_camera(contract) and not contract.half_turn and contract.centering == "none":
        yield _in_front(clouds)
    if contract.crop is not None and contract.centering == "none":
        yield _crop(clouds, contract)
    yield _duplicates(clouds, contract)
    yield _table(batch, clouds, contract)


def channel_values(tensor: Tensor, spec: InputTensor, channel: Channel) -> Tensor:
    """(n, width): the values of one channel, all other axes flattened."""
    start = 0
    for other in spec.channels:
        if other.name == channel.name:
            break
        start += other.width
    rows = tensor.movedim(spec.axes.index("C"), -1).reshape(-1, spec.width)
    return rows[:, start : start + channel.width]


def positions(batch: ModelBatch, contract: ModelContract) -> list[Tensor]:
    """The (n, 3) coordinates of every cloud, without rows and cells that only fill the tensor."""
    spec, tensor = contract.main, batch[contract.main.key]
    if spec.axes[0] == "S":
        counts = batch.counts if batch.counts is not None and sum(batch.counts) == len(tensor) else (len(tensor),)
        return [part[:, :3].float() for part in tensor.split(counts)]
    clouds = []
    for one in tensor.movedim(spec.axes.index("C"), -1).flatten(1, -2):
        if spec.content == "voxel_grid":
            one = one[one[:, -1] > 0]
        elif spec.content == "organized" or contract.pad == "zeros":
            one = one[(one[:, :3] != 0).any(dim=1)]
        clouds.append(one[:, :3].float())
    return clouds


def _finite(batch: ModelBatch) -> Finding:
    faults = [
        f"{key} has {count} values that are NaN or infinite"
        for key, tensor in batch.items()
        if tensor.is_floating_point() and (count := int((~torch.isfinite(tensor)).sum()))
    ]
    advice = "find the step that makes them (step_through); one NaN spoils the weights for good"
    return ruled("finite", "; ".join(faults), advice, found="all values are finite")


def _ranges(batch: ModelBatch, specs: list[InputTensor]) -> Finding:
    faults = [
        fault
        for spec in specs
        for channel in spec.channels
        if channel.low is not None
        if (fault := _range_fault(channel_values(batch[spec.key], spec, channel), channel))
    ]
    return ruled("range", "; ".join(faults), "convert the channel, or use the preset's collate", found="as expected")


def _range_fault(values: Tensor, channel: Channel) -> str:
    if not len(values):
        return ""
    values = values.float()
    assert channel.low is not None
    assert channel.high is not None
    lowest, highest = float(values.min()), float(values.max())
    slack = _TOLERANCE * max(1.0, channel.high - channel.low)
    said = f"{channel.name} is in [{lowest:.3g}, {highest:.3g}]"
    if lowest < channel.low - slack or highest > channel.high + slack:
        return f"{said}, the model takes [{channel.low:g}, {channel.high:g}]"
    if channel.role is Role.COLOR and lowest < highest:
        return _encoding_fault(values, channel, said)
    if channel.role is Role.DIRECTION:
        length = values.norm(dim=1)
        share = float(((length - 1).abs() > 0.01)[length > 0].float().mean()) if bool((length > 0).any()) else 1.0
        return f"{share:.0%} of {channel.name} are not of unit length" if share > _STRAY else ""
    return ""


def _encoding_fault(values: Tensor, channel: Channel, said: str) -> str:
    """Find colors that fit another, narrower encoding: nobody's picture is that dark."""
    if channel.name == "rgb_minus_mean":
        return f"{channel.name} has the mean {float(values.mean()):.2g}, not 0" if abs(values.mean()) > 0.05 else ""
    used = values[(values != 0).any(dim=1)]  # rows that only fill the tensor say nothing
    lowest, highest = (float(used.min()), float(used.max())) if len(used) else (0.0, 0.0)
    fitting = [name for name, (low, high) in _ENCODINGS.items() if low - 1e-3 <= lowest and highest <= high + 1e-3]
    if channel.name in _ENCODINGS and fitting and fitting[0] == "rgb" and channel.name != "rgb" and highest > lowest:
        return f"{said}: these look like colors in [0, 1], the model takes {channel.name}"
    return ""


def _scale(clouds: list[Tensor], contract: ModelContract) -> Finding:
    extents = [float((cloud.amax(0) - cloud.amin(0)).max()) for cloud in clouds]
    low, high = min(extents), max(extents)
    found = f"the clouds are {low:.3g} to {high:.3g} long"
    if contract.unit_of_tensors() != METRE:
        fault = found if high > 2 + _TOLERANCE or low < 0.1 else ""
        return ruled("scale", fault, "normalize as the preset does: the longest side is at most 2", found=found)
    fault = found if low < EXTENT[0] or high > EXTENT[1] else ""
    fitting = [f"by {unit:g} if they are {name}" for name, unit in plausible_units(high).items() if unit < 1]
    hint = f"multiply the coordinates {' or '.join(fitting) or 'by their unit'}, where they are read or before"
    hint = hint if high > EXTENT[1] else "a crop that leaves nothing, or a unit that was applied twice?"
    return ruled("scale", fault, f"the model works in metres: {hint}", found=f"{found}, in metres")


def _normalization(clouds: list[Tensor], contract: ModelContract) -> Finding:
    faults = [fault for cloud in clouds if (fault := _normalization_fault(cloud, contract))]
    rule = {"none": "not centered", "mean": "mean at the origin", "corner": "corner at the origin", "floor": "on z = 0"}
    wanted = rule[contract.centering] + (", farthest point at 1" if contract.scaling != "none" else "")
    if contract.centering != "none":
        wanted += f", {contract.normalize}"
    advice = f"the model takes clouds that are: {wanted}; follow the preset's order of steps"
    return ruled("normalization", faults[0] if faults else "", advice, found=wanted)


def _normalization_fault(cloud: Tensor, contract: ModelContract) -> str:
    mean, lower, upper = cloud.double().mean(0), cloud.amin(0), cloud.amax(0)
    extent = max(float((upper - lower).max()), 1e-12)
    offset = float(mean.norm())
    exact = contract.normalize == "after sampling"
    if contract.scaling != "none":
        radius = float(cloud.norm(dim=1).max())
        good = abs(radius - 1) <= _TOLERANCE if exact else 0.5 <= radius <= 1 + _TOLERANCE
        if not good or offset > (_TOLERANCE if exact else 0.25):
            return f"mean at {offset:.3g} from the origin, farthest point at {radius:.3g}"
        return ""
    if contract.centering == "mean":
        limit = _TOLERANCE * extent if exact else 0.1 * extent
        return f"the mean is {offset:.3g} from the origin" if offset > limit else ""
    if contract.centering in ("corner", "floor"):
        # A sampled cloud may miss its lowest points, so only what lies below is sure to be wrong.
        if float(lower[2]) < -_TOLERANCE:
            return f"the lowest point is at z = {float(lower[2]):.3g}, not on the floor"
        middle = (lower + upper)[:2].abs().max() / 2
        if contract.centering == "floor" and float(middle) > 0.1 * extent + _TOLERANCE:
            return f"the middle of the box is {float(middle):.3g} from the origin in x or y"
        half = None if contract.column is None else contract.column / 2
        if half is not None and float(cloud[:, :2].abs().max()) > half + _TOLERANCE:
            return (
                f"x and y reach {float(cloud[:, :2].abs().max()):.3g} from the column's center, at most {half:g} fits"
            )
        return ""
    return "the mean is at the origin: it was subtracted" if offset < 1e-5 * extent else ""


def _in_front(clouds: list[Tensor]) -> Finding:
    behind = float((torch.cat(clouds)[:, 2] <= 0).float().mean())
    fault = f"{behind:.1%} of the points have z <= 0, behind the camera" if behind > _STRAY else ""
    advice = "the model takes camera coordinates, z forward: leave ToFrame out, or undo the change of axes"
    return ruled("axes", fault, advice, found="all points lie before the camera")


def _crop(clouds: list[Tensor], contract: ModelContract) -> Finding:
    assert contract.crop is not None
    points = torch.cat(clouds)
    lower, upper = points.new_tensor(contract.crop)
    outside = float(((points < lower - _TOLERANCE) | (points > upper + _TOLERANCE)).any(dim=1).float().mean())
    fault = f"{outside:.1%} of the points lie outside the crop {contract.crop}" if outside > _STRAY else ""
    advice = f"add CropWorkspace(frame={contract.frame!r}, lower={contract.crop[0]}, upper={contract.crop[1]})"
    return ruled("crop", fault, advice, found="all points lie inside")


def _distinct_rows(cloud: Tensor) -> int:
    """Return how many rows differ; torch.unique(dim=0) takes minutes where many are equal."""
    group = torch.zeros(len(cloud), dtype=torch.int64, device=cloud.device)
    for column in cloud.unbind(1):
        _, number = torch.unique(column, return_inverse=True)
        _, group = torch.unique(group * len(cloud) + number, return_inverse=True)
    return int(group.max()) + 1 if len(cloud) else 0


def _duplicates(clouds: list[Tensor], contract: ModelContract) -> Finding:
    distinct = [_distinct_rows(cloud) for cloud in clouds]
    share = max(1.0 - count / len(cloud) for count, cloud in zip(distinct, clouds))
    found = f"{share:.0%} of the points are repeated"
    fault = found if share > contract.max_duplicates else ""
    if min(distinct) < MIN_POINTS:  # filled up with zeros, none is repeated
        fault = f"a cloud has {min(distinct)} different points, and fewer than {MIN_POINTS} describe no surface"
    return ruled(
        "duplicates",
        fault,
        f"at most {contract.max_duplicates:.0%} repeated is usual: the clouds are too thin; {denser(contract)}",
        found=found,
    )


def _table(batch: ModelBatch, clouds: list[Tensor], contract: ModelContract) -> Finding:
    removed = None if batch.steps is None else bool(OBJECT_STEPS & set(batch.steps))
    if contract.table == "kept":
        if removed:
            return ruled("table", "the table was removed", "leave RemovePlane out: the model expects it", found="")
        fault = ""
        if removed is None and (share := _plane_share(clouds[0])) < 0.1:
            fault = f"the largest plane holds {share:.0%} of the points: was the table removed?"
        return ruled("table", fault, "the model is trained with the table in view", found="kept", if_fault=Verdict.WARN)
    if contract.table == "removed":
        fault = ""
        if removed is False:
            fault = "no step removed the table or cut objects out"
        elif removed is None and (share := _plane_share(clouds[0])) > 0.5:
            fault = f"one plane holds {share:.0%} of the points: is the table still there?"
        return ruled(
            "table", fault, "the model takes one object: cut it out first", found="removed", if_fault=Verdict.WARN
        )
    return ruled("table", "", "", found="left to you")


def _plane_share(cloud: Tensor) -> float:
    """The share of points within 2 % of the cloud's extent of its largest plane."""
    sample = cloud[:: max(1, len(cloud) // _PLANE_SAMPLE)].contiguous()
    if len(sample) < 3:
        return 0.0
    extent = float((sample.amax(0) - sample.amin(0)).max())
    _, inliers = ransac_plane(sample, None, distance=max(0.02 * extent, 1e-6), num_hypotheses=200)
    return float(inliers.float().mean())


def _image_depth(images: Tensor, contract: ModelContract) -> Iterator[Finding]:
    """Judge scale and normalization of depth that is less the image's mean, or in plain metres."""
    channel = contract.main.channels[0]
    depth = channel_values(images, contract.main, channel)
    if channel.name == "depth_relative":
        clipped = float((depth.abs() >= 1).float().mean())
        found = f"{clipped:.0%} of the image is clipped, 1 m from the mean depth"
        advice = "in millimetres? the clip takes metres; a far background? mask it before the holes are filled"
        yield graded("scale", clipped, (0.2, 0.6), found=found, advice=advice)
        offset = float(depth.reshape(len(images), -1).mean(dim=1).abs().max())
        found = f"the mean of an image is at most {offset:.3g} from 0"
        advice = "subtract the image's mean, then clip to [-1, 1]; a far background shifts the mean"
        yield graded("normalization", offset, (0.1, 0.5), found=found, advice=advice)
        return
    middle = float(depth.median())
    fault = f"the median depth is {middle:.3g}" if not 0.05 <= middle <= 10 else ""
    yield ruled("scale", fault, "the model takes metres", found=f"the median depth is {middle:.3g} m")
    fault = "there are depths of 0 or less" if float(depth.min()) <= 0 else ""
    yield ruled("normalization", fault, "give plain metres: the network subtracts by itself", found="plain metres")
