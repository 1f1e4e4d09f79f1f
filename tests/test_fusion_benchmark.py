"""What docs/fusion.md states: its tables are those that were measured, and the measure tells what it claims to tell."""

from __future__ import annotations

import dataclasses
import importlib
import json
from pathlib import Path
from types import ModuleType

import pytest
import torch

from pcdata.functional.tsdf.grid import pack_keys
from pcdata.structures import TSDFVolume
from pcdata.synthetic import tabletop

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"
VOXEL, MULTIPLE = 0.01, 5.0


@pytest.fixture
def benchmark(monkeypatch: pytest.MonkeyPatch):
    """Import a script of benchmarks/ by name, as it would import its neighbors."""
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    return importlib.import_module


def test_the_page_shows_the_figures_that_are_kept(benchmark) -> None:
    page: ModuleType = benchmark("fusion_page")
    kept = json.loads((BENCHMARKS / "results" / "fusion.json").read_text())
    for name, table in page.tables(kept).items():
        assert table.count("\n") > 2
        assert page.shown(name) == table, f"table {name!r}: run python benchmarks/fusion.py --kept"


def test_the_pictures_of_the_page_exist_and_are_small() -> None:
    page = (BENCHMARKS.parent / "docs" / "fusion.md").read_text(encoding="utf-8")
    names = [part.split(")")[0] for part in page.split("](") if part.split(")")[0].endswith(".png")]
    assert len(names) == 3
    assert all((BENCHMARKS.parent / "docs" / name).stat().st_size < 300_000 for name in names)


def test_labels_count_as_right_or_wrong_by_the_nearest_solid(benchmark) -> None:
    truth: ModuleType = benchmark("fusion_truth")
    scene = tabletop(1, num_objects=3, num_views=2, size=(60, 80), floor=False)
    cloud = truth.fused(scene.frame)
    right, clear = truth.label_accuracy(scene, cloud)
    assert right > 0.98
    assert 0.5 < clear < 1.0, "some points are near contacts"
    wrong, _ = truth.label_accuracy(scene, dataclasses.replace(cloud, labels=cloud.labels + 1))
    assert wrong == pytest.approx(0.0, abs=0.02)


@pytest.fixture
def frames():
    scene = tabletop(1, num_objects=3, num_views=3, size=(60, 80), noise="stereo", floor=False)
    return [scene.frame.view(number) for number in range(3)]


@pytest.mark.open3d
def test_averages_computed_anew_put_the_points_where_the_volume_has_them(benchmark, frames) -> None:
    pytest.importorskip("open3d")
    agreement: ModuleType = benchmark("fusion_agreement")
    volume = TSDFVolume(voxel_size=VOXEL, carve="never")
    for frame in frames:
        volume.integrate(frame)
    points = volume.extract_points().points
    ends = agreement.edge_ends(points, VOXEL)
    assert (ends[1] - ends[0]).sum(1).eq(1).all()
    everywhere = [pack_keys(torch.div(torch.cat(ends), 16, rounding_mode="floor")).unique()] * len(frames)
    found = [agreement.averages_at(end, frames, everywhere, VOXEL, MULTIPLE * VOXEL) for end in ends]
    before, after = (one.near_sum / one.near for one in found)
    crosses = before * after < 0
    assert float(crosses.float().mean()) > 0.99, "all but those whose nearest pixel is a matter of rounding"
    fraction = (before / (before - after))[:, None]
    expected = VOXEL * (ends[0] + fraction * (ends[1] - ends[0]))
    apart = (expected - points).norm(dim=1)[crosses]
    assert float((apart < 1e-3 * VOXEL).float().mean()) > 0.99


@pytest.mark.open3d
def test_every_difference_to_open3d_has_a_known_cause(benchmark, frames) -> None:
    """Where both average the same readings, both have the same point."""
    pytest.importorskip("open3d")
    agreement, peer = benchmark("fusion_agreement"), benchmark("fusion_peer")
    views = [peer.Open3DView.of(frame) for frame in frames]
    grid = peer.Open3DGrid(VOXEL, MULTIPLE, peer.room_for(views, VOXEL, MULTIPLE))
    volume = TSDFVolume(voxel_size=VOXEL, carve="never")
    for frame, view in zip(frames, views, strict=True):
        grid.integrate(view)
        volume.integrate(frame)
    points = volume.extract_points().points
    row = agreement.edges_by_cause(points, peer.positions(grid.extract()), grid, frames, views)
    assert row["predicted"] > 0.999, "all that Open3D stores follows from the images"
    assert row["free, share"] + row["missed, share"] + row["same, share"] == pytest.approx(1)
    assert row["same, share"] > 0.5
    assert row["same, Open3D crosses"] > 0.99
    assert row["same, mm"] < 0.01
    assert row["free, mm"] > 1.0


@pytest.mark.open3d
@pytest.mark.parametrize("carve", ["near", "everywhere"])
def test_carving_gives_the_surface_of_open3d(benchmark, frames, carve) -> None:
    """Like with like: both count free space, up to which voxels it is counted in."""
    pytest.importorskip("open3d")
    agreement, peer = benchmark("fusion_agreement"), benchmark("fusion_peer")
    theirs = peer.open3d_surface(frames, VOXEL)
    volume = TSDFVolume(voxel_size=VOXEL, carve=carve)
    for frame in frames:
        volume.integrate(frame)
    row = agreement.surfaces_apart(volume.extract_points().points, theirs, VOXEL)
    assert max(row["ours to theirs, mm"], row["theirs to ours, mm"]) < 1000 * VOXEL / 4
