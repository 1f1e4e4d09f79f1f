"""`pcdata view` in a real browser: samples are read when they are chosen, drawn, found by name, and faults are told."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from tests.report.html.test_in_browser import browser, colored, pixels, until  # noqa: F401  # a fixture
from tests.report.serving.serving import Counted, served

pytestmark = pytest.mark.browser
IDS = ["first", "<b>second</b>", "damaged", *(f"more {number:03}" for number in range(500))]


@pytest.fixture
def source() -> Counted:
    return Counted(IDS)


@pytest.fixture
def tab(browser: Any, source: Counted) -> Iterator[Any]:  # noqa: F811
    heard: list[str] = []
    asked: list[str] = []
    with served(source) as server:
        opened = browser.new_page(viewport={"width": 1000, "height": 900})
        opened.on("console", lambda message: heard.append(message.text))
        opened.on("pageerror", lambda error: heard.append(str(error)))
        opened.on("request", lambda request: asked.append(request.url))
        once = server.opening_address
        opened.goto(once)
        opened.evaluate("window.pcdata.ready")
        until(opened, "window.pcdata.stage.drawn > 0")
        assert opened.url == server.address
        yield opened
        opened.close()
        assert heard == []
        assert all(url.startswith((server.address, "data:")) or url == once for url in asked)


def shows(tab: Any, name: str) -> None:
    until(tab, f"window.pcdata.shown.name === {name!r} && window.pcdata.stage.drawn > 0")


def test_samples_are_read_when_they_are_chosen(tab, source):
    shows(tab, "first")
    assert source.loads == ["first"]
    assert colored(pixels(tab)) > 100
    tab.locator("#sample").select_option(label="<b>second</b>")
    shows(tab, "<b>second</b>")
    until(tab, "document.querySelector('#counted').textContent.startsWith('51 points')")
    assert source.loads == ["first", "<b>second</b>"]
    tab.locator("canvas").focus()
    tab.keyboard.press(",")
    shows(tab, "first")
    assert source.loads == ["first", "<b>second</b>"]


def test_a_sample_is_found_by_a_part_of_its_name(tab, source):
    assert tab.locator("#sample option").count() == 200
    assert tab.locator("#earlier").is_disabled()
    tab.locator("#later").click()
    until(tab, "document.querySelector('#sample option').textContent === 'more 197'")
    tab.locator("#find").fill("MORE 49")
    until(tab, "document.querySelectorAll('#sample option').length === 10")
    assert tab.locator("#later").is_disabled()
    tab.locator("#sample").select_option(label="more 493")
    shows(tab, "more 493")
    assert source.loads == ["first", "more 493"]


def test_a_fault_is_told_and_the_next_sample_is_shown(tab):
    tab.locator("#sample").select_option(label="damaged")
    until(tab, "document.querySelector('#pictures .fail') !== null")
    assert "<b>the file</b> was cut short" in tab.locator("#pictures").text_content()
    assert colored(pixels(tab)) == 0
    canvas = tab.locator("canvas")
    for key in ("c", "r", "Enter", "[", "]", "m"):
        canvas.press(key)
    tab.locator("canvas").press(".")
    shows(tab, "more 000")
    assert colored(pixels(tab)) > 100
    assert tab.locator("#pictures .fail").count() == 0
