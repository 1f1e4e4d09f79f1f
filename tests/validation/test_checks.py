"""Laws of every check in the registry: it says what it asks, in words of its own findings, and never ends the run."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path

import pytest
import torch

from pcdata import import_file, validate_source
from pcdata.errors import ConfigError, DTypeError, ShapeError
from pcdata.structures import DepthFrame, PointCloud
from pcdata.transforms import Deproject
from pcdata.validation import CHECKS, CaptureLimits, Check, register_check
from pcdata.validation.checks_page import checks_table
from pcdata.verdicts import Finding, Verdict
from tests.validation.captures import Frames, scene

DOCS = (Path(__file__).parents[2] / "docs" / "validation.md").read_text(encoding="utf-8")


@cache
def captures() -> dict[str, DepthFrame | PointCloud]:
    """Good ones, and others that leave nothing to measure."""
    two, one = scene(num_views=2).frame, scene(num_views=1).frame
    cloud = Deproject()(one)
    none = PointCloud(points=torch.zeros(0, 3), ptr=torch.tensor([0, 0]), frame_id="camera")
    return {
        "two views": two,
        "one view": one,
        "no reading": replace(two, depth=torch.zeros_like(two.depth)),
        "bare": replace(one, colors=None, world_from_camera=None, frame_id=None),
        "cloud": cloud,
        "cloud without points": none,
    }


def findings(check: Check) -> Iterator[Finding]:
    """What it says of the captures one after another, twice where it compares, and then of all."""
    limits, memory = CaptureLimits(), check.memory()
    for capture in captures().values():
        for _ in range((1 + check.compares) * isinstance(capture, check.of)):
            yield from check.judge(capture, limits, [], *memory)
    if check.whole is not None:
        yield from check.whole(*memory, limits)


@pytest.mark.parametrize("name", CHECKS)
def test_a_check_says_what_it_declares_and_gives_advice_for_what_does_not_pass(name):
    check = CHECKS[name]
    assert check.question.endswith("?")
    assert (check.__doc__ or "").strip()
    for finding in findings(check):
        assert finding.name in check.findings
        assert finding.found
        assert bool(finding.advice) == (finding.verdict is not Verdict.PASS), finding
        if finding.value is not None and finding.verdict is not Verdict.UNKNOWN:
            told_alone = check.findings[finding.name][1:3] == ("always", "never")
            assert (finding.threshold is None) == told_alone, "a number without its limit"


def test_every_finding_is_declared_by_one_question():
    names = [name for check in CHECKS.values() if not check.compares for name in check.findings]
    assert len(names) == len(set(names))


def test_the_page_tells_what_the_checks_say():
    assert checks_table() in DOCS


def test_what_a_check_cannot_measure_is_unknown_and_the_others_go_on():
    @register_check("Is it?", findings={"refuses": ("", "", "", "")})
    def refuses(frame, limits, before):
        raise ShapeError("no such thing here")

    try:
        (report,) = list(validate_source(Frames([replace(scene(num_views=1).frame, sample_id="a")])))
    finally:
        del CHECKS["refuses"]
    found = {finding.name: finding for finding in report.findings}
    assert found["refuses"].verdict is Verdict.UNKNOWN
    assert "no such thing here" in found["refuses"].found
    assert found["refuses"].advice
    assert found["valid_fraction"].verdict is Verdict.PASS


OWN = """
from pcdata.validation import register_check
from pcdata.verdicts import graded

@register_check(
    "How far is the farthest reading?",
    findings={"farthest": ("metres", "3", "never", "the room ends there")},
)
def farthest(frame, limits, before):
    far = float(frame.depth.max())
    return [graded("farthest", far, (3.0, None), found=f"{far:.2f} m", advice="close the door", unit="m")]
"""


def test_a_check_of_ones_own_comes_from_a_file_and_a_broken_file_leaves_none(tmp_path):
    (tmp_path / "own.py").write_text(OWN)
    import_file(tmp_path / "own.py")
    try:
        (report,) = list(validate_source(Frames([replace(scene(num_views=1).frame, sample_id="a")])))
        assert [finding.verdict for finding in report.findings if finding.name == "farthest"] == [Verdict.WARN]
        (tmp_path / "other.py").write_text(OWN.replace("the room", "a room"))
        with pytest.raises(ConfigError, match="a check called farthest is registered already"):
            import_file(tmp_path / "other.py")
    finally:
        del CHECKS["farthest"]
    (tmp_path / "broken.py").write_text(OWN.replace("def farthest", "def broken") + "\nraise RuntimeError('no')\n")
    with pytest.raises(ConfigError, match="cannot be run"):
        import_file(tmp_path / "broken.py")
    assert "broken" not in CHECKS


def ends(frame, limits, before):
    return []


SAID = {"x": ("", "", "", "")}


@pytest.mark.parametrize(
    ("arguments", "function", "words"),
    [
        (((), SAID), ends, "question must be a text"),
        ((ends, SAID), ends, "question must be a text"),
        (("?", {}), ends, "findings must be a mapping"),
        (("?", {"x": "four"}), ends, "findings must be a mapping"),
        (("?", SAID, {"of": dict}), ends, "of must be DepthFrame, PointCloud, both, or Path"),
        (("?", SAID, {"of": (DepthFrame, Path)}), ends, "of must be DepthFrame, PointCloud, both, or Path"),
        (("?", SAID, {"whole": ends}), ends, "give remembers too"),
        (("?", SAID, {"remembers": list}), ends, r"called with \(capture, limits, before, memory\)"),
        (("?", SAID), lambda frame: [], r"called with \(capture, limits, before\)"),
        (("?", SAID), DepthFrame, "must be a function"),
    ],
)
def test_a_check_that_does_not_say_what_it_does_is_refused(arguments, function, words):
    question, said, *options = arguments
    with pytest.raises(ConfigError, match=words):
        register_check(question, findings=said, **(options[0] if options else {}))(function)
    assert "ends" not in CHECKS


def test_a_source_that_gives_no_capture_is_refused_rather_than_passed():
    class Texts:
        """No captures."""

        ids = ("a",)

        def load(self, sample_id):
            return "text"

    with pytest.raises(DTypeError, match="gives a str for 'a'"):
        list(validate_source(Texts()))
