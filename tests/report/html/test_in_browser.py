"""The page in a real browser, without a network or a GPU: what is drawn, picked and measured, by mouse and keyboard."""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch

from pcdata import Compose, PointCloud
from pcdata.report import Page
from pcdata.report.html.capture_report import page_of_captures
from pcdata.report.html.gathering import gather_captures
from pcdata.report.html.overlaps import GAP
from pcdata.transforms import Deproject, EstimateNormals, FarthestPointSample
from tests.factories import tabletop_frame
from tests.report.html.recorded import Recorded, rig_frames

pytestmark = pytest.mark.browser
playwright = pytest.importorskip("playwright.sync_api", reason="pip install playwright")
CHROMIUM = os.environ.get("PCDATA_CHROMIUM") or shutil.which("chromium")
if CHROMIUM is None:
    pytest.skip("no chromium: apt-get install chromium", allow_module_level=True)

# Points on a coarse grid, so that each is picked apart from its neighbors; its label is its number.
GRID = torch.stack(torch.meshgrid(*[torch.arange(5.0)] * 2, torch.zeros(1), indexing="ij"), -1).reshape(-1, 3) * 0.1


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    drawing = [
        "--no-sandbox",
        "--disable-dev-shm-usage",
        "--use-angle=swiftshader",
        "--enable-unsafe-swiftshader",
        "--ignore-gpu-blocklist",
    ]
    with playwright.sync_playwright() as driver:
        try:
            opened = driver.chromium.launch(executable_path=CHROMIUM, args=drawing)
        except playwright.Error as error:
            pytest.skip(f"chromium does not start here: {str(error).splitlines()[0]}")
        yield opened
        opened.close()


@pytest.fixture
def visit(browser, tmp_path) -> Iterator[Any]:
    """Open a page from its file; nothing else may be asked for, and nothing may be complained of."""
    heard: list[str] = []
    asked: list[str] = []
    pages = []

    def opened(page: Any, scheme: str = "light", width: int = 1000) -> Any:
        file = page.save(tmp_path / "page.html")
        tab = browser.new_page(viewport={"width": width, "height": 900}, color_scheme=scheme)
        tab.on("console", lambda message: heard.append(message.text))
        tab.on("pageerror", lambda error: heard.append(str(error)))
        tab.on("request", lambda request: asked.append(request.url))
        tab.goto(Path(file).as_uri())
        tab.evaluate("window.pcdata.ready")
        until(tab, "window.pcdata.stage.drawn > 0")
        pages.append(tab)
        return tab

    yield opened
    for tab in pages:
        tab.close()
    assert heard == []
    assert len(asked) == len(pages)
    assert all(url.startswith("file:") for url in asked)


@pytest.fixture(scope="module")
def grid() -> Any:
    cloud = PointCloud(points=GRID, labels=torch.arange(25), colors=torch.rand(25, 3), frame_id="base")
    return cloud.show()


@pytest.fixture(scope="module")
def steps() -> Any:
    chain = Compose([Deproject(), FarthestPointSample(num_points=2000), EstimateNormals(radius=0.05)])
    return chain.show_steps(tabletop_frame(1))


@pytest.fixture(scope="module")
def recording() -> Page:
    """The page of a recording in which the second of three cameras moved."""
    return Page(page_of_captures(gather_captures(Recorded(rig_frames()), num_shown=6)))


def until(tab: Any, condition: str) -> None:
    """Wait; asked from here, since the page's policy forbids to evaluate texts in it."""
    for _ in range(200):
        if tab.evaluate(condition):
            return
        time.sleep(0.05)
    raise AssertionError(f"never: {condition}")


def pixels(tab: Any) -> Any:
    """(H, W, 3) of the canvas, as it is drawn now."""
    import io

    import numpy as np
    from PIL import Image

    tab.evaluate("window.pcdata.stage.draw()")
    return np.array(Image.open(io.BytesIO(tab.locator("canvas").screenshot())).convert("RGB")).astype(int)


def colored(image: Any) -> int:
    """How many pixels differ from the ground, which is that of the corner."""
    return int((abs(image - image[2, 2]).max(axis=2) > 24).sum())


def place_of(tab: Any, row: int) -> list[float]:
    return tab.evaluate(f"window.pcdata.stage.drawnAt(window.pcdata.place({row}))")


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_the_cloud_is_drawn_on_both_grounds(visit, steps, scheme):
    tab = visit(steps, scheme)
    image = pixels(tab)
    assert colored(image) > 1000
    assert (image[2, 2].mean() > 128) == (scheme == "light")


