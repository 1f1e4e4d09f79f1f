"""Filling in depth, by a network or without one: CompleteDepth."""

from __future__ import annotations

import hashlib
import re
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor, nn

from pcdata.errors import CaptureError, ConfigError, DTypeError, NonFiniteError, ShapeError, near_matches
from pcdata.structures import Confidence, DepthFrame
from pcdata.transforms.base import Params, Transform
from pcdata.transforms.field_types import Count
from pcdata.transforms.simple_completions import NearestCompletion, SmoothCompletion

BUILT_IN: dict[str, type[nn.Module]] = {"nearest": NearestCompletion, "smooth": SmoothCompletion}
_IDENTITY = re.compile(r"[\w.<>]+ sha256:[0-9a-f]{16}")


class CompleteDepth(Transform):
    """Let a module fill in the pixels without a trusted reading; they stay marked as filled in.

    To be completed are the pixels of ``frame.mask`` (all, where the capture has none) that have depth 0 or confidence
    NO_READING. Only they change. Where one of the trusted readings (in or outside the mask) lies within ``reach``
    pixels along both axes the result is COMPLETED, elsewhere HALLUCINATED; where the module answers 0 there is still
    no reading.

    ``completion`` is "smooth" or "nearest", or any ``torch.nn.Module`` called as ``module(rgb, depth, mask)``: rgb
    (V, 3, H, W) float32 in [0, 1], depth (V, 1, H, W) float32 metres, mask (V, 1, H, W) bool, True = to be completed;
    it returns depth (V, 1, H, W) in metres, 0 = no answer. Under the mask it sees the depth as captured, outside it
    trusted readings alone. It runs without gradients, in evaluation mode, on the capture's device. A module that needs
    no colors says so by an attribute ``needs_color = False``.

    A configuration holds no code: of a module of your own it keeps the identity, its class and a hash of its structure
    and weights as they were at construction (not of the code of ``forward``). Such a configuration can be read,
    compared and used to load a cache, but to run the step again, make it in Python with the module.

    Args:
        reach: pixels along each axis to a trusted reading, within which a result counts as COMPLETED.

    Raises:
        ConfigError: the step was read from a configuration and the module is not at hand.
        CaptureError: the module needs colors and the capture has none.
        DTypeError, ShapeError, NonFiniteError: the module's answer is not such a depth image.
    """

    takes = DepthFrame
    gives = DepthFrame

    completion: nn.Module | str
    reach: Count = 10

    def check_fields(self) -> None:
        """Find the module, and take its identity once: hashing weights on every capture would be slow."""
        given = self.completion
        if isinstance(given, str) and given not in BUILT_IN and not _IDENTITY.fullmatch(given):
            raise ConfigError(
                f"CompleteDepth: no built-in completion {given!r}{near_matches(given, BUILT_IN)}; known: "
                f"{', '.join(BUILT_IN)}. A network is given in Python: CompleteDepth(completion=module)"
            )
        if isinstance(given, nn.Module):
            given.eval()
        self._name = given if isinstance(given, str) else _identity_of(given)

    def train(self, mode: bool = True) -> CompleteDepth:
        """Leave the completion in evaluation mode: the step is not random."""
        super().train(mode)
        if isinstance(self.completion, nn.Module):
            self.completion.eval()
        return self

    def to_config(self) -> dict[str, dict[str, Any]]:
        """Return the fields with the module's identity in its place."""
        return {type(self).__name__: {"completion": self._name, "reach": self.reach}}

    def _identity(self) -> Any:
        return [type(self).__name__, self.version, self.to_config()[type(self).__name__]]

    def __repr__(self) -> str:
        return f"{type(self).__name__}(completion={self._name!r}, reach={self.reach})"

    def transform(self, data: DepthFrame, params: Params) -> DepthFrame:
        """Complete all views in one call."""
        known = torch.full_like(data.depth, Confidence.RELIABLE, dtype=torch.uint8)
        known = known if data.confidence is None else data.confidence
        trusted = (data.depth > 0) & (known > Confidence.NO_READING)
        todo = ~trusted if data.mask is None else ~trusted & data.mask
        # What is doubtful but not asked for must not be taken for known.
        answer = self._answer(data, torch.where(trusted | todo, data.depth, 0.0), todo)
        filled = todo & (answer > 0)
        near = torch.nn.functional.max_pool2d(trusted[:, None].float(), 2 * self.reach + 1, 1, self.reach)[:, 0] > 0
        level = torch.where(near, int(Confidence.COMPLETED), int(Confidence.HALLUCINATED)).to(torch.uint8)
        confidence = torch.where(filled, level, torch.where(trusted, known, int(Confidence.NO_READING)))
        depth = torch.where(todo, torch.where(filled, answer, 0.0), data.depth)
        return replace(data, depth=depth, confidence=confidence)

    def _module(self) -> nn.Module:
        if isinstance(self.completion, nn.Module):
            return self.completion
        if self.completion in BUILT_IN:
            return BUILT_IN[self.completion]()
        raise ConfigError(
            f"CompleteDepth was made with the module {self.completion!r}, which a configuration cannot hold; to run it "
            "make the pipeline in Python with CompleteDepth(completion=module)"
        )

    def _answer(self, data: DepthFrame, depth: Tensor, todo: Tensor) -> Tensor:
        module = self._module()
        where = f"CompleteDepth: {type(module).__name__}"
        rgb = None if data.colors is None else data.colors.permute(0, 3, 1, 2).float() / 255.0
        if rgb is None and getattr(module, "needs_color", True):
            raise CaptureError(
                f"{where} needs colors, but the capture {data.sample_id!r} has none; use captures with color "
                "registered to the depth, or completion='smooth'"
            )
        with torch.no_grad():
            answer = module(rgb, depth[:, None], todo[:, None].clone())
        if not isinstance(answer, Tensor) or not answer.is_floating_point():
            kind = answer.dtype if isinstance(answer, Tensor) else type(answer).__name__
            raise DTypeError(f"{where} must return a floating-point tensor of metres, got {kind}")
        if answer.shape != data.depth[:, None].shape:
            raise ShapeError(f"{where} must return depth {tuple(data.depth[:, None].shape)}, got {tuple(answer.shape)}")
        answer = torch.where(todo, answer[:, 0].to(data.depth), 0.0)
        bad = int((~torch.isfinite(answer)).sum())
        if bad:
            raise NonFiniteError(f"{where} returned {bad} NaN or infinite depths of the {int(todo.sum())} asked for")
        if bool((answer < 0).any()):
            raise CaptureError(f"{where} returned negative depth, down to {float(answer.min()):g} m; 0 means no answer")
        return answer


def _identity_of(module: nn.Module) -> str:
    """Name a module by its class, and a hash of its structure and weights."""
    digest = hashlib.sha256(repr(module).encode())
    for name, value in sorted(module.state_dict().items()):
        array = value.detach().cpu().contiguous()
        digest.update(f"{name} {array.dtype} {tuple(array.shape)} ".encode())
        digest.update(array.reshape(-1).view(torch.uint8).numpy().tobytes())
    return f"{type(module).__module__}.{type(module).__qualname__} sha256:{digest.hexdigest()[:16]}"
