"""The page on captures as pictures, for where no browser is: the same grade, clouds, images and numbers."""

from __future__ import annotations

import io
import re
import textwrap
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from pcdata import extras
from pcdata.errors import CaptureError
from pcdata.files.opening import replacing
from pcdata.report.figures.figure import Panel, figure_of
from pcdata.report.figures.overall_figures import (
    WIDTH,
    cameras_panel,
    episodes_figure,
    gaps_figure,
    numbers_figure,
    objects_figure,
    planes_figure,
)
from pcdata.report.figures.panels import cloud_panel, funnel_panel, picture_panel
from pcdata.report.html.gathering import Gathered, Looked
from pcdata.report.labels import label_text
from pcdata.validation.grading import Grading

_COLUMNS = 4
_LETTERS_PER_INCH = 11.2  # of a reason
_LINE = 0.235  # inches of a reason
_HEAD = 1.0  # inches above the reasons
_MOST_LETTERS = 400  # of one reason
_MOST_REASONS = 10
_MOST_PANELS = 16  # of one sample
_TALLEST = 30_000  # pixels of one picture of all: what programs still open
_OWN = re.compile(r"(sample_\d+|summary|episodes|gaps|planes|objects|numbers)\.png")
_LETTER_COLORS = {"A": "#2b7a3f", "B": "#2b7a3f", "C": "#9a6200", "D": "#c02626", "F": "#c02626"}


def write_pictures(gathered: Gathered, path: str | Path) -> list[Path]:
    """Write what was gathered as PNG: one picture where the path ends in ``.png``, else a folder of them.

    A folder holds ``summary.png`` (grade, reasons, cameras over the captures, points after each step),
    ``episodes.png`` (bands of verdicts and signals), ``sample_01.png`` and on (of each sample that is shown, the worst
    first: its images, its cloud after each step), ``gaps.png`` (between cameras), ``planes.png``, ``objects.png`` and
    ``numbers.png`` (every check's number over the samples): those that there is something to draw for. Pictures of
    those names are replaced, those of an earlier run that this one has not are removed.

    Raises:
        MissingExtraError: matplotlib is not installed.
        CaptureError: the folder's name is that of a file.
        WriteError: a file cannot be written.
    """
    target = check_pictures(path)
    if target.suffix.lower() == ".png":
        _write(target, _all_in_one(gathered))
        return [target]
    written: list[Path] = []
    for name, figure in _figures(gathered):
        target.mkdir(parents=True, exist_ok=True)
        _write(target / f"{name}.png", _png(figure))
        written.append(target / f"{name}.png")
    for file in target.iterdir():
        if _OWN.fullmatch(file.name) and file not in written:
            file.unlink()
    return written


def check_pictures(path: str | Path) -> Path:
    """Require that pictures can be drawn, and that their place is none of something else; before captures are judged.

    Raises:
        MissingExtraError: matplotlib is not installed.
        CaptureError: the folder's name is that of a file, or the file's that of a folder.
    """
    extras.require("matplotlib")
    target = Path(path)
    single = target.suffix.lower() == ".png"
    if target.exists() and target.is_dir() == single:
        raise CaptureError(
            f"report --png: {target} is a {'folder' if single else 'file'}; "
            "give a folder for several pictures, or a name that ends in .png for one"
        )
    return target


def _figures(gathered: Gathered) -> Iterator[tuple[str, Any]]:
    """Draw one picture after another: none waits in memory for the next."""
    yield "summary", _summary(gathered)
    if (episodes := episodes_figure(gathered)) is not None:
        yield "episodes", episodes
    digits = max(2, len(str(len(gathered.looked))))
    for place, one in enumerate(gathered.looked, 1):
        yield f"sample_{place:0{digits}}", _sample(one)
    rest = {"gaps": gaps_figure, "planes": planes_figure, "objects": objects_figure, "numbers": numbers_figure}
    for name, draw in rest.items():
        if (figure := draw(gathered)) is not None:
            yield name, figure


def _summary(gathered: Gathered) -> Any:
    """Draw the verdict, and beside it what fits a row: cameras over the captures, points after each step."""
    beside: list[Panel] = []
    height = 4.0
    if (cameras := cameras_panel(gathered)) is not None:
        beside.append(cameras[0])
        height = max(height, 0.4 * cameras[1] + 1)
    if gathered.funnel:
        beside.append(partial(funnel_panel, funnel=gathered.funnel))
        height = max(height, 0.35 * len(gathered.funnel) + 1)
    width = WIDTH / (len(beside) + 1)
    reasons = _reasons(gathered, int(_LETTERS_PER_INCH * width))
    height = max(height, _HEAD + _LINE * len(reasons) + 0.3)
    verdict: Panel = partial(_verdict_panel, grading=gathered.grading, reasons=reasons, size=(height, width))
    return figure_of([verdict, *beside], title=_title(gathered.title), width=width, height=height)


