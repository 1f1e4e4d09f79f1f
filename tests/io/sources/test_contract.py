"""Laws of everything that captures come from: every layout, every combinator, synthetic scenes, built datasets."""

from __future__ import annotations

import inspect
import json
import os
import pickle
import typing
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import pytest
import torch

from pcdata import open_source, validate_source
from pcdata.build import build_dataset, config_from_yaml
from pcdata.datasets import CachedCloudDataset
from pcdata.errors import CaptureError, ConfigError, DTypeError, PcdataError
from pcdata.exports.export_source import DrawnClouds
from pcdata.files.sample_names import in_order
from pcdata.io import (
    COMBINATORS,
    LAYOUTS,
    CaptureSource,
    CombinedSource,
    JoinedSource,
    Source,
    SubsetSource,
    refused_captures,
    register_combinator,
    register_layout,
)
from pcdata.io.sources.capture_source import episodes_of, signals_of
from pcdata.io.sources.combine import Selectable
from pcdata.io.sources.registry import fields_of, options_of
from pcdata.structures import DepthFrame
from pcdata.synthetic import SyntheticSource, TeleopSource
from tests.captures import CAPTURES, OPTIONS, folder_capture, graspnet_capture, seven_scenes_capture
from tests.files.test_library_errors import FOREIGN
from tests.messages import told
from tests.warm import run_python

COMBINED: dict[str, dict[str, Any]] = {  # by combinator: how it is said of a capture of three frames
    "averaged": {"num_frames": 3, "min_count": 1, "max_moving": 1},
    "temporal": {"num_frames": 2, "alpha": 0.5},
    "convention": {"axes": "opengl", "rows": "bottom_first"},
    "posed": {"file": str(Path(__file__).with_name("camera_poses.json")), "camera": "left"},
}
TEXTS = ("file", "frame_id", "episode", "camera")  # fields that any text may be a value of


def still(root: Path) -> Path:
    """Three captures of one camera that stands still."""
    return seven_scenes_capture(root, still=True)


def synthetic(root: Path) -> CaptureSource:
    return SyntheticSource(num_scenes=2, num_objects=1, size=(12, 16))


def built(root: Path) -> CaptureSource:
    config = config_from_yaml("depth: [Deproject]\n")
    build_dataset(config, open_source(folder_capture(root / "capture")), root / "set")
    return DrawnClouds(CachedCloudDataset(root / "set"))


def joined(root: Path) -> CaptureSource:
    graspnet_capture(root / "b")
    folder_capture(root / "a")
    return open_source(root / "*")


OTHERS: dict[str, Callable[[Path], CaptureSource]] = {
    "subset": lambda root: SubsetSource(open_source(folder_capture(root)), ["a_10", "a_1"]),
    "joined": joined,
    "synthetic": synthetic,
    "teleop": lambda root: TeleopSource(num_episodes=1, num_views=1, size=(12, 16)),
    "built": built,
}
NAMES = [*LAYOUTS, *COMBINATORS, *OTHERS]


def made(name: str, root: Path) -> CaptureSource:
    if name in LAYOUTS:
        return open_source(CAPTURES[name](root), kind=name, **OPTIONS.get(name, {}))
    return open_source(still(root), **{name: COMBINED[name]}) if name in COMBINATORS else OTHERS[name](root)


def same(one: Any, other: Any) -> bool:
    if isinstance(one, DepthFrame):
        return torch.equal(one.depth, other.depth) and one.sample_id == other.sample_id
    return torch.equal(one.points, other.points) and one.meta == other.meta


def numbers(source: CaptureSource) -> list[tuple[str, float]]:
    """What a worker loads, in a few numbers."""
    loaded = ((name, source.load(name)) for name in reversed(source.ids))
    return [(name, float((one.depth if isinstance(one, DepthFrame) else one.points).sum())) for name, one in loaded]


@pytest.fixture(params=NAMES)
def source(request: pytest.FixtureRequest, tmp_path: Path) -> CaptureSource:
    return made(request.param, tmp_path / "captures")


def test_every_layout_and_combinator_is_under_these_laws() -> None:
    assert (set(CAPTURES), set(COMBINED)) == (set(LAYOUTS), set(COMBINATORS))


