"""Clouds from files that others wrote, by key mapping: npz, npy, HDF5, zarr v2."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from pcdata.errors import ConfigError, ShapeError, near_matches
from pcdata.io.arrays.stored_arrays import StoredArray, shown_names, stored_arrays, stored_names
from pcdata.models.contract import Channel, InputTensor, ModelContract, Role

# What the keys of a mapping may be called besides the model's own tensor names: the roles of channels.
ROLES = {"points": Role.POSITION, "colors": Role.COLOR, "normals": Role.DIRECTION}

Sample = tuple[str, dict[str, np.ndarray], dict[str, tuple[str, ...]]]


def read_samples(path: str | Path, contract: ModelContract, keys: Mapping[str, str]) -> Iterator[Sample]:
    """Yield every sample of a file: its name, the model's tensors with an axis B of 1, and their channels' names.

    Args:
        path: a .npz, .npy, .h5 or .hdf5 file, or a zarr v2 directory.
        contract: what the arrays are read for.
        keys: from a tensor of the model, or points, colors, normals, to the name in the file; {} = the arrays that have
            the very names of all of the model's tensors, in whatever folder of the file. Points and their
            companions are joined in the model's order of channels; arrays of (samples, points, channels) are cut into
            samples.

    Raises:
        CacheError, CaptureError: the file cannot be read, has no such array, or claims sizes that cannot be true.
        ConfigError: a key that the model does not have.
        DTypeError: an array that holds no numbers.
        ShapeError: arrays without samples, or that do not go together.
    """
    known = [*(spec.key for spec in contract.tensors), *ROLES]
    for name in keys:
        if name not in known:
            raise ConfigError(f"{contract.name}: no key {name!r}{near_matches(name, known)}; it has {', '.join(known)}")
    if not keys:
        found = stored_names(path)  # what kind of file is wrong comes before which array is what
        keys = _own_names(contract, found)
    if not keys:
        which = "it is one array, without a name: --keys points=" if found == [""] else f"it has {shown_names(found)}"
        raise ConfigError(
            f"{contract.name}: {path}: say which array is what, as in --keys points=NAME; {which}; the keys are "
            f"{', '.join(known)}"
        )
    by_role = set(keys) <= set(ROLES)
    if not by_role and not set(keys) <= {spec.key for spec in contract.tensors}:
        raise ConfigError(
            f"{contract.name}: give either {', '.join(ROLES)} or the model's own tensors, not both: "
            f"got {', '.join(keys)}"
        )
    plan = _columns_of(contract, keys) if by_role else {}
    with stored_arrays(path, set(keys.values())) as stored:
        arrays = {name: stored[keys[name]] for name in keys}
        batched = _check_roles(arrays) if by_role else _check_tensors(contract, arrays)
        count = next(iter(batched.values())).shape[0] if batched else 1
        for number in range(count):
            parts = {name: array[number if name in batched else ...] for name, array in arrays.items()}
            if by_role:
                whole, channels = _joined(plan, parts)
            else:
                whole, channels = {key: _with_batch(part, _spec(contract, key)) for key, part in parts.items()}, {}
            yield (
                str(number),
                {key: _as_read(part, _spec(contract, key).dtype) for key, part in whole.items()},
                channels,
            )


def _own_names(contract: ModelContract, found: Sequence[str]) -> dict[str, str]:
    """Return which array is which tensor, where one of each name is there and none may be a part of points; else {}."""
    wanted = [spec.key for spec in contract.tensors]
    named = {key: [name for name in found if name.rpartition("/")[2] == key] for key in wanted}
    if set(wanted) & set(ROLES) or any(len(names) != 1 for names in named.values()):
        return {}
    return {key: names[0] for key, names in named.items()}


# -- which arrays go together ------------------------------------------------------------------------------------------


def _check_roles(arrays: Mapping[str, StoredArray]) -> dict[str, StoredArray]:
    """Require (points, channels) of every array, or (samples, points, channels) of every array, of equal lengths."""
    for name, array in arrays.items():
        if array.ndim not in (2, 3):
            raise ShapeError(
                f"{array.where}: {name} must be (points, channels) or (samples, points, channels), got {array.shape}"
            )
    _check_lengths(arrays, {name: array.shape[:-1] for name, array in arrays.items()})
    return {name: array for name, array in arrays.items() if array.ndim == 3}


def _check_tensors(contract: ModelContract, arrays: Mapping[str, StoredArray]) -> dict[str, StoredArray]:
    """Return the arrays that are cut into samples along B; their lengths must be equal."""
    for name, array in arrays.items():
        axes = _spec(contract, name).axes
        if array.ndim not in (len(axes), len(axes) - (axes[0] == "B")):
            raise ShapeError(f"{array.where}: {name} must be ({', '.join(axes)}), got {array.shape}")
        if 0 in array.shape:
            raise ShapeError(f"{array.where}: {name} is {array.shape}, so there is nothing to check")
    if contract.main.axes[0] != "B":  # the clouds of one batch lie one after another: the file is one sample
        return {}
    leading = {name: array for name, array in arrays.items() if _spec(contract, name).axes[0] == "B"}
    whole = {name: array for name, array in leading.items() if array.ndim == len(_spec(contract, name).axes)}
    _check_lengths(leading, {name: array.shape[:1] if name in whole else () for name, array in leading.items()})
    return whole


def _check_lengths(arrays: Mapping[str, StoredArray], lengths: Mapping[str, tuple[int, ...]]) -> None:
    """Require the same lengths of all arrays, none of them 0.

    Raises:
        ShapeError: they differ, or there is nothing.
    """
    words = {2: "samples and points", 1: "samples or points", 0: "samples"}
    for name, length in lengths.items():
        if 0 in length:
            raise ShapeError(f"{arrays[name].where}: {name} is {arrays[name].shape}, so there is nothing to check")
    (first, wanted), *others = lengths.items()
    for name, length in others:
        if length != wanted:
            raise ShapeError(
                f"{arrays[name].where}: {first} and {name} must have the same {words[max(len(length), len(wanted))]}, "
                f"but {first} is {arrays[first].shape} and {name} {arrays[name].shape}; name arrays that go together"
            )


# -- from arrays to tensors --------------------------------------------------------------------------------------------


def _columns_of(contract: ModelContract, keys: Mapping[str, str]) -> dict[str, tuple[InputTensor, dict[str, Channel]]]:
    """Return tensor key -> its contract and, by role, the channels that the given arrays fill.

    The first tensor has the geometry; of the others, those that hold nothing but colors and normals can be made too.
    """
    plan = {}
    left = set(keys)
    for spec in contract.tensors:
        roles = {role: name for name, role in ROLES.items() if name in keys}
        channels = {roles[channel.role]: channel for channel in spec.channels if channel.role in roles}
        side = spec.channels and all(channel.role in (Role.COLOR, Role.DIRECTION) for channel in spec.channels)
        if channels and (spec is contract.main or side):
            plan[spec.key] = spec, channels
            left -= channels.keys()
    if left:
        raise ConfigError(f"{contract.name}: takes no {' and no '.join(sorted(left))}; leave that out of the keys")
    return plan


def _joined(
    plan: Mapping[str, tuple[InputTensor, Mapping[str, Channel]]], parts: Mapping[str, np.ndarray]
) -> tuple[dict[str, np.ndarray], dict[str, tuple[str, ...]]]:
    """Join points, colors and normals of one sample in the order of each tensor's channels, in its layout."""
    whole, channels = {}, {}
    for key, (spec, given) in plan.items():
        rows = np.concatenate([parts[role] for role in given], axis=-1)
        if spec.layout == "B C N":
            rows = rows.T[None]
        elif spec.axes[0] == "B":
            rows = rows[None]
        whole[key] = rows
        # DP3 and others store points and colors in one array: that is more columns than the name says.
        known = rows.shape[spec.axes.index("C")] != spec.width or len(given) == len(spec.channels)
        if known:
            channels[key] = tuple(channel.name for channel in given.values())
    return whole, channels


def _spec(contract: ModelContract, key: str) -> InputTensor:
    return next(spec for spec in contract.tensors if spec.key == key)


def _with_batch(part: np.ndarray, spec: InputTensor) -> np.ndarray:
    return part[None] if spec.axes[0] == "B" and part.ndim < len(spec.axes) else part


def _as_read(array: np.ndarray, dtype: str) -> np.ndarray:
    """Convert as the models' own loaders do: numbers with a fraction get the tensor's width, all this machine's order.

    DP3's converter of real recordings writes float64, which every one of its data sets reads as float32.
    """
    fractions = array.dtype.kind == "f" and np.dtype(dtype).kind == "f"
    wide = array.dtype.kind == "f" and array.dtype.itemsize > 8  # which no tensor can hold
    with np.errstate(over="ignore"):  # what does not fit becomes infinite, which is a rule of its own
        return array.astype(dtype if fractions else np.float64 if wide else array.dtype.newbyteorder("="), copy=False)
