"""Rows are numbered in 31 bits: what has more of them is refused before a row is read or memory is taken."""

from __future__ import annotations

import re
from typing import Any

import pytest
import torch

from pcdata.errors import BackendError
from pcdata.kernels.cpu import native
from pcdata.kernels.cpu.signatures import DECLARATIONS

pytestmark = pytest.mark.skipif(native.unavailable() is not None, reason="the core is not built")

MOST = 2**31 - 1
ABSENT = ("limits", "pixel", "camera", "within", "guess", "up", "origins")  # may be null
DTYPES = {
    "float*": torch.float32,
    "double*": torch.float64,
    "bool*": torch.bool,
    "uint8*": torch.uint8,
    "int32*": torch.int32,
    "int64*": torch.int64,
}
FUNCTIONS = (
    "pc_neighbors",
    "pc_index_points",
    "pc_normals",
    "pc_statistical_outliers",
    "pc_radius_outlier_mask",
    "pc_dbscan",
    "pc_farthest_points",
    "pc_wide_farthest_points",
    "pc_wide_neighbors",
    "pc_voxel_downsample",
    "pc_refine_planes",
    "pc_ransac_planes",
    "pc_plane_surfaces",
)


def arguments_of(function: str, rows: int) -> list[Any]:
    """One cloud of so many rows that none of the arrays has."""
    (declared,) = re.findall(rf"^{function}: (.*(?:\n    .*)*)", DECLARATIONS, re.MULTILINE)
    found: list[Any] = []
    for kind, name in (argument.split() for argument in declared.replace("\n    ", " ").split(", ")):
        if name == "ptr":
            found.append(torch.tensor([0, rows]))
        elif name in ABSENT:
            found.append(None)
        else:
            found.append(torch.ones(64, dtype=DTYPES[kind]) if kind in DTYPES else 1)
    return found


@pytest.mark.parametrize("name", FUNCTIONS)
def test_one_row_too_many_is_refused_with_what_to_do(name: str) -> None:
    with pytest.raises(BackendError, match=rf"{name}: .* up to 2,147,483,647 rows; .* backend='torch'"):
        native.call(name, *arguments_of(name, MOST + 1))


def test_the_first_row_of_the_last_of_many_clouds_counts_with_those_before_it() -> None:
    arguments = arguments_of("pc_index_points", 0)
    arguments[1], arguments[2] = torch.tensor([0, MOST, MOST + 2]), 2
    with pytest.raises(BackendError, match="2,147,483,647 rows"):
        native.call("pc_index_points", *arguments)
