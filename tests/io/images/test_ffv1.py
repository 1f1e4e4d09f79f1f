"""Damaged FFV1 pictures are told by their checksums, whoever wrote them."""

from __future__ import annotations

import io
from typing import Any

import numpy as np
import pytest

from pcdata.io.images.ffv1 import is_damaged

av = pytest.importorskip("av")


def packets(**options: str) -> list[bytes]:
    """Code three noisy pictures."""
    buffer = io.BytesIO()
    generator = np.random.default_rng(0)
    with av.open(buffer, "w", format="matroska") as container:
        stream: Any = container.add_stream("ffv1", rate=10)
        stream.height, stream.width, stream.pix_fmt, stream.options = 48, 64, "gray16le", options
        for place in range(3):
            picture = generator.integers(0, 3000, (48, 64)).astype(np.uint16)
            frame = av.VideoFrame.from_ndarray(picture, format="gray16le")
            frame.pts = place
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    buffer.seek(0)
    with av.open(buffer, format="matroska") as container:
        return [bytes(packet) for packet in container.demux(video=0) if packet.size]


@pytest.mark.parametrize(
    "options", [{"slices": "4", "g": "1"}, {"slices": "4", "g": "12"}, {"slices": "9", "coder": "1"}]
)
def test_every_changed_bit_is_found(options: dict[str, str]) -> None:
    for packet in packets(level="3", slicecrc="1", **options):
        assert not is_damaged(packet)
        for place in range(0, len(packet), 61):
            assert is_damaged(packet[:place] + bytes([packet[place] ^ 4]) + packet[place + 1 :])
        assert is_damaged(packet[:-1])


def test_pictures_without_sums_pass_as_long_as_their_slices_fill_them() -> None:
    for packet in packets(level="3", slicecrc="0", slices="4"):
        assert not is_damaged(packet)
        assert is_damaged(packet[:-1])