@pytest.mark.parametrize("row", [0, 7, 24])
def test_a_click_picks_the_point_that_is_there(visit, grid, row):
    tab = visit(grid)
    x, y = place_of(tab, row)
    tab.locator("canvas").click(position={"x": x, "y": y})
    told = tab.locator("#picked").text_content()
    assert f"labels {row}" in told
    x, y, z = (float(word) for word in told.split("(")[1].split(")")[0].split())
    assert torch.allclose(torch.tensor([x, y, z]), GRID[row], atol=1e-4)


def test_two_points_are_measured(visit, grid):
    tab = visit(grid)
    tab.locator("#measure").click()
    for row in (0, 4):  # 0.4 m apart
        x, y = place_of(tab, row)
        tab.locator("canvas").click(position={"x": x, "y": y})
    assert tab.locator("#picked").text_content().startswith("400.0 mm apart")


def test_nothing_is_picked_where_nothing_is(visit, grid):
    tab = visit(grid)
    tab.locator("canvas").click(position={"x": 5, "y": 5})
    assert tab.locator("#picked").text_content() == "no point there"


def test_every_choice_changes_what_is_drawn(visit, steps):
    tab = visit(steps)
    assert tab.locator("#step option").all_text_contents() == [
        *("capture", "Deproject", "FarthestPointSample", "EstimateNormals")
    ]
    before = pixels(tab)
    tab.locator("#color").select_option("normals")
    normals = pixels(tab)
    assert (before != normals).any()
    tab.locator("#size").fill("8")
    large = pixels(tab)
    assert colored(large) > 1.2 * colored(normals)
    tab.locator("#before").click()
    until(tab, "![...document.querySelectorAll('#color option')].some((one) => one.textContent === 'normals')")
    assert tab.evaluate("window.pcdata.step") == 2
    axis = tab.get_by_label("x axis")
    tab.evaluate("window.pcdata.stage.zoom(3)")  # the frame's origin lies beside what is looked at
    with_axis = pixels(tab)
    axis.uncheck()
    assert (with_axis != pixels(tab)).any()


def test_the_keyboard_reaches_all(visit, steps):
    tab = visit(steps)
    canvas = tab.locator("canvas")
    canvas.focus()
    images = [pixels(tab)]
    for key in ("ArrowLeft", "ArrowUp", "+", "c"):
        canvas.press(key)
        images.append(pixels(tab))
        assert (images[-1] != images[-2]).any(), key
    canvas.press("[")
    until(tab, "window.pcdata.step === 2")
    canvas.press("m")
    assert tab.locator("#measure").get_attribute("aria-pressed") == "true"
    canvas.press("m")
    canvas.press("r")
    canvas.press("Enter")
    assert tab.locator("#picked").text_content() != ""
    reached = []
    tab.locator("#sample").focus()
    for _ in range(9):
        reached.append(tab.evaluate("document.activeElement.id || document.activeElement.tagName"))
        tab.keyboard.press("Tab")
    assert {"sample", "step", "color", "size", "measure", "reset", "CANVAS"} <= {*reached}


def test_hostile_names_are_text_in_the_viewer(visit):
    name = "<img src=x onerror=window.hit=1>\u202e"
    cloud = PointCloud(points=GRID, frame_id=name.encode("ascii", "ignore").decode(), meta=[{"sample_id": name}])
    tab = visit(cloud.show())
    assert tab.evaluate("window.hit") is None
    assert "<img src=x" in tab.locator("#counted").text_content()


def test_several_pages_of_one_notebook_do_not_touch_each_other(browser, tmp_path, grid, steps):
    outputs = "".join(f"<div>{page._repr_html_()}</div>" for page in (grid, steps, grid))
    (tmp_path / "notebook.html").write_text(f"<!doctype html><meta charset='utf-8'>{outputs}", encoding="utf-8")
    tab = browser.new_page(viewport={"width": 1000, "height": 2600})
    heard: list[str] = []
    tab.on("console", lambda message: heard.append(message.text))
    tab.on("pageerror", lambda error: heard.append(str(error)))
    tab.goto((tmp_path / "notebook.html").as_uri())
    views = tab.frames[1:]
    for view in views:
        until(view, "Boolean(window.pcdata?.stage) && window.pcdata.stage.drawn > 0")
    assert [view.locator("#counted").inner_text().split()[0] for view in views][::2] == ["25", "25"]
    views[0].locator("#color").select_option("labels")
    assert [view.locator("#color").input_value() for view in views] == ["labels", "colors", "colors"]
    assert heard == []
    tab.close()


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_a_narrow_screen_shows_all_without_moving_it_sideways(visit, recording, scheme):
    tab = visit(recording, scheme, width=390)
    assert tab.evaluate("document.documentElement.scrollWidth") <= 390
    band = tab.locator("svg.stretched").first.bounding_box()
    assert 300 < band["width"] <= 390  # the end of the recording, where the fault is, is in sight
    ink, ground = (tab.evaluate(f"getComputedStyle(document.body).{one}") for one in ("color", "backgroundColor"))
    assert contrast(ink, ground) > 7  # WCAG 2.2, 1.4.6


