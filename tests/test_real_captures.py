"""The main job on real captures, end to end."""

from __future__ import annotations

from pathlib import Path

import pytest
from torch.utils.data import DataLoader

from pcdata import CachedCloudDataset, RemovePlane, build_dataset, collate_padded, load_config, open_source, read_pcd

CONFIG = Path(__file__).parents[1] / "configs" / "tabletop_policy.yaml"
OSD = [f"learn{number}" for number in (0, 8, 16, 17, 20, 24, 25, 28, 32, 33, 38, 44)]


@pytest.mark.parametrize("scene", OSD)
def test_the_table_is_found_in_every_labeled_scene(test_data: Path, scene: str) -> None:
    cloud = read_pcd(test_data / "osd" / f"{scene}.pcd")
    assert cloud.labels is not None
    is_table = cloud.labels // 10 == 0
    left = RemovePlane(distance=0.01)(cloud)
    removed = cloud.num_points - left.num_points
    table_left = int((left.labels // 10 == 0).sum())
    found = int(is_table.sum()) - table_left
    assert found / int(is_table.sum()) >= 0.97, "recall"
    assert found / removed >= 0.97, "precision"


@pytest.mark.parametrize(("name", "limit"), [("graspnet_frame", None), ("osd", 3), ("seven_scenes", 3)])
def test_one_configuration_turns_every_kind_of_capture_into_batches(
    test_data: Path, tmp_path: Path, name: str, limit: int | None
) -> None:
    source = open_source(test_data / name, limit=limit)
    build_dataset(load_config(CONFIG), source, tmp_path / "dataset")
    dataset = CachedCloudDataset(tmp_path / "dataset")
    loader = DataLoader(dataset, batch_size=2, num_workers=2, collate_fn=collate_padded)
    seen = 0
    for batch in loader:
        counts = batch.mask.sum(1)
        assert bool(((counts >= 900) & (counts <= 1024)).all()), "1024 points less a dropout of 5 to 10 %"
        assert batch.unit == "normalized"
        assert float(batch.points.norm(dim=-1).max()) < 1.05
        assert batch.normals is not None
        assert bool(((batch.normals.norm(dim=-1) - 1).abs() < 1e-3)[batch.mask].all())
        seen += len(counts)
    assert seen == len(source)
