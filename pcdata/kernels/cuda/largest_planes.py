"""RANSAC without the host: draw, count, choose and refine in a fixed number of kernels."""

from __future__ import annotations

import math

import torch
from torch import Tensor

import pcdata.functional.largest_planes  # noqa: F401 - the function must be registered before its kernel
from pcdata.contracts.asked_later import constant
from pcdata.contracts.dispatch import INNER, kernel
from pcdata.functional.plane_steps import MAX_REFINEMENTS
from pcdata.functional.planes import SCORED_BITS, face_planes
from pcdata.functional.row_draws import MOST_POINTS, words_drawn
from pcdata.geometry.plane_fit import FLAT
from pcdata.kernels.cuda.launching import launcher_of
from pcdata.kernels.cuda.planes import SUMS, blocks_of_a_cloud

_WARP = 32


@kernel("largest_planes", "cuda", roomy=True)
def largest_planes(
    points: Tensor, ptr: Tensor, distance: float, num_hypotheses: int, seed: int, probability: float | None
) -> tuple[Tensor, Tensor, Tensor]:
    """Refine as often as is allowed: rounds behind the last change look at nothing."""
    rows, clouds, device = len(points), len(ptr) - 1, points.device
    words = words_drawn(seed, num_hypotheses, device)
    if words is None or rows >= MOST_POINTS:
        fallen: tuple[Tensor, Tensor, Tensor] = INNER["largest_planes"].reference(
            points, ptr, distance, num_hypotheses, seed, probability
        )
        return fallen
    launcher, words = launcher_of(points), constant(words)
    drawn = torch.empty((clouds, num_hypotheses, 4), dtype=torch.float64, device=device)
    rounded = torch.empty_like(drawn, dtype=torch.float32)
    launcher.launch(
        "pc_draw_planes", clouds * num_hypotheses, points, ptr, clouds, words, num_hypotheses, FLAT, drawn, rounded
    )
    scored, scored_ptr, missed = points, ptr, 0.0
    if probability is not None:
        missed = math.log1p(-probability)
        scored = torch.empty((clouds << SCORED_BITS, 3), dtype=torch.float32, device=device)
        scored_ptr = torch.empty_like(ptr)
        launcher.launch("pc_spread_points", clouds << SCORED_BITS, points, ptr, clouds, SCORED_BITS, scored, scored_ptr)
    counts = torch.zeros((clouds, num_hypotheses), dtype=torch.int32, device=device)
    blocks = blocks_of_a_cloud(launcher, len(scored), clouds)
    launcher.launch_blocks(
        "pc_count_near_planes",
        *(clouds * blocks, scored, scored_ptr, blocks, rounded, num_hypotheses, float(distance), counts),
    )
    tried = torch.empty((clouds, 4), dtype=torch.float64, device=device)
    failed, is_open = torch.zeros(1, dtype=torch.int32, device=device), torch.zeros_like(ptr[:-1], dtype=torch.int32)
    chosen = counts, drawn, num_hypotheses, scored_ptr, missed
    launcher.launch_blocks("pc_choose_planes", clouds, *chosen, tried, failed, block=_WARP)
    planes = tried.clone()
    blocks = blocks_of_a_cloud(launcher, rows, clouds)
    sums = torch.empty((clouds, blocks, SUMS), dtype=torch.float64, device=device)
    for turn in range(MAX_REFINEMENTS + 1):
        launcher.launch_blocks(
            "pc_sum_near_planes", clouds * blocks, points, ptr, blocks, planes, tried, float(distance), sums
        )
        summed = points, ptr, clouds, blocks, sums, FLAT, int(turn == 0)
        launcher.launch("pc_refit_planes", clouds, *summed, planes, tried, is_open)
    near = torch.zeros(rows, dtype=torch.bool, device=device)
    launcher.launch("pc_mark_near", rows, points, ptr, clouds, rows, planes, float(distance), near)
    return face_planes(planes, None, distance), near, failed
