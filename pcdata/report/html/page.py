"""One self-contained page: no network, no server, nothing that a browser must fetch.

three.js draws its views (see ``web/build.sh``): with the viewer it is 0.57 MB, where plotly is 1.75 MB and slow past
100,000 points, k3d 2.6 MB, and viser and rerun need a server.
"""

from __future__ import annotations

import base64
import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import Any

from pcdata.report.html.scene import SampleScene
from pcdata.report.html.text import plain, shown
from pcdata.verdicts import finite_json


@dataclass(frozen=True)
class Section:
    """A part of the page: a heading and HTML that is safe already."""

    title: str
    html: str


def page_of(title: str, sections: Sequence[Section], scenes: Sequence[SampleScene], *, viewer_after: int = 1) -> str:
    """Return a page as HTML.

    Args:
        title: of the page; any text.
        sections: in order; what comes of text in files has gone through :func:`~pcdata.report.html.text.shown`.
        scenes: what the viewer shows; without any there is none.
        viewer_after: how many sections stand before the viewer.
    """
    parts = [
        f'<section id="part-{place}"><h2>{shown(one.title)}</h2>{one.html}</section>'
        for place, one in enumerate(sections)
    ]
    titles = [(f"part-{place}", shown(one.title)) for place, one in enumerate(sections)]
    data = ""
    if scenes:
        index, blobs = _index(scenes)
        parts.insert(viewer_after, _viewer())
        titles.insert(viewer_after, ("space", _VIEWER_TITLE))
        data = f'<script type="application/json" id="pcdata-index">{index}</script>' + "".join(
            f'<script type="text/plain" id="{name}">{text}</script>' for name, text in blobs.items()
        )
    links = " ".join(f'<a href="#{name}">{heading}</a>' for name, heading in titles)
    contents = f"<nav>{links}</nav>" if len(titles) > 3 else ""
    return _document(title, contents + "".join(parts), data, has_viewer=bool(scenes))


def served_page(title: str, total: int) -> str:
    """Return the page of ``pcdata view``: the viewer alone, which asks its server for each sample that is chosen."""
    return _document(
        title,
        _viewer(_CHOICE) + '<section id="pictures"></section>',
        f'<script type="application/json" id="pcdata-served">{total}</script>',
        has_viewer=True,
        connects=True,
    )


def content_policy(*, script: str = "", connects: bool = False) -> str:
    """Return what a page may do, whatever text got into it: run this script, and fetch from its server or nothing."""
    sources = f"script-src '{_digest(script)}'; " if script else ""
    return (
        f"default-src 'none'; img-src data:; style-src 'unsafe-inline'; {sources}"
        f"{'connect-src ' + repr('self') + '; ' if connects else ''}base-uri 'none'; form-action 'none'"
    )


def _document(title: str, body: str, data: str, *, has_viewer: bool, connects: bool = False) -> str:
    script, style = (_web_file(name) for name in ("viewer.js", "page.css"))
    policy = content_policy(script=script, connects=connects)
    return (
        "<!doctype html>\n"
        '<html lang="en"><head><meta charset="utf-8">'
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{shown(title, 200)}</title><style>{style}</style></head>\n"
        f"<body><main><h1>{shown(title, 200)}</h1>{body}</main>"
        f"{data}{f'<script>{script}</script>' if has_viewer else ''}</body></html>\n"
    )


def scene_json(scene: SampleScene, blobs: Sequence[str]) -> dict[str, Any]:
    """Return the description of a scene for the viewer; the clouds of its stages go by the names ``blobs``."""
    stages = []
    for stage, name in zip(scene.stages, blobs, strict=True):
        said = {**stage.cloud.said, "blob": name, "frame": plain(stage.cloud.said["frame"])}
        said["fields"] = [{**field, "name": plain(field["name"], 40)} for field in said["fields"]]
        lines = [
            {"name": plain(one.name, 60), "color": one.color, "segments": one.segments.reshape(-1).round(5).tolist()}
            for one in stage.lines
        ]
        stages.append({"caption": plain(stage.caption, 80), "cloud": said, "lines": lines})
    return {"name": plain(scene.name, 120), "stages": stages}


def _index(scenes: Sequence[SampleScene]) -> tuple[str, dict[str, str]]:
    """Return the description of all scenes as JSON for a script element, and the bytes of their clouds by name."""
    samples: list[dict[str, Any]] = []
    blobs: dict[str, str] = {}
    for scene in scenes:
        names = [f"cloud-{len(blobs) + place}" for place in range(len(scene.stages))]
        blobs |= {name: stage.cloud.text for name, stage in zip(names, scene.stages)}
        samples.append(scene_json(scene, names))
    text = json.dumps(finite_json(samples), allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c").replace("\u2028", "\\u2028").replace("\u2029", "\\u2029"), blobs


@cache
def _web_file(name: str) -> str:
    return (files("pcdata.report.html") / "web" / name).read_text(encoding="utf-8")


def _digest(script: str) -> str:
    return "sha256-" + base64.b64encode(hashlib.sha256(script.encode()).digest()).decode("ascii")


_CHOICE = """<span><button id="earlier" title="samples before these">&#8592;</button>
<label>find <input id="find" type="search" placeholder="part of a name" size="14"></label>
<button id="later" title="samples after these">&#8594;</button></span>"""


def _viewer(choice: str = "") -> str:
    return _VIEWER.replace("<!--choice-->", choice)


_VIEWER_TITLE = "In three dimensions"
_VIEWER = f"""<section id="space"><h2>{_VIEWER_TITLE}</h2><div id="viewer">
<div class="bar"><!--choice--><label>sample <select id="sample"></select></label>
<span><button id="before" title="the step before ([)">&#8592;</button>
<label>step <select id="step"></select></label>
<button id="after" title="the step after (])">&#8594;</button></span>
<label>color <select id="color"></select></label>
<label>size <input id="size" type="range" min="1" max="8" step="0.5" value="2"></label>
<button id="measure" aria-pressed="false" title="pick two points (m)">measure</button>
<button id="reset" title="see all (r)">reset</button></div>
<canvas tabindex="0" aria-label="The cloud. Arrows turn, plus and minus zoom, Enter picks the point in the
middle, brackets change the step, comma and period the sample, c the color, m measures, r shows all."></canvas>
<div class="bar"><span id="legend"></span></div><div class="bar" id="lines"></div>
<output id="picked" aria-live="polite"></output><div class="bar dim"><span id="counted"></span></div></div></section>"""
