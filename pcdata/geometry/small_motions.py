"""Small rigid motions from point-to-plane residuals: Jacobian, normal equations, and what they cannot determine.

A twist (6,) is a rotation vector in radians followed by a translation in metres, applied about a pivot:
``p' = R (p - pivot) + pivot + t``.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from pcdata.geometry import rigid

# A direction counts as observed when the surfaces say at least three times as much about it as the noise of their
# normals alone would feign: on a bare plane the noise of the normals looks like relief to slide against.
MAX_FEIGNED_SHARE = 0.25
_LEAST_REAL_SHARE = (
    0.05  # of a direction that is known to be determined: keeps steps along it within 20 times their size
)


@dataclass(frozen=True, eq=False)
class PlaneSystem:
    """The normal equations of sum w (residual + J twist)^2 over point-to-plane residuals, about a pivot."""

    information: Tensor  # (D, D) float64, sum w J J^T; D = 6, or 6 per moving view
    gradient: Tensor  # (D,) float64, sum w J residual
    feigned: Tensor  # (D, D) float64, the part of the information that noise of the normals alone would give

    def __add__(self, other: PlaneSystem) -> PlaneSystem:
        """Join the residuals of two systems about one pivot."""
        return PlaneSystem(
            self.information + other.information, self.gradient + other.gradient, self.feigned + other.feigned
        )


@dataclass(frozen=True, eq=False)
class TwistSolution:
    """The least-squares step along the observable directions alone."""

    twist: Tensor  # (D,) float64, 0 along unobservable directions
    covariance: Tensor  # (D, D) float64 for residuals of unit variance, 0 along unobservable directions
    unobservable: Tensor  # (M, D) float64, a basis of what the residuals do not determine; unit vectors
    decrement: Tensor  # () float64, Newton decrement: the step's length in its standard deviations


def plane_system(
    points: Tensor,  # (N, 3) float64, where the residuals are measured
    normals: Tensor,  # (N, 3) float64 unit, of the surface that stays
    residuals: Tensor,  # (N,) float64, normal . (point - surface)
    weights: Tensor,  # (N,) float64
    *,
    pivot: Tensor,  # (3,) float64
    normal_sigma: float | Tensor,  # radians, () or (N,): standard deviation of the normals along each tangent
) -> PlaneSystem:
    """Build the 6x6 normal equations of moving the points onto the planes.

    Source: Chen & Medioni, Object modeling by registration of multiple range images, 1992; Low, Linear least-squares
    optimization for point-to-plane ICP surface registration, 2004.
    """
    arm = points - pivot
    jacobian = torch.cat([torch.linalg.cross(arm, normals), normals], dim=1)
    weighted = jacobian * weights[:, None]
    information = weighted.T @ jacobian
    # A normal off by d, d across n with covariance s^2 (I - n n^T), changes J by B d, where B n = J:
    # so the expected extra information is sum w s^2 (B B^T - J J^T).
    noise = weights * normal_sigma**2
    feigned = _isotropic_information(arm, noise) - (jacobian * noise[:, None]).T @ jacobian
    return PlaneSystem(information, weighted.T @ residuals, feigned)


def solve_observable(
    system: PlaneSystem, *, num_open: int | None = None, max_feigned_share: float = MAX_FEIGNED_SHARE
) -> TwistSolution:
    """Solve for the twist that brings the residuals to 0, leaving alone what the surfaces do not determine.

    Directions are the generalized eigenvectors of (feigned, information + feigned), so neither the unit of length nor
    the choice between rotation and translation matters. A direction of which more than a quarter is feigned is
    unobservable: a plane slides along itself, a sphere turns about its center. ``unobservable`` lists the most feigned
    first. Where it is known otherwise, ``num_open`` says how many of the most feigned directions are left alone.

    Source: the degeneracy test of Zhang, Kaess & Singh, On degeneracy of optimization-based state estimation problems,
    ICRA 2016, with the noise of the normals in the place of a hand-set threshold.
    """
    size = len(system.gradient)
    both = system.information + system.feigned
    diagonal = both.diagonal()
    if not bool((diagonal > 0).all()):
        # A view without any residual: a unit in its place makes each of its directions an eigenvector of its own.
        both = both + torch.diag((diagonal <= 0).double())
    scale = both.diagonal().rsqrt()
    ridge = 1e-9 * torch.eye(size, dtype=torch.float64, device=both.device)
    factor = torch.linalg.cholesky(scale[:, None] * both * scale + ridge)
    inverse = torch.linalg.inv(factor)
    real = inverse @ (scale[:, None] * system.information * scale) @ inverse.T
    share, vectors = torch.linalg.eigh((real + real.T) / 2)  # the part that is not feigned, ascending
    directions = (scale[:, None] * (inverse.T @ vectors)).T  # (D, D), one per row
    seen = share > 1 - max_feigned_share
    if num_open is not None:
        seen = torch.arange(size, dtype=torch.int64, device=both.device) >= num_open
    basis = directions[seen]
    # The feigned part determines nothing: it is in the information, and once more in the unit that shares are of.
    # Left in, it would shorten every step, and the fit would end before it is where the gradient vanishes.
    real_share = (2 * share[seen] - 1).clamp(min=_LEAST_REAL_SHARE)
    amount = -(basis @ system.gradient) / real_share
    spread = basis / real_share.sqrt()[:, None]
    unobservable = torch.nn.functional.normalize(directions[~seen], dim=1)
    decrement = (amount.square() * real_share).sum().sqrt()
    return TwistSolution(amount @ basis, spread.T @ spread, unobservable, decrement)


def motion_from_twist(twist: Tensor, pivot: Tensor) -> Tensor:  # (..., 6), (3,) -> (..., 4, 4) float64
    """Return the rigid motions of twists (..., 6) about a pivot (3,)."""
    rotation_vector, shift = twist[..., :3].double(), twist[..., 3:].double()
    angle = rotation_vector.norm(dim=-1)
    axis = rotation_vector / torch.where(angle > 0, angle, 1.0)[..., None]
    rotation = rigid.rotation_about_axis(axis, angle)
    if torch.is_grad_enabled() and rotation_vector.requires_grad:
        # At rest there is no axis, but there is a derivative: that of I + [v]x.
        x, y, z = rotation_vector.unbind(-1)
        zero = torch.zeros_like(x)
        cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).reshape(rotation.shape)
        identity = torch.eye(3, dtype=torch.float64, device=rotation.device)
        rotation = torch.where((angle > 0)[..., None, None], rotation, identity + cross)
    pivot = pivot.double()
    return rigid.from_rotation_translation(rotation, pivot + shift - (rotation @ pivot[:, None]).squeeze(-1))


def motion_along(twist: Tensor, pivot: Tensor) -> Tensor:  # (6,), (3,) -> (4, 4) float64
    """Return the motion that goes along one screw: the exponential of the twist, whose turning carries its shift along.

    Small twists give what :func:`motion_from_twist` gives. Far along, a sphere that turns about its center stays where
    it is only this way, whatever the pivot.
    """
    x, y, z = twist[:3].double().tolist()
    velocity = torch.zeros(4, 4, dtype=torch.float64, device=twist.device)
    velocity[:3, :3] = velocity.new_tensor([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    velocity[:3, 3] = twist[3:].double() - velocity[:3, :3] @ pivot.double()
    return torch.linalg.matrix_exp(velocity)


def twist_from_motion(motion: Tensor, pivot: Tensor) -> Tensor:  # (..., 4, 4), (3,) -> (..., 6) float64
    """Return the twists of rigid motions about a pivot; the inverse of :func:`motion_from_twist` below half a turn."""
    rotation = motion[..., :3, :3].double()
    pivot = pivot.double()
    shift = motion[..., :3, 3].double() - pivot + (rotation @ pivot[:, None]).squeeze(-1)
    skew = torch.stack(
        [
            rotation[..., 2, 1] - rotation[..., 1, 2],
            rotation[..., 0, 2] - rotation[..., 2, 0],
            rotation[..., 1, 0] - rotation[..., 0, 1],
        ],
        dim=-1,
    )
    sine = skew.norm(dim=-1) / 2
    cosine = (rotation.diagonal(dim1=-2, dim2=-1).sum(-1) - 1) / 2
    angle = torch.atan2(sine, cosine)
    factor = torch.where(sine > 0, angle / torch.where(sine > 0, 2 * sine, 1.0), 0.5)
    return torch.cat([factor[..., None] * skew, shift], dim=-1)


def _isotropic_information(arm: Tensor, weights: Tensor) -> Tensor:
    """Return sum w B B^T (6, 6), B = [[arm]x; I]: what normals in every direction at once would tell."""
    total = weights.sum()
    first = weights @ arm
    second = (arm * weights[:, None]).T @ arm
    x, y, z = first.unbind()
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero]).reshape(3, 3)
    identity = torch.eye(3, dtype=arm.dtype, device=arm.device)
    turning = second.trace() * identity - second
    return torch.cat([torch.cat([turning, cross], 1), torch.cat([cross.T, total * identity], 1)])
