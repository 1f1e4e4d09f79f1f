"""Completions without learning: what a network has to beat, and what tests can compute by hand."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn


class SmoothCompletion(nn.Module):
    """Stretch a membrane over the pixels to complete: the Laplace equation for 1 / depth between known readings.

    Known are readings outside the mask. In 1 / depth a plane is linear, and linear functions solve the equation, so a
    hole in a plane is filled exactly; over a depth edge the membrane smears. Pixels without a path to a known reading
    get 0. Solved by SciPy in float64, on the CPU.

    Source: Perez, Gangnet & Blake, Poisson image editing, 2003, with a guidance field of zero.
    """

    needs_color = False

    def forward(self, rgb: Tensor | None, depth: Tensor, mask: Tensor) -> Tensor:
        """Complete (V, 1, H, W) depth where the mask holds."""
        filled = [
            _membrane(view.double().cpu().numpy(), todo.cpu().numpy()) for view, todo in zip(depth[:, 0], mask[:, 0])
        ]
        return torch.from_numpy(np.stack(filled)[:, None]).to(depth)


class NearestCompletion(nn.Module):
    """Give every pixel to complete the depth of the nearest known reading in the image; 0 where there is none.

    By SciPy, on the CPU.
    """

    needs_color = False

    def forward(self, rgb: Tensor | None, depth: Tensor, mask: Tensor) -> Tensor:
        """Complete (V, 1, H, W) depth where the mask holds."""
        from scipy.ndimage import distance_transform_edt

        filled = []
        for view, todo in zip(depth[:, 0].cpu().numpy(), mask[:, 0].cpu().numpy()):
            known = (view > 0) & ~todo
            if not known.any():
                filled.append(np.zeros_like(view))
                continue
            row, column = distance_transform_edt(~known, return_distances=False, return_indices=True)
            filled.append(view[row, column])
        return torch.from_numpy(np.stack(filled)[:, None]).to(depth)


def _membrane(depth: NDArray[np.float64], todo: NDArray[np.bool_]) -> NDArray[np.float64]:
    from scipy import ndimage, sparse
    from scipy.sparse.linalg import spsolve

    known = (depth > 0) & ~todo
    pieces, count = ndimage.label(todo)
    beside_known = ndimage.binary_dilation(known) & todo
    anchored = np.isin(np.arange(count + 1), pieces[beside_known]) & (np.arange(count + 1) > 0)
    solve = anchored[pieces]
    result = np.where(known, depth, 0.0)
    number = np.full(depth.shape, -1)
    total = int(solve.sum())
    if not total:
        return result
    number[solve] = np.arange(total)
    degree, right = np.zeros(total), np.zeros(total)
    links: list[tuple[NDArray[np.int64], NDArray[np.int64]]] = []
    for here, there in _neighbor_views():
        mine, other, theirs = number[here], number[there], known[there]
        to_known = (mine >= 0) & theirs
        to_unknown = (mine >= 0) & (other >= 0)
        np.add.at(degree, mine[to_known | to_unknown], 1.0)
        np.add.at(right, mine[to_known], 1.0 / depth[there][to_known])
        links.append((mine[to_unknown], other[to_unknown]))
    row, column = (np.concatenate(ends) for ends in zip(*links))
    matrix = sparse.coo_matrix((-np.ones(len(row)), (row, column)), shape=(total, total)) + sparse.diags(degree)
    result[solve] = 1.0 / spsolve(matrix.tocsc(), right)
    return result


def _neighbor_views() -> list[tuple[tuple[slice, slice], tuple[slice, slice]]]:
    """Pair every pixel with each of its 4-neighbors, as two views of an image."""
    every, front, back = slice(None), slice(None, -1), slice(1, None)
    right, down = ((every, front), (every, back)), ((front, every), (back, every))
    return [right, right[::-1], down, down[::-1]]
