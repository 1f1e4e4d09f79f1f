"""Names and metadata from files are text on a page, whatever is in them."""

from __future__ import annotations

import html

import pytest
import torch

from pcdata import PointCloud
from pcdata.report.html.page import Section, page_of
from pcdata.report.html.scene import SampleScene, stage_of
from pcdata.report.html.text import plain, shown

HOSTILE = [
    "<script>alert(1)</script>",
    "</script><img src=x onerror=alert(1)>",
    '" onmouseover="alert(1)',
    "a\u202egnp.exe",  # right to left from here
    "a\u2066b\u200bc\ufeff",
    "\x1b[2J\x1b]0;title\x07",
    b"caf\xe9".decode("utf-8", "surrogateescape"),
    "line\u2028separator",
    "x" * 100_000,
]


@pytest.mark.parametrize("text", HOSTILE, ids=range(len(HOSTILE)))
def test_it_is_shown_as_text(text):
    made = shown(text)
    assert "<" not in made
    assert '"' not in made
    assert len(made) < 20_000
    assert html.unescape(made).isprintable()
    made.encode("utf-8")


@pytest.mark.parametrize("text", HOSTILE, ids=range(len(HOSTILE)))
def test_a_page_of_it_has_no_element_that_it_named(text):
    cloud = PointCloud(points=torch.rand(4, 3), frame_id="base", meta=[{"sample_id": text}])
    page = page_of(text, [Section(text, f"<p>{shown(text)}</p>")], [SampleScene(text, (stage_of(text, cloud),))])
    page.encode("utf-8")
    assert page.count("<script") == 3  # the index, one cloud, the viewer
    assert page.count("</script>") == 3 + page_of("", [], []).count("</script>")
    assert "<img" not in page
    assert "\u202e" not in page


def test_what_can_be_read_stays_as_it_is():
    assert shown("Küche 台 №5") == "Küche 台 №5"
    assert plain("a<b & 'c'") == "a<b & 'c'"