def test_a_link_of_a_fault_and_of_a_sample_opens_its_clouds(visit, recording):
    tab = visit(recording)
    tab.locator("#sample").select_option(index=5)
    until(tab, "window.pcdata.sample === 5")
    tab.get_by_role("button", name="show f3").click()
    until(tab, "window.pcdata.sample === 0")
    tab.get_by_role("button", name="in three dimensions").nth(2).press("Enter")
    until(tab, "window.pcdata.sample === 2")
    assert tab.locator("#sample").evaluate("one => one.selectedOptions[0].textContent") == "f5"


def test_gaps_between_cameras_color_the_cloud_and_say_where_there_is_none(visit, recording):
    tab = visit(recording)
    before = pixels(tab)
    tab.locator("#color").select_option(GAP)
    assert (pixels(tab) != before).any()
    assert tab.locator("#legend").text_content().endswith("gray: none")
    told = set()
    count = tab.evaluate("window.pcdata.said.count")
    for row in range(0, count, count // 40):
        x, y = place_of(tab, row)
        tab.evaluate(f"window.pcdata.pick({x}, {y})")
        told.add(f"{GAP} none" in tab.locator("#picked").text_content())
    assert told == {True, False}


def test_the_parts_of_a_page_are_reached_by_its_links_and_keys(visit, recording):
    tab = visit(recording)
    links = tab.locator("nav a").all_text_contents()
    headings = tab.locator("h2").all_text_contents()
    assert links == headings
    assert headings[:4] == ["Verdict", "In three dimensions", "Cameras over the captures", "Episodes over time"]
    tab.get_by_role("link", name="Planes and noise").press("Enter")
    until(tab, "document.querySelector(location.hash).getBoundingClientRect().top < innerHeight")
    last = tab.locator("details:not([open]) > summary").last
    last.press("Enter")
    until(tab, "document.activeElement.parentElement.open")


def contrast(one: str, other: str) -> float:
    """How far two colors, as ``rgb(r, g, b)``, are apart in lightness; WCAG 2.2, relative luminance."""

    def lightness(color: str) -> float:
        channels = [int(part) / 255 for part in color[color.index("(") + 1 : -1].split(",")[:3]]
        linear = [part / 12.92 if part <= 0.04045 else ((part + 0.055) / 1.055) ** 2.4 for part in channels]
        return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]

    low, high = sorted([lightness(one), lightness(other)])
    return (high + 0.05) / (low + 0.05)


def test_fewer_points_turn_and_all_stand_still(visit):
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(120_000, 3, generator=generator)
    tab = visit(PointCloud(points=points, colors=points, frame_id="base").show(max_points=200_000))
    shown = "[window.pcdata.stage.points, window.pcdata.stage.fewer].map((one) => one.visible)"
    counts = (
        "[window.pcdata.stage.points, window.pcdata.stage.fewer].map((one) => one.geometry.attributes.COLUMN.count)"
    )
    assert tab.evaluate("window.pcdata.stage.slow")  # the processor draws here
    until(tab, "!window.pcdata.stage.fewer.visible")
    still = pixels(tab)
    for column in ("position", "color"):
        assert tab.evaluate(counts.replace("COLUMN", column)) == [120_000, 40_000]
    assert tab.evaluate(f"(window.pcdata.stage.turn(0.1, 0), {shown})") == [False, True]
    until(tab, "window.pcdata.stage.points.visible")
    assert (still != pixels(tab)).any()
    row = tab.evaluate("window.pcdata.stage.pick(...window.pcdata.stage.drawnAt([0.5, 0.5, 1]))")
    assert row >= 0
    tab.evaluate("window.pcdata.nextColor()")
    assert tab.evaluate(counts.replace("COLUMN", "color")) == [120_000, 40_000]
