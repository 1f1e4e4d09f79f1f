"""Pages of ``pcdata report`` in headless Chromium: how soon they paint, how fluently they turn, and pictures of them.

    python benchmarks/report_in_browser.py measure PAGE.html MANY_POINTS.html     # JSON
    python benchmarks/report_in_browser.py pictures PAGE.html FOLDER

Called by report.py with a Python that has playwright; needs nothing of pcdata. ``PCDATA_CHROMIUM`` names the browser.
"""

from __future__ import annotations

import json
import os
import shutil
import statistics
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from playwright.sync_api import sync_playwright

DRAWING = ["--no-sandbox", "--disable-dev-shm-usage", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
PANELS = {  # title of the section -> name of the picture
    "Verdict": "verdict",
    "In three dimensions": "space",
    "Cameras over the captures": "cameras",
    "Points after each step (median)": "funnel",
    "Samples": "samples",
    "Overlap of cameras": "overlap",
    "Planes and noise": "planes",
    "Objects": "objects",
    "Numbers of the checks": "numbers",
}
TALLEST = 560  # CSS pixels of a picture
WIDTH = 760


@contextmanager
def browser() -> Iterator[Any]:
    found = os.environ.get("PCDATA_CHROMIUM") or shutil.which("chromium")
    with sync_playwright() as driver:
        opened = driver.chromium.launch(executable_path=found, args=[*DRAWING, "--ignore-gpu-blocklist"])
        yield opened
        opened.close()


def visited(opened: Any, file: str, **options: Any) -> Any:
    tab = opened.new_page(**options)
    tab.goto(Path(file).resolve().as_uri())
    tab.evaluate("window.pcdata.ready")
    while not tab.evaluate("window.pcdata.stage.drawn > 0"):
        time.sleep(0.02)
    return tab


def measure(page: str, many: str) -> dict[str, Any]:
    paints, views = [], []
    with browser() as opened:
        opened.new_page().close()  # the browser itself has started
        for _ in range(5):
            begun = time.perf_counter()
            tab = visited(opened, page)
            views.append(time.perf_counter() - begun)
            paints.append(tab.evaluate("performance.getEntriesByName('first-contentful-paint')[0].startTime") / 1e3)
            tab.close()
        tab = visited(opened, many, viewport={"width": 1200, "height": 900})
        count = tab.evaluate("window.pcdata.said.count")
        rates = {
            all_points: statistics.median(
                tab.evaluate(f"window.pcdata.stage.measure(30, {all_points})") for _ in range(3)
            )
            for all_points in ("true", "false")
        }
        while_turning = tab.evaluate("Math.ceil(window.pcdata.said.count / window.pcdata.stage.step)")
        renderer = tab.evaluate("window.pcdata.stage.rendererName")
    return {
        "page_mb": round(Path(page).stat().st_size / 1e6, 2),
        "first_paint_seconds": {
            "median": round(statistics.median(paints), 2),
            "all": [round(one, 2) for one in paints],
        },
        "view_drawn_seconds": round(statistics.median(views), 2),
        "points": count,
        "frames_per_second": round(rates["true"], 1),
        "points_while_turning": while_turning,
        "frames_per_second_while_turning": round(rates["false"], 1),
        "renderer": renderer,
        "load": round(os.getloadavg()[0], 1),
    }


def pictures(page: str, folder: str) -> None:
    with browser() as opened:
        tab = visited(opened, page, viewport={"width": WIDTH, "height": 900})
        for number, line in enumerate(tab.locator("details[open]").all()):
            if number:
                line.evaluate("one => { one.open = false }")
        for title, name in PANELS.items():
            section = tab.locator("section", has=tab.locator("h2", has_text=title)).first
            if not section.count():
                continue
            box = section.bounding_box()
            clip = {**box, "height": min(box["height"], TALLEST)}
            tab.screenshot(full_page=True, clip=clip, path=Path(folder) / f"report_{name}.png")


if __name__ == "__main__":
    if sys.argv[1] == "measure":
        print(json.dumps(measure(*sys.argv[2:])))
    else:
        pictures(*sys.argv[2:])
