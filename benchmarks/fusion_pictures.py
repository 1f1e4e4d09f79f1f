"""The pictures of docs/fusion.md: the room of a recording, and a rendered table, fused.

PCDATA_TEST_DATA=... python benchmarks/fusion_pictures.py     # docs/fusion_room.png, docs/fusion_table.png
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from torch import Tensor

import pcdata
from pcdata.structures import PointCloud, TSDFVolume
from pcdata.synthetic import tabletop
from pcdata.synthetic.viewpoints import look_at

DOCS = Path(__file__).parents[1] / "docs"
_LIGHT = torch.nn.functional.normalize(torch.tensor([0.3, -0.5, 0.8]), dim=0)
_FINER = 2  # pixels are drawn so many times finer, then averaged


def main() -> None:
    torch.set_num_threads(1)
    save("fusion_table.png", table())
    if "PCDATA_TEST_DATA" in os.environ:
        save("fusion_room.png", room(Path(os.environ["PCDATA_TEST_DATA"]) / "seven_scenes"))


def room(folder: Path) -> list[Tensor]:
    """What the first camera saw, from a step behind it, at 5 and at 2 mm."""
    source = pcdata.open_source(folder)
    frames = [source.load(name) for name in source.ids]
    pose = frames[0].world_from_camera[0].clone()
    pose[:3, 3] -= 0.35 * pose[:3, 2]
    pictures = []
    for voxel_size in (0.005, 0.002):
        volume = TSDFVolume(voxel_size=voxel_size, max_bytes=16 << 30)
        for frame in frames:
            volume.integrate(frame)
        pictures.append(drawn(volume.extract_points(min_weight=2), pose, focal=420, size=(360, 480), voxel=voxel_size))
    return pictures


def table() -> list[Tensor]:
    """One noisy view and four, and the four without noise; lit, without their colors."""
    pictures = []
    pose = look_at((0.75, -0.55, 0.6), (0.0, 0.0, 0.05))
    for views, noise in ((1, "stereo"), (4, "stereo"), (4, "none")):
        scene = tabletop(1, num_objects=4, num_views=views, noise=noise, floor=False)
        volume = TSDFVolume(voxel_size=0.003)
        volume.integrate(scene.frame)
        cloud = volume.extract_points()
        pictures.append(drawn(cloud, pose, focal=480, size=(260, 320), voxel=0.003, lit=True))
    return pictures


def drawn(
    cloud: PointCloud, pose: Tensor, *, focal: float, size: tuple[int, int], voxel: float, lit: bool = False
) -> Tensor:
    """Draw points as squares of a voxel, the nearest on top: (H, W, 3) float in [0, 1] on white."""
    height, width = (_FINER * edge for edge in size)
    local = (cloud.points.double() - pose[:3, 3]) @ pose[:3, :3]
    color = cloud.colors
    if lit:
        shade = (0.25 + 0.75 * (cloud.normals @ _LIGHT).clamp(min=0))[:, None]
        color = shade * torch.tensor([0.86, 0.89, 0.95])
    ahead = local[:, 2] > 0.1
    (x, y, z), color = local[ahead].unbind(-1), color[ahead]
    u, v = x / z * _FINER * focal + width / 2, y / z * _FINER * focal + height / 2
    radius = int((_FINER * focal * voxel / z.median()).ceil().item() / 2 + 0.5)
    steps = [(du, dv) for dv in range(-radius, radius + 1) for du in range(-radius, radius + 1)]
    depth = torch.full((height * width,), torch.inf, dtype=torch.float64)
    for step in steps:
        shown, pixel = pixels(u, v, step, (height, width))
        depth.scatter_reduce_(0, pixel, z[shown], "amin")
    picture = torch.ones(height * width, 3)
    for step in steps:
        shown, pixel = pixels(u, v, step, (height, width))
        nearest = depth[pixel] == z[shown]
        picture[pixel[nearest]] = color[shown][nearest]
    return picture.reshape(size[0], _FINER, size[1], _FINER, 3).mean(dim=(1, 3))


def pixels(u: Tensor, v: Tensor, step: tuple[int, int], size: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """Which points have their pixel, moved by a step, in the image, and the number of that pixel."""
    column, row = (u + step[0]).floor().long(), (v + step[1]).floor().long()
    shown = torch.nonzero((column >= 0) & (column < size[1]) & (row >= 0) & (row < size[0])).squeeze(1)
    return shown, row[shown] * size[1] + column[shown]


def save(name: str, pictures: list[Tensor]) -> None:
    """Set pictures side by side, in a palette of 256 colors."""
    gap = torch.ones(pictures[0].shape[0], 8, 3)
    row = torch.cat([part for picture in pictures for part in (picture, gap)][:-1], dim=1)
    image = Image.fromarray((255 * row.numpy()).round().astype(np.uint8))
    image.quantize(256, dither=Image.Dither.NONE).save(DOCS / name, optimize=True)


if __name__ == "__main__":
    main()