def test_a_source_keeps_the_protocol(source: CaptureSource) -> None:
    ids = source.ids
    assert isinstance(source.name, str)
    assert source.name
    assert len(source) == len(ids) == len(set(ids)) > 0
    assert ids == source.ids
    assert source.ids is not ids  # a caller that changes his list changes no source
    for name in ids:
        loaded = source.load(name)
        assert (loaded.sample_id if isinstance(loaded, DepthFrame) else loaded.meta[0]["sample_id"]) == name
        assert same(loaded, source.load(name))
    if not isinstance(source, JoinedSource):
        assert ids == in_order(ids)


def test_another_process_loads_the_same_in_any_order(source: CaptureSource) -> None:
    again = pickle.loads(pickle.dumps(source))
    assert again.ids == source.ids
    assert episodes_of(again) == episodes_of(source)
    assert signals_of(again, source.ids[-1]).keys() == signals_of(source, source.ids[-1]).keys()
    assert numbers(again) == numbers(source)
    if isinstance(source, (Source, CombinedSource)):
        assert len(pickle.dumps(source)) < 20_000


WORKER = """
import pickle, sys
for source in pickle.load(open(sys.argv[1], "rb")):
    loaded = [source.load(name) for name in source.ids]
    print(*(float(getattr(one, "depth" if hasattr(one, "depth") else "points").sum()) for one in loaded))
"""


def test_a_process_that_opened_none_of_them_loads_every_source(tmp_path: Path) -> None:
    sources = [made(name, tmp_path / name) for name in NAMES]
    (tmp_path / "sources").write_bytes(pickle.dumps(sources))
    done = run_python(WORKER, str(tmp_path / "sources"), folder=tmp_path)
    found = [[float(number) for number in line.split()] for line in done.stdout.splitlines()]
    assert found == [[number for _, number in reversed(numbers(one))] for one in sources], done.stderr