def _reasons(gathered: Gathered, letters: int) -> list[str]:
    """Return what keeps the grade from an A as lines of so many letters, the worst first."""
    reasons = gathered.grading.grade().reasons
    most = -(-_MOST_LETTERS // letters)
    lines: list[str] = []
    for reason in reasons[:_MOST_REASONS]:
        lines += textwrap.wrap(
            label_text(reason), letters, subsequent_indent="    ", max_lines=most, placeholder=" ..."
        )
    if len(reasons) > _MOST_REASONS:
        lines.append(f"and {len(reasons) - _MOST_REASONS} more")
    if gathered.left_out:
        lines.append(f"{len(gathered.left_out):,} captures were left out of the dataset")
    return lines or ["Nothing that these checks look for is wrong."]


def _verdict_panel(axis: Any, grading: Grading, reasons: Sequence[str], size: tuple[float, float]) -> None:
    letter = grading.grade().letter
    height, width = size
    axis.set_axis_off()
    head = "\n".join(textwrap.wrap(grading.standing(), int(0.55 * _LETTERS_PER_INCH * width)))
    drawn = [
        axis.text(0, 1, letter, fontsize=40, fontweight="bold", color=_LETTER_COLORS[letter], va="top"),
        axis.text(0.7 / width, 0.98, head, va="top", fontsize=14),
        axis.text(0, 1 - _HEAD / height, "\n".join(reasons), va="top", fontsize=11, linespacing=1.4),
    ]
    for text in drawn:
        text.set_in_layout(False)  # long words would leave the panels beside it no room


def _sample(one: Looked) -> Any:
    panels: list[Panel] = [partial(picture_panel, caption=picture.caption, png=picture.png) for picture in one.pictures]
    stages = one.scene.stages if one.scene is not None else ()
    clouds: list[Panel] = [partial(cloud_panel, stage=stage) for stage in stages]
    panels = [*panels[: max(_MOST_PANELS - len(clouds), 3)], *clouds]
    if len(one.funnel) > 1:
        panels.append(partial(funnel_panel, funnel=one.funnel))
    if one.problem or not panels:
        panels.insert(0, partial(_problem_panel, problem=one.problem or "nothing can be shown"))
    return figure_of(panels, title=_title(one.sample_id), columns=_COLUMNS, width=WIDTH / _COLUMNS, height=3.4)


def _problem_panel(axis: Any, problem: str) -> None:
    axis.set_axis_off()
    told = "\n".join(textwrap.wrap(label_text(problem), 48, max_lines=12, placeholder=" ..."))
    axis.text(0, 1, told, va="top", fontsize=9, color=_LETTER_COLORS["F"])


def _title(text: str) -> str:
    return text if len(text) <= 120 else f"{text[:117]}..."


def _png(figure: Any) -> bytes:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", pil_kwargs={"compress_level": 3})
    return buffer.getvalue()


def _all_in_one(gathered: Gathered) -> bytes:
    """Stack the pictures of a folder, as wide as the widest, up to what programs still open."""
    rows: list[np.ndarray] = []
    left_out = 0
    for _, figure in _figures(gathered):
        figure.canvas.draw()
        image = np.asarray(figure.canvas.buffer_rgba())[..., :3].copy()
        if rows and sum(map(len, rows)) + len(image) > _TALLEST:
            left_out += 1
        else:
            rows.append(image)
    if left_out:
        note: Panel = partial(_problem_panel, problem=f"{left_out} pictures more: give a folder instead of a file")
        figure = figure_of([note], height=1.0)
        figure.canvas.draw()
        rows.append(np.asarray(figure.canvas.buffer_rgba())[..., :3].copy())
    width = max(row.shape[1] for row in rows)
    whole = [np.pad(row, ((0, 0), (0, width - row.shape[1]), (0, 0)), constant_values=255) for row in rows]
    buffer = io.BytesIO()
    Image.fromarray(np.concatenate(whole)).save(buffer, format="png", compress_level=3)
    return buffer.getvalue()


def _write(path: Path, content: bytes) -> None:
    with replacing("report --png", path) as temporary:
        Path(temporary).write_bytes(content)
