"""Clouds and meshes <-> ``Data`` and ``Batch`` of PyTorch Geometric."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from pcdata import extras
from pcdata.errors import CaptureError, DTypeError, FrameError, ShapeError
from pcdata.functional.rows import cloud_of_rows, ptr_from_counts
from pcdata.io.libraries.rows import check_texts, chosen_fields, cloud_of_tensors, vertices_of
from pcdata.structures import Kind, PointCloud, SurfaceMesh

# What their transforms and models look for. To what has "index" in its name a Batch adds the points before the graph.
_OURS = {"points": "pos", "normals": "normal", "labels": "y", "source_index": "source_row"}
_THEIRS = {**{theirs: ours for ours, theirs in _OURS.items()}, "norm": "normals"}
_TAKEN = {
    "x",
    "y",
    "pos",
    "normal",
    "batch",
    "ptr",
    "face",
    "edge_index",
    "edge_attr",
    "edge_weight",
    "frame_id",
    "unit",
}
_MOST_CLOUDS = 1 << 24  # that a "batch" without a "ptr" may number, before memory is taken for so many
_EDGES = ("edge_index", "edge_attr", "edge_weight", "adj_t")


def to_pyg(
    what: PointCloud | SurfaceMesh,
    *,
    features: Sequence[str] = ("colors",),
    fields: Sequence[str] | None = None,
) -> Any:
    """Return a cloud as ``torch_geometric.data.Data``, several as ``Batch`` with ``batch`` and ``ptr``.

    ``pos`` (N, 3) are the points, ``normal`` the normals, ``y`` (N,) the labels, ``x`` (N, C) the features,
    ``source_row`` the source index; every other field keeps its name, and so does every signal, a row for each cloud.
    ``frame_id`` and ``unit`` are texts. Of a mesh ``face`` is (3, T). Tensors stay where they are; those of one cloud
    share their memory, gradients included.

    Args:
        what: a single cloud, a batch or a mesh.
        features: the fields that ``x`` is made of, one after another, as float32; those that the clouds do not have
            are an error, except the colors that this asks for by itself; () = no ``x``.
        fields: what is handed over besides points and features; None = all that is there.

    Raises:
        MissingExtraError: PyTorch Geometric is not installed.
        DTypeError: a field that is not there, or of a name that ``Data`` has for something else.
    """
    where = "to_pyg"
    data = extras.require("torch_geometric").data
    cloud = what.vertices if isinstance(what, SurfaceMesh) else what
    if not isinstance(cloud, PointCloud):
        raise DTypeError(f"{where}: takes a PointCloud or a SurfaceMesh, got {type(what).__name__}")
    check_texts(where, "features", features)
    chosen_fields(where, cloud, fields)  # refuses what is not there
    present = cloud.fields()
    kept = {name: value for name, value in present.items() if fields is None or name in ("points", *fields)}
    signals = dict(cloud.signals) if fields is None else {}
    for name in (*cloud.extra, *signals):
        if name not in kept and name not in signals:
            continue
        if name in _TAKEN or name in _THEIRS or (name in kept and name in signals):
            raise DTypeError(f"{where}: Data has something else called {name!r}; rename the field, or say fields=")
        if "index" in name or "batch" in name:
            raise DTypeError(
                f"{where}: of what is called {name!r} a Batch would change the numbers, since it has 'index' or "
                "'batch' in its name; rename the field, or say fields="
            )
    values: dict[str, Any] = {_OURS.get(name, name): value for name, value in kept.items() if name not in features}
    if (x := _features(where, present, features)) is not None:
        values["x"] = x
    graphs = []
    bounds = cloud.ptr.tolist()
    for b in range(cloud.num_clouds):
        rows = {name: value[bounds[b] : bounds[b + 1]] for name, value in values.items()}
        own = {name: value[b] if isinstance(value, tuple) else value[b : b + 1] for name, value in signals.items()}
        graphs.append(data.Data(**rows, **own, frame_id=cloud.frame_id, unit=cloud.unit))
    if isinstance(what, SurfaceMesh):
        graphs[0].face = what.triangles.T.contiguous()
    return graphs[0] if len(graphs) == 1 else data.Batch.from_data_list(graphs)


def _features(where: str, present: Mapping[str, Tensor], names: Sequence[str]) -> Tensor | None:
    if tuple(names) == ("colors",) and "colors" not in present:
        return None
    if missing := [name for name in names if name not in present]:
        raise DTypeError(f"{where}: features: no field {missing}; the clouds have {[*present]}")
    columns = [_columns(present[name]).to(torch.float32) for name in names]
    return torch.cat(columns, dim=1) if len(columns) > 1 else columns[0] if columns else None


def from_pyg(
    data: Any,
    *,
    frame_id: str | None = None,
    metres_per_unit: float | None = None,
    unit: str | None = None,
    features: Sequence[str] | None = None,
    kinds: Mapping[str, Kind | str] | None = None,
    like: PointCloud | SurfaceMesh | None = None,
) -> PointCloud | SurfaceMesh:
    """Return the cloud of a ``Data``, the batch of a ``Batch``, or the mesh of a ``Data`` with ``face``.

    ``pos`` are the points, ``normal`` (or ``norm``) the normals, ``x`` the colors where it has three columns in 0..1,
    else a field ``x``; whole numbers ``y`` of each point are the labels, ``y`` of each cloud a signal; other tensors
    with a row for each point are fields, texts signals. A tensor that needs no change is shared.

    Args:
        data: of PyTorch Geometric; rows of a batch lie cloud by cloud, as its collate puts them.
        frame_id: the frame of the coordinates; None = as the data says (:func:`to_pyg` writes it), or of ``like``.
        metres_per_unit: of the coordinates; None = metres, refused where they do not look like it.
        unit: "normalized" for coordinates that are no lengths; None = as the data says, or of ``like``, else metres.
        features: the fields that the columns of ``x`` are, as :func:`to_pyg` was told; () = leave it behind.
        kinds: of fields that are not a cloud's own; others are invariant.
        like: the clouds or mesh that were handed over, if none was moved since: what they know of themselves is kept.

    Raises:
        MissingExtraError: PyTorch Geometric is not installed.
        FrameError, UnitError: nobody states the frame or the unit, or two state another.
        CaptureError: edges, for which a cloud has no place; colors or labels that cannot be meant.
        ShapeError, DTypeError, NonFiniteError: the values cannot be those of clouds.
    """
    where = "from_pyg"
    library = extras.require("torch_geometric").data
    if not isinstance(data, library.Data):
        raise DTypeError(f"{where}: takes torch_geometric.data.Data or Batch, got {type(data).__name__}")
    check_texts(where, "features", features)
    held = dict(data.to_dict())
    if edges := [name for name in _EDGES if held.get(name) is not None]:
        raise CaptureError(f"{where}: a cloud has no edges; take {', '.join(edges)} off: data.{edges[0]} = None")
    known = vertices_of(where, like)
    said = {name: _told(where, name, held.pop(name, None)) for name in ("frame_id", "unit")}
    if frame_id is not None and said["frame_id"] not in (None, frame_id):
        raise FrameError(f"{where}: frame_id={frame_id!r}, but the data says {said['frame_id']!r}; give one of them")
    pos, face = held.pop("pos", None), held.pop("face", None)
    if not isinstance(pos, Tensor):
        raise ShapeError(f"{where}: the data has no pos, the (N, 3) points")
    ptr = _row_pointers(where, held.pop("batch", None), held.pop("ptr", None), len(pos))
    num_clouds = 1 if ptr is None else len(ptr) - 1
    tensors: dict[str, Tensor] = {"points": pos}
    signals: dict[str, Tensor] = {}
    texts: dict[str, tuple[str, ...]] = {}
    for name, value in held.items():
        if not isinstance(value, Tensor):
            listed = (value,) if isinstance(value, str) else value
            if isinstance(listed, (list, tuple)) and len(listed) == num_clouds:
                texts |= {name: tuple(listed)} if all(isinstance(text, str) for text in listed) else {}
            continue  # anything else belongs to the graph, not to its points
        has_rows = value.ndim > 0 and len(value) == len(pos)
        of_cloud = value.ndim > 0 and len(value) == num_clouds
        if known is not None and name in known.recorded_signals:
            continue  # like= has it
        if name == "y" and not (has_rows and not value.is_floating_point() and _columns(value).shape[1] == 1):
            (tensors if has_rows and not of_cloud else signals)["y"] = value
        elif name == "x" and has_rows:
            tensors |= _fields_of_x(where, _columns(value), features, known)
        elif has_rows:
            tensors[str(_THEIRS.get(name, name))] = value
        elif of_cloud:
            signals[name] = value
        else:
            raise ShapeError(
                f"{where}: {name} {tuple(value.shape)} has a row neither for each of {len(pos)} points nor for each of "
                f"{num_clouds} clouds; take it off: data.{name} = None"
            )
    cloud = cloud_of_tensors(
        where,
        tensors,
        frame_id=frame_id or (None if known is not None else said["frame_id"]),
        metres_per_unit=metres_per_unit,
        unit=unit or (None if known is not None else said["unit"]),
        kinds=kinds,
        like=known,
        ptr=ptr,
    )
    for name, value in signals.items():
        cloud = cloud.with_signal(name, value, "invariant")
    for name, told in texts.items():
        cloud = cloud if name in cloud.recorded_signals else cloud.with_signal(name, told, "text")
    if face is None:
        return cloud
    return SurfaceMesh(vertices=cloud, triangles=face.T.contiguous().to(torch.int64))


def _columns(value: Tensor) -> Tensor:
    return value.reshape(len(value), value.shape[1:].numel())


def _told(where: str, name: str, value: Any) -> str | None:
    """Return what every graph of the data says."""
    told: set[Any] = {*value} if isinstance(value, (list, tuple)) else {value}
    if len(told) > 1:
        raise FrameError(f"{where}: the graphs are not of one {name}: {sorted(map(str, told))}; batch those of one")
    one = next(iter(told), None)
    if one is not None and not isinstance(one, str):
        raise FrameError(f"{where}: {name} of the data must be a text, got {one!r:.100}")
    return one


def _row_pointers(where: str, batch: Tensor | None, ptr: Tensor | None, num_points: int) -> Tensor | None:
    if ptr is None and batch is None:
        return None
    if ptr is None and batch is not None:
        is_whole = batch.ndim == 1 and not (batch.is_floating_point() or batch.is_complex())
        if not is_whole or len(batch) != num_points or bool((batch[1:] < batch[:-1]).any()):
            raise ShapeError(f"{where}: batch must number the cloud of each of {num_points} points, in order")
        if num_points and not 0 <= int(batch[0]) <= int(batch[-1]) < _MOST_CLOUDS:
            raise ShapeError(
                f"{where}: batch must number clouds from 0 on, at most {_MOST_CLOUDS}, got {int(batch[0])} .. "
                f"{int(batch[-1])}"
            )
        ptr = ptr_from_counts(torch.bincount(batch, minlength=1))
    assert ptr is not None
    if batch is not None and not torch.equal(cloud_of_rows(ptr), batch):
        raise ShapeError(f"{where}: batch and ptr of the data contradict each other")
    return ptr


def _fields_of_x(where: str, x: Tensor, features: Sequence[str] | None, like: PointCloud | None) -> dict[str, Tensor]:
    if features is None:
        low, high = (float(x.min()), float(x.max())) if x.numel() else (0.0, 0.0)
        is_color = x.shape[1] == 3 and 0 <= low <= high <= 1 and x.is_floating_point()
        return {"colors" if is_color else "x": x}
    widths = [_width(name, like) for name in features]
    unknown = [name for name, width in zip(features, widths, strict=True) if width is None]
    if len(unknown) > 1:
        raise ShapeError(f"{where}: how many columns of x are {unknown}? give like= the clouds that had them")
    rest = x.shape[1] - sum(width or 0 for width in widths)
    if rest < 0 or (rest and not unknown and features) or (unknown and rest == 0):
        raise ShapeError(f"{where}: x has {x.shape[1]} columns, which cannot be {list(features)}")
    parts = x.split([rest if width is None else width for width in widths], dim=1) if features else ()
    return {name: _as_it_was(name, part, like) for name, part in zip(features, parts)}


def _width(name: str, like: PointCloud | None) -> int | None:
    if like is not None and name in (fields := like.fields()):
        return fields[name].shape[1:].numel()
    return {"points": 3, "colors": 3, "normals": 3, "labels": 1}.get(name)


def _as_it_was(name: str, part: Tensor, like: PointCloud | None) -> Tensor:
    if like is None or name not in (fields := like.fields()):
        return part
    return part.to(fields[name].dtype).reshape(len(part), *fields[name].shape[1:])
