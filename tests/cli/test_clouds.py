"""pcdata clouds: captures, cloud files and datasets as files that CloudCompare, MeshLab and PCL open."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from pcdata import Compose, open_source, read_pcd, read_ply
from pcdata.cli.main import main
from pcdata.exports.cloud_files import write_clouds
from pcdata.io import write_capture
from pcdata.structures import DepthFrame, PointCloud
from pcdata.transforms import Deproject, MergeViews, SplitObjects, ToFrame
from tests.factories import tabletop_frame

CONFIG = "source: {path: somewhere}\ndepth:\n  - Deproject: {}\n  - ToFrame: {frame: base}\n  - MergeViews: {}\n"


@pytest.fixture
def captures(tmp_path: Path) -> Path:
    write_capture(tabletop_frame(2), tmp_path / "taken")
    return tmp_path / "taken"


def test_views_with_poses_are_one_file_that_has_everything(captures, tmp_path, capsys):
    out = tmp_path / "out"
    assert main(["clouds", str(captures), "--out", str(out), "--scalar-names", "--quality", "labels"]) == 0
    assert "1 file, ply" in capsys.readouterr().out
    (file,) = out.iterdir()
    source = open_source(captures)
    frame = source.load(source.ids[0])
    wanted = Compose([Deproject(), ToFrame(frame=frame.frame_id), MergeViews()])(frame)
    found = read_ply(file)
    for name, value in wanted.fields().items():
        if name != "source_index":
            assert torch.allclose(found.fields()[name].double(), value.double(), atol=1e-6), name
    assert found.frame_id == frame.frame_id
    assert b"property int scalar_label\n" in file.read_bytes()
    assert b"property float quality\n" in file.read_bytes()


@pytest.mark.parametrize("encoding", ["ascii", "binary", "binary_compressed"])
def test_as_pcd(captures, tmp_path, encoding):
    out = tmp_path / "out"
    assert main(["clouds", str(captures), "--out", str(out), "--to", "pcd", "--encoding", encoding]) == 0
    (file,) = out.iterdir()
    assert {"labels", "colors", "view"} <= {*read_pcd(file).fields()}


def test_cloud_files_become_those_of_another_format(captures, tmp_path):
    assert main(["clouds", str(captures), "--out", str(tmp_path / "ply")]) == 0
    assert main(["clouds", str(tmp_path / "ply"), "--out", str(tmp_path / "pcd"), "--to", "pcd"]) == 0
    (one,), (other,) = (tmp_path / "ply").iterdir(), (tmp_path / "pcd").iterdir()
    assert one.stem == other.stem
    assert torch.equal(read_ply(one).points, read_pcd(other).points)
    assert torch.equal(read_ply(one).labels, read_pcd(other).labels)


def test_a_dataset_s_clouds_are_written_as_stored(captures, tmp_path, capsys):
    (tmp_path / "build.yaml").write_text(CONFIG)
    assert main(["build", str(tmp_path / "build.yaml"), "--source", str(captures), "--out", str(tmp_path / "set")]) == 0
    assert main(["clouds", str(tmp_path / "set"), "--out", str(tmp_path / "out")]) == 0
    (file,) = (tmp_path / "out").iterdir()
    assert read_ply(file).frame_id == "base"
    assert main(["clouds", str(tmp_path / "set"), "--out", str(tmp_path / "no"), "--limit", "1"]) == 2
    assert "--limit" in capsys.readouterr().err


class InMemory:
    """A source of one capture of two views that nobody has placed."""

    ids = ("shot",)

    def load(self, sample_id: str) -> DepthFrame:
        return replace(tabletop_frame(2), world_from_camera=None, frame_id=None)


def test_views_without_poses_are_files_of_their_own(tmp_path):
    assert write_clouds(InMemory(), tmp_path / "out") == 2
    files = sorted((tmp_path / "out").iterdir())
    assert [file.stem for file in files] == ["shot_view0", "shot_view1"]
    assert all(read_ply(file).frame_id.startswith("camera") for file in files)


class Objects:
    """A source of one capture whose clouds are the objects of two views."""

    ids = ("shot",)

    def load(self, sample_id: str) -> PointCloud:
        return Compose([Deproject(), SplitObjects()])(tabletop_frame(2))


def test_files_of_objects_are_called_by_their_labels(tmp_path):
    clouds = Objects().load("shot").unbatch()
    labels = [int(cloud.labels[0]) for cloud in clouds]
    second = next(place for place in range(1, len(labels)) if labels[place] <= labels[place - 1])
    names = [f"shot_view{int(place >= second)}_object{label}" for place, label in enumerate(labels)]
    assert write_clouds(Objects(), tmp_path / "out") == len(clouds)
    for name, cloud in zip(names, clouds, strict=True):
        assert torch.equal(read_ply(tmp_path / "out" / f"{name}.ply").points, cloud.points)


class Clouds:
    """A source of clouds in memory."""

    def __init__(self, clouds: dict[str, PointCloud]) -> None:
        self.clouds, self.ids = clouds, list(clouds)

    def load(self, sample_id: str) -> PointCloud:
        return self.clouds[sample_id]


def test_no_file_of_a_part_takes_the_name_of_another_sample(tmp_path):
    both = Compose([Deproject()])(tabletop_frame(2))
    first, second = both.unbatch()
    objects = SplitObjects()(first)
    label = int(objects.labels[0])
    clouds = {"a": objects, f"a_object{label}": second, "b": both, "b_view0": SplitObjects()(both), "b_view1": first}
    count = write_clouds(Clouds(clouds), tmp_path / "out")
    names = sorted(file.stem for file in (tmp_path / "out").iterdir())
    assert len({name.casefold() for name in names}) == count == sum(cloud.num_clouds for cloud in clouds.values())
    found = {name: read_ply(tmp_path / "out" / f"{name}.ply").points for name in names}
    assert torch.equal(found[f"a_object{label}"], second.points)
    assert torch.equal(found[f"a__object{label}"], objects.unbatch()[0].points)
    assert torch.equal(found["b_view1"], first.points)
    assert torch.equal(found["b__view1"], second.points)


def test_one_object_of_each_of_two_views_is_told_with_its_view(tmp_path):
    both = Compose([Deproject()])(tabletop_frame(2))
    labels = [int(view.labels.max()) for view in both.unbatch()]
    wanted = torch.cat([(view.labels == label) for view, label in zip(both.unbatch(), labels, strict=True)])
    one_each = SplitObjects()(replace(both, labels=torch.where(wanted, both.labels, -1)))
    assert write_clouds(Clouds({"shot": one_each}), tmp_path / "out") == 2
    assert sorted(file.stem for file in (tmp_path / "out").iterdir()) == [
        f"shot_view{view}_object{label}" for view, label in enumerate(labels)
    ]


@pytest.mark.parametrize("told", ["mug", None, [1], 3])
def test_what_others_call_an_object_names_no_file(tmp_path, told):
    both = Compose([Deproject()])(tabletop_frame(2)).with_meta([{"object": told}] * 2)
    write_clouds(Clouds({"shot": both}), tmp_path / "out")
    assert sorted(file.stem for file in (tmp_path / "out").iterdir()) == ["shot_view0", "shot_view1"]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--to", "pcd", "--quality", "labels"], "pcd has no quality"),
        (["--to", "pcd", "--scalar-names"], "pcd has no scalar_names"),
        (["--encoding", "binaries"], "encoding must be in"),
        (["--quality", "label"], "one value a point; did you mean 'labels'?"),
    ],
)
def test_options_that_do_not_fit_are_told_and_nothing_is_left(captures, tmp_path, capsys, words, said):
    assert main(["clouds", str(captures), "--out", str(tmp_path / "out"), *words]) != 0
    told = capsys.readouterr().err
    assert said in told
    assert ".partial" not in told
    assert sorted(path.name for path in tmp_path.iterdir()) == ["taken"]


def test_nothing_is_written_over_or_among_the_captures(captures, tmp_path, capsys):
    (tmp_path / "there").mkdir()
    (tmp_path / "there" / "mine.txt").write_text("mine")
    assert main(["clouds", str(captures), "--out", str(tmp_path / "there")]) == 1
    assert (tmp_path / "there" / "mine.txt").read_text() == "mine"
    assert main(["clouds", str(captures), "--out", str(captures / "within")]) != 0
    assert not (captures / "within").exists()
    capsys.readouterr()
