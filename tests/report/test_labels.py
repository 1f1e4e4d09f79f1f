"""Names from files in figures and tables are shown as they are written, and add no line of their own."""

from __future__ import annotations

import pytest
import torch

from pcdata import PointCloud
from pcdata.report.labels import label_text
from pcdata.report.plain_table import text_table

NAMES = ["$x^{2}$", "$\\frac$", "_left", "a\nb", "\x1b[2Jx", "100 $"]


@pytest.mark.parametrize("name", NAMES)
def test_a_label_shows_the_name_and_no_formula(name):
    pytest.importorskip("matplotlib")
    from matplotlib.figure import Figure

    axis = Figure().subplots()
    axis.plot([0, 1], label=label_text(name))
    (shown,) = axis.legend().get_texts()
    text, math = shown._preprocess_math(shown.get_text())  # what drawing does first
    assert not math
    assert text.strip() == name.replace("\n", "\\n").replace("\x1b", "\\x1b")


def test_a_figure_of_hostile_names_is_drawn(tmp_path):
    pytest.importorskip("matplotlib")
    from pcdata.report import save_pipeline_figure

    cloud = PointCloud(points=torch.rand(20, 3), frame_id="$\\frac$")
    save_pipeline_figure(tmp_path / "a.png", cloud, [("$\\frac$", cloud)], title="$\\frac$ \x1b\n")
    assert (tmp_path / "a.png").stat().st_size > 1000


def test_a_cell_takes_one_line_of_a_table():
    lines = text_table(["name", "points"], [["a\npassed  3", 1], ["b\x1b", 2]]).splitlines()
    assert len(lines) == 4
    assert lines[2].startswith("a\\npassed  3")
