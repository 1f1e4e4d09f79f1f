"""A file whose name promises a recording or an image, and which is none, is told so."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image

from pcdata import open_source
from pcdata.errors import CaptureError
from pcdata.io.sources.unknown_layout import _FILES


@pytest.mark.parametrize("suffix", _FILES)
def test_a_file_that_is_not_what_its_name_says_is_told_what_it_begins_with(tmp_path, suffix):
    path = tmp_path / f"a{suffix.upper()}"
    path.write_bytes(bytes(range(7, 200)))
    with pytest.raises(
        CaptureError, match=rf"is called {suffix.upper()}, but does not begin as an? .*07 08 09"
    ) as caught:
        open_source(path)
    assert "The layouts and what each needs" not in str(caught.value)
    path.write_bytes(b"")
    with pytest.raises(CaptureError, match="empty") as caught:
        open_source(path)
    assert "The layouts and what each needs" not in str(caught.value)


def test_one_image_is_no_capture(tmp_path):
    Image.fromarray(np.zeros((4, 5), np.uint16)).save(tmp_path / "a.png")
    np.save(tmp_path / "a.npy", np.zeros((4, 5)))
    for name in ("a.png", "a.npy"):
        with pytest.raises(CaptureError, match=r"one image is no capture\. If the images are depth: pcdata inspect "):
            open_source(tmp_path / name)
    (tmp_path / "a.txt").write_text("nothing")
    with pytest.raises(CaptureError, match="The layouts and what each needs"):
        open_source(tmp_path / "a.txt")
