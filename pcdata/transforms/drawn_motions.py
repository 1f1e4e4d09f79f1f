"""What the random motions share: matrices of which each number is drawn from a word of the cloud's stream."""

from __future__ import annotations

import functools
from typing import Literal

import torch
from torch import Tensor

from pcdata.functional.motions import draw_motions
from pcdata.functional.rows import segment_mean
from pcdata.geometry import rigid
from pcdata.rng import Streams
from pcdata.structures import PointCloud
from pcdata.transforms.base import Params
from pcdata.transforms.families import SpatialTransform
from pcdata.transforms.field_types import Vec3

# The point that stays: the origin, the mean of each cloud, or a point in the cloud's unit.
About = Literal["origin", "centroid"] | Vec3

# Rows of what is drawn, (kind, low, high, a, b, c) as in pcdata.functional.motions.MotionDraw; and the word of each,
# which begin with 0 and rise.
Drawn = tuple[tuple[tuple[int, float, float, float, float, float], ...], tuple[int, ...]]


class DrawnMotion(SpatialTransform, abstract=True):
    """A motion about its field ``about``, or about the origin, that is drawn number by number: write :meth:`drawn`."""

    def drawn(self) -> Drawn | None:
        """Return what is drawn; None = in another way, which ``make_params`` knows."""
        raise NotImplementedError(f"{type(self).__name__}: write the method drawn(self)")

    def make_params(self, data: PointCloud, streams: Streams) -> Params:
        """Draw one matrix per cloud."""
        drawn = self.drawn()
        assert drawn is not None
        (matrix,) = draw_motions(streams.take(num_words(drawn)), drawn_table((drawn,), (0,)), 1)
        about = vars(self).get("about", "origin")
        return {"matrix": matrix if about == "origin" else about_point(about, data, matrix[:, :3, :3])}


def num_words(drawn: Drawn) -> int:
    """Return how many words of each stream are drawn."""
    return drawn[1][-1] + 1


@functools.lru_cache(maxsize=256)
def drawn_table(steps: tuple[Drawn, ...], firsts: tuple[int, ...]) -> Tensor:
    """Return what some steps draw, each from its first word on, as draw_motions takes it; not to be changed."""
    rows = [
        (step, first + word, *row)
        for step, ((rows, words), first) in enumerate(zip(steps, firsts, strict=True))
        for row, word in zip(rows, words, strict=True)
    ]
    return torch.tensor(rows, dtype=torch.float64, device="cpu")


def about_point(point: About, data: PointCloud, linear: Tensor) -> Tensor:
    """Return (B, 4, 4) that apply (B, 3, 3) about the origin, about each cloud's mean, or about a point."""
    if point == "origin":
        return rigid.from_rotation_translation(linear, linear.new_zeros((len(linear), 3)))
    if point == "centroid":
        center = segment_mean(data.points, data.ptr).to(linear.device)
    else:
        center = linear.new_tensor(point).expand(len(linear), 3)
    shift = center - (linear @ center[:, :, None]).squeeze(-1)
    return rigid.from_rotation_translation(linear, shift)
