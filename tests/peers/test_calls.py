"""docs/coming_from.md: calls of other libraries and ours for them, made from rows that are run here.

``python -m tests.peers.test_calls > docs/coming_from.md`` writes the page anew.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.peers.calls import Call, Section, names, names_of
from tests.peers.cameras import KORNIA, LIBREALSENSE, OPENCV
from tests.peers.clouds import MMDETECTION3D, OPEN3D, PCL, PYG, PYTORCH3D, TORCH_CLUSTER
from tests.peers.numbers import SCIKIT_LEARN, SCIPY, SMALL_GICP, TORCHIO

ROOT = Path(__file__).parents[2]
SECTIONS = [
    OPEN3D,
    PYTORCH3D,
    TORCH_CLUSTER,
    PYG,
    PCL,
    MMDETECTION3D,
    KORNIA,
    OPENCV,
    LIBREALSENSE,
    SMALL_GICP,
    SCIPY,
    SCIKIT_LEARN,
    TORCHIO,
]


def page() -> str:
    lines = [
        "# Coming from another library",
        "",
        "Made by `tests/peers/test_calls.py`, which runs every call of ours, and theirs where the library is "
        "installed. "
        "`F` is `pcdata.functional`; `points`, `others`, `queries` are (N, 3) float32 tensors, `K` (V, 3, 3) "
        "intrinsics, "
        "`depth` (V, H, W) metres, `cloud` a `pcdata.PointCloud`, `frame` a `pcdata.DepthFrame`, `generator` a "
        "`torch.Generator` (datasets give random steps theirs).",
        "",
        "True of all: clouds of a batch lie one after another, cut by `ptr` (B+1,) instead of a `batch` vector "
        "or padding: "
        "`ptr = F.ptr_from_counts(torch.bincount(batch))` and back `F.cloud_of_rows(ptr)`. Lengths are in the "
        "unit of the "
        "points, depth is z in metres, distances are not squared, `d < radius` is strict, and ties go to the "
        "lowest row. "
        "Missing neighbors have row N and distance infinity. Poses are 4x4, act on column vectors, and say "
        "both frames in "
        "their name: `world_from_camera` takes camera points to the world (an OpenCV extrinsic is its "
        "inverse). Cameras "
        "look along +z, x to the right, y down; (u, v) = (column, row), integers are centers of pixels.",
    ]
    for section in SECTIONS:
        lines += ["", f"## {section.title}", ""]
        lines += [section.note, ""] if section.note else []
        lines += ["| theirs | ours | what differs |", "|---|---|---|"]
        lines += [
            f"| `{_cell(call.theirs)}` | `{_cell(call.ours)}` | {call.differs.replace('|', chr(92) + '|')} |"
            for call in section.calls
        ]
        if section.missing:
            lines += ["", "Not here:", ""]
            lines += [f"- {what}: {why}" for what, why in section.missing]
    return "\n".join(lines) + "\n"


def _cell(code: str) -> str:
    return code.replace("|", "\\|")


def test_the_page_is_made_from_the_calls():
    assert (ROOT / "docs" / "coming_from.md").read_text(encoding="utf-8") == page()


@pytest.mark.parametrize("section", SECTIONS, ids=lambda section: section.title)
def test_every_call_of_ours_runs(section: Section):
    for call in section.calls:
        found = names()
        try:
            result = eval(call.ours, found)
        except Exception as error:
            raise AssertionError(f"{section.title}: {call.ours}") from error
        assert result is not None, call.ours


def compared(section: Section) -> int:
    """Run the calls of an installed library and ours on the same inputs; return how many were compared."""
    count = 0
    for call in section.calls:
        seen = names_of(section)
        if seen is None:
            pytest.skip(f"{section.title} is not installed")
        try:
            theirs = eval(call.theirs, seen) if call.runs else None
            if call.agree is not None:
                call.agree(theirs, eval(call.ours, names()), seen)
                count += 1
        except Exception as error:
            raise AssertionError(f"{section.title}: {call.theirs} | {call.ours}") from error
    return count


@pytest.mark.parametrize(
    "section", [section for section in SECTIONS if section.modules and section is not OPEN3D], ids=lambda s: s.title
)
def test_their_calls_run_and_agree(section: Section):
    assert compared(section) == sum(call.agree is not None for call in section.calls)


@pytest.mark.open3d
def test_calls_of_open3d_run_and_agree():
    assert compared(OPEN3D) >= 20


def test_a_call_that_disagrees_is_noticed():
    wrong = Section("SciPy", "", (Call("points + 1", "points", agree=SCIPY.calls[0].agree),), SCIPY.modules)
    with pytest.raises(AssertionError):
        compared(wrong)


if __name__ == "__main__":
    print(page(), end="")