@pytest.mark.parametrize("name", LAYOUTS)
def test_what_is_cut_or_gone_after_opening_is_a_typed_error(name: str, tmp_path: Path) -> None:
    source = open_source(CAPTURES[name](tmp_path / "captures"), kind=name, **OPTIONS.get(name, {}))
    last = source.ids[-1]
    files = [path for path in source.files(last).values() if path.is_file()]
    raw = files[0].read_bytes()
    files[0].write_bytes(raw[: len(raw) // 3])
    with pytest.raises(PcdataError) as caught:
        source.load(last)
    assert "no locks" not in str(caught.value)
    files[0].unlink()
    with pytest.raises(CaptureError, match="no such file"):
        source.load(last)


@pytest.mark.parametrize("name", LAYOUTS)
def test_a_damaged_file_is_named_in_words_of_ours(name: str, tmp_path: Path) -> None:
    """Whichever file it is; where nothing reads it, or what it lost is not needed, the capture may load."""
    root = tmp_path / "captures"
    path = CAPTURES[name](root)
    known = {(file.parent.name, file.suffix): file for file in sorted(root.rglob("*")) if file.is_file()}
    for file in known.values():
        whole = file.read_bytes()
        for damaged in (whole[: len(whole) // 2], bytes(64) + whole[64:], b"\xfe" * len(whole)):
            file.write_bytes(damaged)
            if told := fault_of(lambda: open_source(path, kind=name, **OPTIONS.get(name, {}))):
                assert file.stem in told or file.parent.name in told, f"{file}: {told}"
                assert not [word for word in FOREIGN if word in told], f"{file}: {told}"
        file.write_bytes(whole)


def fault_of(opened: Callable[[], CaptureSource]) -> str:
    """What is told of the first fault of a source or its captures; empty where it has none."""
    try:
        source = opened()
        for sample_id in source.ids:
            source.load(sample_id)
    except PcdataError as error:
        return str(error)
    return ""


@pytest.mark.parametrize("name", ["seven_scenes", "rlbench"])
def test_a_recording_in_a_folder_whose_name_is_no_text_opens(name: str, tmp_path: Path) -> None:
    folder = Path(os.fsdecode(os.fsencode(tmp_path) + b"/of\xffmine\n"))
    try:
        folder.mkdir()
    except OSError:
        pytest.skip("this file system has no such names")
    (episode,) = open_source(CAPTURES[name](folder), kind=name).episodes
    assert episode.id == "of_mine_"


@pytest.mark.parametrize("name", ["graspnet_frame", "osd", "pcd", "realsense_bag", "seven_scenes"])
def test_a_real_capture_keeps_the_laws(name: str, test_data: Path) -> None:
    source = open_source(test_data / name, limit=2)
    again = pickle.loads(pickle.dumps(source))
    assert source.ids == in_order(source.ids) == again.ids
    assert same(source.load(source.ids[-1]), again.load(source.ids[-1]))
    with pytest.raises(CaptureError, match=r"no sample .*did you mean"):
        source.load(f"{source.ids[0]}x")


def test_an_unknown_id_is_an_error_that_names_those_nearest(source: CaptureSource) -> None:
    near = source.ids[0][:-1] + "x" * (len(source.ids[0]) > 1)
    for wrong in (near, f"{source.ids[0]}x", "absent", "", 3):
        with pytest.raises(CaptureError, match="no sample") as caught:
            source.load(wrong)
        if wrong == f"{source.ids[0]}x":
            assert "did you mean" in str(caught.value)
    if isinstance(source, CombinedSource):
        with pytest.raises(CaptureError, match="no sample"):
            source.made_of("absent")


def test_a_part_of_a_source_holds_what_it_says(source: CaptureSource) -> None:
    if not isinstance(source, Selectable):
        return
    first, *rest = source.ids
    part = source.subset([first])
    assert (part.ids, len(part)) == ([first], 1)
    assert same(part.load(first), source.load(first))
    with pytest.raises(CaptureError):
        part.load(rest[0] if rest else "absent")
    if rest:
        left = source.without({first: "blurred"})
        before = source.skipped  # a recording may leave samples out of itself
        assert (left.ids, left.skipped) == (rest, {**before, first: "blurred"})
        if rest[1:]:
            assert left.without([rest[0]]).skipped == {**before, first: "blurred", rest[0]: "listed"}
    for wrong in ([], ["absent"], "text"):
        with pytest.raises(PcdataError):
            source.subset(wrong)
    with pytest.raises(CaptureError):
        source.without(source.ids)


@pytest.mark.parametrize("name", [*LAYOUTS, *COMBINATORS])
def test_unknown_options_are_refused_with_those_nearest(name: str, tmp_path: Path) -> None:
    if name in LAYOUTS:
        path, known = CAPTURES[name](tmp_path / "captures"), options_of(LAYOUTS[name])
        misspelled: Any = {f"{known[0]}x": 1}
    else:
        path, known = still(tmp_path / "captures"), fields_of(COMBINATORS[name])
        misspelled = {name: {f"{known[0]}x": 1}}
    with pytest.raises(ConfigError, match=f"did you mean '{known[0]}'"):
        open_source(path, kind=name if name in LAYOUTS else None, **misspelled)
    with pytest.raises(ConfigError, match="did you mean 'averaged'"):
        open_source(path, kind=name if name in LAYOUTS else None, average=3)


@pytest.mark.parametrize("name", COMBINATORS)
def test_every_field_of_a_combinator_refuses_what_is_none_of_its_values(name: str, tmp_path: Path) -> None:
    path = still(tmp_path / "captures")
    for field in fields_of(COMBINATORS[name]):
        for wrong in ("3", float("nan"), -1, True, None, [3])[field in TEXTS :]:
            with pytest.raises(ConfigError):
                open_source(path, **{name: {**COMBINED[name], field: wrong}})
    for wrong in ("3", 2.5, [3], {3: 3}):
        with pytest.raises(ConfigError, match=name):
            open_source(path, **{name: wrong})
    for off in (None, False):
        assert len(open_source(path, **{name: off})) == 3


def test_what_a_source_was_told_opens_it_again(tmp_path: Path) -> None:
    path = still(tmp_path / "captures")
    told = {"only": ["frame-0000*"], "limit": 2, "skip": ["frame-000020"], "invalid_values": [65535, 3], "temporal": 2}
    source = open_source(path, **told)
    assert source.opened == {
        "path": "captures", "kind": "seven_scenes", **told, "temporal": {"num_frames": 2}
    }  # fmt: skip
    assert json.loads(json.dumps(source.opened)) == source.opened
    again = open_source(path, **{name: value for name, value in source.opened.items() if name != "path"})
    assert again.ids == source.ids == ["frame-000000", "frame-000040"]
    assert numbers(again) == numbers(source)
    assert source.subset(source.ids[:1]).opened == {}  # it is not what was opened any more
    assert open_source(path).subset(source.ids[:1]).opened == {}


# -- several captures, and parts of them -------------------------------------------------------------------------------


def test_a_pattern_joins_what_fits_it_in_order(tmp_path: Path) -> None:
    for name in ("scene_10", "scene_2", "other"):
        folder_capture(tmp_path / "captures" / name / "rgbd")
    (tmp_path / "captures" / ".scene_3").mkdir()
    source = open_source(tmp_path / "captures" / "scene_*" / "rgbd", limit=4, skip=["scene_2/rgbd/a_1"])
    assert source.ids == [
        "scene_2/rgbd/a_2", "scene_2/rgbd/a_10", "scene_10/rgbd/a_1", "scene_10/rgbd/a_2"
    ]  # fmt: skip
    assert source.skipped == {"scene_2/rgbd/a_1": "listed"}
    assert source.opened["path"] == "captures/scene_*/rgbd"
    one = open_source(tmp_path / "captures" / "scene_2" / "rgbd").load("a_10")
    assert torch.equal(source.load("scene_2/rgbd/a_10").depth, one.depth)
    with pytest.raises(CaptureError, match="no file or folder fits"):
        open_source(tmp_path / "captures" / "scene_5*")
    with pytest.raises(CaptureError, match="scene_2: no known layout"):
        open_source(tmp_path / "captures" / "scene_*")
    literal = folder_capture(tmp_path / "captures [1]")
    assert open_source(literal).ids == ["a_1", "a_2", "a_10"]


def test_a_pattern_with_a_slash_at_its_end_fits_folders_alone(tmp_path: Path) -> None:
    folder_capture(tmp_path / "demos" / "pick_0")
    (tmp_path / "demos" / "camera.npz").write_bytes(b"PK\3\4")
    with pytest.raises(CaptureError, match=r"camera\.npz: no known layout") as caught:
        open_source(tmp_path / "demos" / "*")
    assert "demos/*/ fits folders alone" in told(caught.value)
    source = open_source(f"{tmp_path}/demos/*/")
    assert source.ids == ["pick_0/a_1", "pick_0/a_2", "pick_0/a_10"]
    assert source.opened["path"] == "demos/*/"
    config = config_from_yaml("depth: [Deproject]\nsource: {path: demos/*/}\n", folder=tmp_path)
    assert config.source.open().ids == source.ids


def test_nothing_is_averaged_or_compared_from_one_recording_to_the_next(tmp_path: Path) -> None:
    for name in ("a", "b"):
        still(tmp_path / name)
    source = open_source(tmp_path / "*", skip=["a/frame-000000"], temporal={"num_frames": 3})
    assert [own for _, own in source.made_of("b/frame-000000")] == ["b/frame-000000"]
    assert [own for _, own in source.made_of("a/frame-000040")] == ["a/frame-000020", "a/frame-000040"]
    one = open_source(tmp_path / "b", temporal={"num_frames": 3}).load("frame-000020")
    assert torch.equal(source.load("b/frame-000020").depth, one.depth)
    with pytest.raises(CaptureError, match="3 captures are no whole number of groups of 2"):
        open_source(tmp_path / "*", averaged={"num_frames": 2, "min_count": 1})  # six captures, but three of each
    assert len(open_source(tmp_path / "*", averaged={"num_frames": 3, "min_count": 1})) == 2
    reports = list(validate_source(open_source(tmp_path / "*")))
    alone = list(validate_source(open_source(tmp_path / "b")))
    assert [report.findings for report in reports[len(reports) // 2 :]] == [report.findings for report in alone]


def test_only_keeps_what_fits_a_pattern(tmp_path: Path) -> None:
    path = folder_capture(tmp_path / "capture")
    assert open_source(path, only="a_1*").ids == ["a_1", "a_10"]
    assert open_source(path, only=["a_2", "a_?"], limit=1).ids == ["a_1"]
    with pytest.raises(CaptureError, match="fits only 'b_\\*'"):
        open_source(path, only=["a_1", "b_*"])
    for wrong in (5, [5], [""]):
        with pytest.raises(ConfigError, match="only must be"):
            open_source(path, only=wrong)


def test_joined_sources_must_be_told_apart(tmp_path: Path) -> None:
    first, second = open_source(folder_capture(tmp_path / "a")), synthetic(tmp_path)
    source = JoinedSource({"a": first, "b": second})
    assert source.ids == [*(f"a/{name}" for name in first.ids), *(f"b/{name}" for name in second.ids)]
    assert source.made_of("a/a_2") == [(first, "a_2")]
    assert JoinedSource({"a": first.without(["a_2"])}).skipped == {"a/a_2": "listed"}
    with pytest.raises(CaptureError, match="join them under other names"):
        JoinedSource({"a": JoinedSource({"b": first}), "a/b": first})
    with pytest.raises(CaptureError, match="no source"):
        JoinedSource({})
    with pytest.raises(DTypeError):
        JoinedSource([first])


def test_captures_that_cannot_be_read_are_found_in_any_source(tmp_path: Path) -> None:
    folder_capture(tmp_path / "a")
    graspnet_capture(tmp_path / "b")
    (tmp_path / "a" / "poses" / "a_2.txt").write_text("nan " * 16)
    refused = refused_captures(open_source(tmp_path / "*"))
    assert list(refused) == ["a/a_2"]
    assert refused["a/a_2"].startswith("PoseError: ")
    left = open_source(tmp_path / "*", skip_refused=True)
    assert left.skipped == refused
    assert "a/a_2" not in left.ids


# -- readers and combinators of one's own ------------------------------------------------------------------------------


@pytest.fixture
def registries() -> Any:
    before = dict(LAYOUTS), dict(COMBINATORS)
    yield
    for registry, entries in zip((LAYOUTS, COMBINATORS), before):
        registry.clear()
        registry.update(entries)


class Arrays(Source):
    """NAME.npy with depth in metres."""

    kind, needs = "arrays", "NAME.npy"

    def __init__(self, path: Path, *, focal: float) -> None:
        self.focal = focal
        super().__init__(path, [file.stem for file in Path(path).glob("*.npy")])

    @classmethod
    def recognizes(cls, path: Path) -> bool:
        return any(path.glob("*.npy"))

    def files(self, sample_id: str) -> dict[str, Path]:
        return {"depth": self.path / f"{sample_id}.npy"}

    def _load(self, sample_id: str) -> DepthFrame:
        raise AssertionError("no test loads one")


@dataclass(frozen=True, kw_only=True)
class Every(CombinedSource):
    """Every so many captures."""

    kind: ClassVar[str] = "every"
    source: CaptureSource
    step: int = 2

    @property
    def sources(self) -> tuple[CaptureSource]:
        return (self.source,)

    @property
    def ids(self) -> list[str]:
        return self.source.ids[:: self.step]

    def made_of(self, sample_id: str) -> list[tuple[CaptureSource, str]]:
        return [(self.source, sample_id)]

    def load(self, sample_id: str) -> Any:
        return self.source.load(sample_id)


def test_a_combinator_of_ones_own_is_said_as_those_of_pcdata(registries: None, tmp_path: Path) -> None:
    register_combinator(Every)
    path = still(tmp_path / "captures")
    assert open_source(path, every=True).ids == ["frame-000000", "frame-000040"]
    assert open_source(path, every={"step": 3}, temporal=2).ids == ["frame-000000"]
    with pytest.raises(ConfigError, match="did you mean 'step'"):
        open_source(path, every={"stepp": 3})


def test_a_registry_refuses_what_is_incomplete_or_taken(registries: None) -> None:
    def other(base: type, **changes: Any) -> type:
        return type("Other", (base,), changes)

    def init(self: Any, path: Path, *, limit: int = 1) -> None: ...

    for register, wrong, words in [
        (register_layout, object, "subclass"),
        (register_layout, Source, "does not say"),
        (register_layout, other(Arrays, kind=""), "must be a text"),
        (register_layout, other(Arrays, kind="folder"), "registered already"),
        (register_layout, other(Arrays, kind="averaged"), "registered already"),
        (register_layout, other(Arrays, kind="new", __init__=init), "'limit'"),
        (register_combinator, Arrays, "subclass"),
        (register_combinator, CombinedSource, "does not say"),
        (register_combinator, JoinedSource, "must be a dataclass with the field 'source'"),
        (register_combinator, other(Every, kind="temporal"), "registered already"),
        (register_combinator, other(Every, kind="folders"), "an option of opening"),
    ]:
        with pytest.raises(ConfigError, match=words):
            register(wrong)


def test_what_opens_captures_is_annotated_with_the_one_protocol() -> None:
    for function in (refused_captures, SubsetSource.__init__, JoinedSource.__init__):
        hints = typing.get_type_hints(function)
        assert any("CaptureSource" in str(hint) for hint in hints.values()), function
    members = {name for name, _ in inspect.getmembers(CaptureSource) if not name.startswith("_")}
    assert members == {"ids", "load", "name"}
