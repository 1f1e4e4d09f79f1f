"""Where regions meet: how strongly each pixel of a contact says that two objects touch there."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from pcdata.contracts.dispatch import inner
from pcdata.functional.touching.limits import CONTACT_PIXELS, Limits
from pcdata.functional.touching.windows import PixelCamera, PlaneSums, dot, in_pixels, length, plane_normal, spread


class Contacts(NamedTuple):
    """Pairs of pixels that are neighbors and of different regions."""

    first: Tensor  # (E,) int64 pixel, row * W + column
    second: Tensor  # (E,) the one to its right, or below
    strength: Tensor  # (E,) float64, 0 to 1


def region_contacts(
    inverse: Tensor,  # (H, W) float64, 1/z in 1/m, 0 = no reading
    label: Tensor,  # (H, W) int64, -1 = none
    camera: PixelCamera,
    noise: float,
    limits: Limits,
    *,
    backend: str = "auto",
) -> Contacts:
    """Compare the planes of both sides of every contact, each fitted to that side's own points alone.

    Two objects meet in a valley, or one stands before the other: the angle between the planes counts where it is
    concave, and the step between them at the contact.
    """
    pixel = torch.arange(label.numel(), dtype=torch.int64, device=label.device).reshape(label.shape)
    pairs = []
    for here, there in ((pixel[:, :-1], pixel[:, 1:]), (pixel[:-1], pixel[1:])):
        one, two = label.flatten()[here], label.flatten()[there]
        met = (one >= 0) & (two >= 0) & (one != two)
        pairs.append(torch.stack([here[met], there[met]]))
    first, second = torch.cat(pairs, 1)
    fitted, side = torch.cat([first, second]).unique(return_inverse=True)
    planes = region_planes(inverse, label, fitted, camera, noise, limits, backend=backend)
    right, down, middle, normal, mean, found = _on_rays(planes, inverse, fitted, camera)
    a, b = side[: len(first)], side[len(first) :]
    turn = normal[b] - normal[a]
    angle = torch.where(found[a] & found[b], length(turn), 0.0)
    lean = dot(turn, mean[b] - mean[a])
    concave, convex = torch.where(lean < 0, angle, 0.0), torch.where(lean > 0, angle, 0.0)
    half_down = torch.where(second - first == 1, 0.0, 0.5).to(torch.float64)
    half_right = 0.5 - half_down
    step = (middle[a] + right[a] * half_right) + down[a] * half_down
    step = step - ((middle[b] - right[b] * half_right) - down[b] * half_down)
    gap = step.abs() / noise
    bent = (concave - limits.angle_from) / (limits.angle_full - limits.angle_from)
    apart = (gap / torch.where(convex > limits.rim, 2.0, 1.0) - limits.gap_from) / (limits.gap_full - limits.gap_from)
    return Contacts(first, second, torch.maximum(bent, apart).clamp(0, 1))


@inner
def region_planes(
    inverse: Tensor,  # (H, W) float64
    label: Tensor,  # (H, W) int64
    pixel: Tensor,  # (K,) int64, row * W + column
    camera: PixelCamera,
    noise: float,
    limits: Limits,
    *,
    backend: str = "auto",
) -> Tensor:  # (K, 6) float64
    """Fit planes of 1/z around pixels to every second point of rows and columns that has the pixel's own label.

    Each is the slope per column and per row, the rise over the pixel's own 1/z in the middle, the mean column and row
    of the points from there, and 1 where the points span a plane, else 0, with slopes 0 and the mean rise.
    """
    height, width = label.shape
    row, column = pixel // width, pixel % width
    own, own_label = inverse[row, column], label[row, column]
    reach = in_pixels(limits.contact_reach * spread(noise), camera, own, CONTACT_PIXELS)
    sums = PlaneSums(own)
    farthest = int(reach.max()) // 2 * 2 if len(pixel) else 0
    for down in range(-farthest, farthest + 1, 2):
        for right in range(-farthest, farthest + 1, 2):
            y, x = row + down, column + right
            inside = (y >= 0) & (y < height) & (x >= 0) & (x < width)
            y, x = y.clamp(0, height - 1), x.clamp(0, width - 1)
            weight = inside & (label[y, x] == own_label) & (reach >= max(abs(down), abs(right)))
            sums.add(weight.to(own.dtype), right, down, inverse[y, x] - own)
    *plane, found = sums.solved()
    return torch.stack([*plane, found.to(own.dtype)], dim=1)


def _on_rays(
    planes: Tensor, inverse: Tensor, pixel: Tensor, camera: PixelCamera
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Return slopes, 1/z, normal and mean point of planes (K, 6), and where one was found."""
    right, down, rise, mean_u, mean_v, found = planes.unbind(1)
    width = inverse.shape[1]
    middle = inverse.flatten()[pixel] + rise
    x, y = (pixel % width - camera.cx) / camera.fx, (pixel // width - camera.cy) / camera.fy
    normal = plane_normal(right, down, middle, x, y, camera)
    # The mean point of the fit says on which side of the contact its plane lies.
    depth = 1 / ((middle + right * mean_u) + down * mean_v).clamp(min=1e-6)
    mean = torch.stack([(x + mean_u / camera.fx) * depth, (y + mean_v / camera.fy) * depth, depth], dim=-1)
    return right, down, middle, normal, mean, found > 0
