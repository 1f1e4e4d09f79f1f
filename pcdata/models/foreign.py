"""Clouds from files that others wrote, by key mapping: npz, npy, HDF5, zarr v2."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from pcdata.errors import CacheError, ConfigError, near_matches
from pcdata.io.zarr_arrays import ZarrArray, zarr_arrays
from pcdata.models.contract import InputTensor, ModelContract, Role

# What the keys of a mapping may be called besides the model's own tensor names: the roles of channels.
ROLES = {"points": Role.POSITION, "colors": Role.COLOR, "normals": Role.DIRECTION}


def read_samples(
    path: str | Path, contract: ModelContract, keys: Mapping[str, str]
) -> Iterator[tuple[str, dict[str, np.ndarray], dict[str, tuple[str, ...]]]]:
    """Yield every sample of a file: its name, the model's tensors with an axis B of 1, and their channels' names.

    Args:
        path: a .npz, .npy, .h5 or .hdf5 file, or a zarr v2 directory.
        contract: what the arrays are read for.
        keys: from a tensor of the model, or points, colors, normals, to the name in the file. Points and their
            companions are joined in the model's order of channels; arrays of (samples, points, channels) are cut into
            samples.

    Raises:
        CacheError: the file cannot be read, or has no such array.
        ConfigError: a key that the model does not have.
    """
    known = [*(spec.key for spec in contract.tensors), *ROLES]
    for name in keys:
        if name not in known:
            raise ConfigError(f"{contract.name}: no key {name!r}{near_matches(name, known)}; it has {', '.join(known)}")
    arrays = _open_arrays(Path(path))
    if not keys:
        raise ConfigError(
            f"{contract.name}: say which array is what, as in --keys points=NAME; the keys are {', '.join(known)}"
        )
    chosen = {name: _array(arrays, path, stored) for name, stored in keys.items()}
    main = next(iter(chosen.values()))
    by_role = bool(set(keys) & set(ROLES))
    batched = main.ndim == (3 if by_role else len(contract.main.axes)) and (by_role or contract.main.axes[0] == "B")
    for number in range(main.shape[0] if batched else 1):
        parts = {name: np.asarray(array[number] if batched else array[...]) for name, array in chosen.items()}
        if by_role:
            whole, channels = _joined(contract, parts)
        else:
            whole = {key: part[None] if _spec(contract, key).axes[0] == "B" else part for key, part in parts.items()}
            channels = {}
        yield str(number), {key: _as_read(part, _spec(contract, key).dtype) for key, part in whole.items()}, channels


def _spec(contract: ModelContract, key: str) -> InputTensor:
    return next(spec for spec in contract.tensors if spec.key == key)


def _as_read(array: np.ndarray, dtype: str) -> np.ndarray:
    """Convert as the models' own loaders do: numbers with a fraction get the tensor's width, all this machine's order.

    DP3's converter of real recordings writes float64, which every one of its data sets reads as float32.
    """
    fractions = array.dtype.kind == "f" and np.dtype(dtype).kind == "f"
    with np.errstate(over="ignore"):  # what does not fit becomes infinite, which is a rule of its own
        return array.astype(dtype if fractions else array.dtype.newbyteorder("="), copy=False)


def _joined(
    contract: ModelContract, parts: dict[str, np.ndarray]
) -> tuple[dict[str, np.ndarray], dict[str, tuple[str, ...]]]:
    """Join points, colours and normals of one sample to the model's first tensor, in its layout."""
    spec = contract.main
    columns, names = [], []
    for channel in spec.channels:
        role = next((name for name, role in ROLES.items() if role is channel.role and name in parts), None)
        if role is not None:
            columns.append(parts.pop(role))
            names.append(channel.name)
    rows = np.concatenate(columns, axis=-1) if columns else np.zeros((0, 0), np.float32)
    if spec.layout == "B C N":
        rows = rows.T[None]
    elif spec.axes[0] == "B":
        rows = rows[None]
    # DP3 and others store points and colours in one array: that is more columns than the name says.
    whole = rows.shape[spec.axes.index("C")] == spec.width and len(spec.channels) > len(names)
    return {spec.key: rows}, {} if whole else {spec.key: tuple(names)}


def _open_arrays(path: Path) -> Mapping[str, Any]:
    if path.is_dir():
        return zarr_arrays(path)
    try:
        if path.suffix in (".npz", ".npy"):
            loaded = np.load(path, allow_pickle=False)
            return {"": loaded} if isinstance(loaded, np.ndarray) else loaded
        if path.suffix in (".h5", ".hdf5"):
            return _hdf5_arrays(path)
    except (OSError, ValueError, EOFError) as error:
        raise CacheError(f"{path}: cannot be read: {error}") from error
    raise CacheError(f"{path}: is no .npz, .npy, .h5, .hdf5 file and no zarr directory")


def _hdf5_arrays(path: Path) -> dict[str, Any]:
    import h5py

    file = h5py.File(path, "r")
    arrays: dict[str, Any] = {}
    file.visititems(lambda name, item: arrays.update({name: item}) if isinstance(item, h5py.Dataset) else None)
    return arrays


def _array(arrays: Mapping[str, Any], path: str | Path, name: str) -> np.ndarray | ZarrArray:
    if name not in arrays:
        known = sorted(arrays)
        raise CacheError(f"{path}: no array {name!r}{near_matches(name, known)}; it has {', '.join(known) or 'none'}")
    array: np.ndarray | ZarrArray = arrays[name]
    return array
