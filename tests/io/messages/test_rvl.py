"""RVL: what packs it by the paper is unpacked to the same pixels."""

from __future__ import annotations

import numpy as np
import pytest

from pcdata.errors import CaptureError
from pcdata.io.messages.rvl import unpacked_rvl
from tests.ros_recordings import packed_rvl


@pytest.mark.parametrize("seed", range(4))
def test_pixels_come_back_as_they_were(seed: int) -> None:
    draw = np.random.default_rng(seed)
    pixels = draw.integers(0, 1 << 16, (7, 13)).astype(np.uint16)
    pixels[draw.random((7, 13)) < 0.25 * seed] = 0
    assert np.array_equal(unpacked_rvl(packed_rvl(pixels), pixels.size), pixels.reshape(-1))


def test_an_image_of_zeros_and_one_that_ends_in_zeros() -> None:
    for pixels in (np.zeros(40, np.uint16), np.array([5, 0, 0, 0], np.uint16), np.array([0, 0, 65535], np.uint16)):
        assert np.array_equal(unpacked_rvl(packed_rvl(pixels), len(pixels)), pixels)


def test_what_ends_early_or_leaves_the_image_is_refused() -> None:
    content = packed_rvl(np.arange(1, 200, dtype=np.uint16))
    for wrong, count in ((content[:-40], 199), (content, 500), (content, 20), (b"", 4), (b"\xff" * 64, 9)):
        with pytest.raises(CaptureError, match="damaged"):
            unpacked_rvl(wrong, count)
