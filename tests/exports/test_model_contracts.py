"""An export refuses what ``check`` refuses for its model, rule by rule, but for what the loader itself makes true."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from pcdata.errors import CacheError, ContractError, TooFewPointsError
from pcdata.exports import TARGETS, check_export, export_dataset, model_contracts
from pcdata.exports.export_record import ExportRecord
from pcdata.models import CONTRACTS, check
from pcdata.structures import DepthFrame, PointCloud
from pcdata.synthetic import tabletop
from pcdata.transforms import Deproject
from pcdata.verdicts import Verdict
from tests.exports.samples import Samples, cloud, shape
from tests.exports.scenes import Episodes, scene


def ahead(count: int) -> PointCloud:
    """Points in front of a camera, 0.3 to 0.9 m away."""
    made = cloud(count, frame_id="camera")
    return replace(made, points=0.3 * made.points + torch.tensor([0.0, 0.0, 0.6]))


CLOUDS: dict[str, PointCloud] = {
    "dp3": cloud(512),
    "dexart": cloud(1024),
    "idp3": ahead(10_000),
    "maniflow": cloud(1024),
    "demogen": cloud(1024),
    "diffusion_policy": cloud(512),
    "pointnet": shape(),
    "pointnet_part": shape(),
    "modelnet": shape(1024),
    "pointcept": cloud(500),
}
CHOICES: dict[str, dict[str, Any]] = {
    "dp3": {"frame": "base", "crop": None, "channels": ["xyz", "rgb_255"]},
    "dexart": {"frame": "base", "crop": None},
    "idp3": {"channels": ["xyz", "rgb_255"], "crop": None},
    "maniflow": {"frame": "base", "crop": None, "channels": ["xyz", "rgb"]},
    "diffusion_policy": {"frame": "base", "crop": None, "channels": ["xyz", "rgb_255"]},
    "demogen": {"frame": "base", "crop": None, "channels": ["xyz"]},
    "pointnet": {"num_points": 2048},
    "pointnet_part": {"num_points": 2048, "category": 0},
    "modelnet": {},
    "pointcept": {"channels": ["xyz", "cells", "rgb", "normals"]},
}
BROKEN = {
    "nothing": lambda one: one,
    "unit": lambda one: replace(one, unit="m" if one.unit == "normalized" else "normalized"),
    "millimetres": lambda one: replace(one, points=1000 * one.points),
    "centered elsewhere": lambda one: replace(one, points=one.points + torch.tensor([0.4, 0.8, -0.3])),
    "centered": lambda one: replace(one, points=one.points - one.points.double().mean(dim=0).float()),
    "one point fewer": lambda one: one.select(torch.arange(one.num_points - 1), torch.tensor([0, one.num_points - 1])),
    "NaN": lambda one: replace(one, points=one.points.index_fill(0, torch.tensor([7]), torch.nan)),
    "repeated": lambda one: replace(one, points=one.points[torch.arange(one.num_points) % 40]),
    "normals of length 2": lambda one: replace(one, normals=2 * one.normals),
    "frame": lambda one: replace(one, frame_id="elsewhere"),
}


def export(target: str, sample: Any, folder: Any) -> None:
    """Export one sample with the least of options."""
    options: dict[str, Any] = {}
    if "episodes" in TARGETS[target].__dataclass_fields__:
        robot = {"samples": np.array(["a"]), "state": np.zeros((1, 2)), "action": np.zeros((1, 2))}
        robot |= {"imagin_robot": np.zeros((1, 96, 7))} if target == "dexart" else {}
        options = {"episodes": {"e": robot}}
    if target in ("pointnet", "pointnet_part", "modelnet"):
        options = {"table": {"a": {"class": "mug", "split": "train"}}}
    if target == "modelnet":
        options |= {"num_points": min(sample.num_points, 1024)}
    if target in ("graspnet", "graspnet_scene", "ggcnn"):
        options = {"any_size": True}
    if target == "graspnet_scene":
        options |= {"frames_per_scene": 1, "label_offset": 1, "round_depth": True}
    if target == "graspnet":
        options |= {"label_offset": 1, "round_depth": True}
    if target == "contact_graspnet":
        options = {"label_offset": 1}
    export_dataset(Samples({"a": sample}), target, folder, **options)


def failed(sample: Any, model: str, **choices: Any) -> set[str]:
    """The rules of the model that the sample fails."""
    summary = check(sample, model, **choices)
    return {rule for (rule, _), entry in summary.checks.items() if entry.counts[Verdict.FAIL]}


def failed_in_export(folder: Any, model: str, **choices: Any) -> set[str]:
    """The rules that an export fails, of whose samples nothing is said but the model."""
    summary = check_export(folder, model, **choices)
    assert not any(entry.counts[Verdict.UNKNOWN] for entry in summary.checks.values())
    return {rule for (rule, _), entry in summary.checks.items() if entry.counts[Verdict.FAIL]}


def test_every_target_names_a_contract():
    assert all(target.model in CONTRACTS for target in TARGETS.values())
    assert set(CLOUDS) == {name for name, target in TARGETS.items() if target.takes == "clouds"}


@pytest.mark.parametrize("broken", BROKEN)
@pytest.mark.parametrize("target", CLOUDS)
def test_a_cloud_is_refused_for_the_rules_that_check_fails_and_so_is_an_export(tmp_path, target, broken, monkeypatch):
    sample, kind = BROKEN[broken](CLOUDS[target]), TARGETS[target]
    # The frame is that of the export, which the target takes as it comes where its model leaves it open.
    choices = CHOICES[target] | ({"frame": sample.frame_id} if "frame" in CHOICES[target] else {})
    rules = failed(sample, kind.model, **choices) - kind.left_to_loader
    if not rules:
        export(target, sample, tmp_path / "out")
        assert failed_in_export(tmp_path / "out", kind.model) == set()
        return
    with pytest.raises(ContractError) as caught:
        export(target, sample, tmp_path / "out")
    lines = str(caught.value).splitlines()[1:]
    assert {line.split(":")[0] for line in lines} == rules
    assert f"{target}: sample 'a'" in str(caught.value)
    monkeypatch.setattr(model_contracts, "_require", lambda *_: None)
    export(target, sample, tmp_path / "out")
    assert failed_in_export(tmp_path / "out", kind.model) == rules


def test_every_violation_is_refused_by_some_target():
    for broken, change in BROKEN.items():
        rules = [
            failed(change(CLOUDS[name]), TARGETS[name].model, **CHOICES[name]) - TARGETS[name].left_to_loader
            for name in CLOUDS
        ]
        assert any(rules) == (broken != "nothing")


def capture(**changes: Any) -> DepthFrame:
    return replace(tabletop(1, num_objects=2, size=(120, 160)).frame, **changes)


@pytest.mark.parametrize("target", ["graspnet", "graspnet_scene", "contact_graspnet"])
def test_depth_is_refused_for_the_rules_that_its_cloud_fails(tmp_path, target):
    export(target, capture(), tmp_path / "good")
    sample = capture(depth=40 * capture().depth)
    rules = failed(Deproject()(sample), TARGETS[target].model) - TARGETS[target].left_to_loader
    assert rules == {"scale"}
    with pytest.raises(ContractError, match="scale: "):
        export(target, sample, tmp_path / "bad")
    with pytest.raises(TooFewPointsError, match="no points"):
        export(target, capture(depth=torch.zeros_like(sample.depth)), tmp_path / "empty")


def test_an_image_in_another_unit_is_refused_for_ggcnn(tmp_path):
    export("ggcnn", capture(), tmp_path / "good")
    with pytest.raises(ContractError, match=r"scale: .*clipped"):
        export("ggcnn", capture(depth=40 * capture().depth), tmp_path / "bad")


# -- images, read back ---------------------------------------------------------------------------------------------

IMAGES = [name for name, target in TARGETS.items() if target.takes == "captures"]
SCALED = {"nothing": (1, set()), "millimetres": (40, {"scale"}), "a unit applied twice": (0.002, {"scale"})}


def images(target: str, folder: Any, **changed: Any) -> Any:
    """Export two small captures to a target of images."""
    kind, source = TARGETS[target], Episodes()
    for name, one in source.samples.items():
        source.samples[name] = replace(one, **{key: edit(one) for key, edit in changed.items()})
    asked = {"any_size": True, "round_depth": True, **kind.example(source.ids)}
    known = kind.__dataclass_fields__
    export_dataset(source, target, folder, **{name: value for name, value in asked.items() if name in known})
    return folder


@pytest.mark.parametrize("broken", SCALED)
@pytest.mark.parametrize("target", IMAGES)
def test_depth_in_another_unit_is_found_in_an_export_of_images(tmp_path, target, broken, monkeypatch):
    monkeypatch.setattr(model_contracts, "_require", lambda *_: None)
    times, rules = SCALED[broken]
    images(target, tmp_path / "out", depth=lambda one: one.depth * times)
    relative = TARGETS[target].model == "ggcnn" and times < 1  # of an image less its mean nothing says how far it was
    assert failed_in_export(tmp_path / "out", TARGETS[target].model) == (set() if relative else rules)


@pytest.mark.parametrize("target", IMAGES)
def test_a_part_of_an_export_of_images_is_judged_alone_and_a_damaged_file_is_named(tmp_path, target):
    folder, model = images(target, tmp_path / "out"), TARGETS[target].model
    files = [name for name in ExportRecord.read(folder).files if re.search(r"\.npz$|depth.*\.png$|d\.tiff$", name)]
    assert len(files) == 2
    assert sum(check_export(folder / files[0], model).samples.values()) == 1
    (folder / files[0]).write_bytes(b"nothing")
    with pytest.raises(CacheError, match=re.escape(files[0])):
        check_export(folder, model)


def test_what_an_image_network_gets_of_holes_is_found_in_an_export(tmp_path):
    """Its loader fills in nothing: a NaN makes all of its input NaN, and a 0 is a surface at the lens."""
    for holes, rules in {"inpainted": set(), "nan": {"finite"}, "zero": {"channels"}}.items():
        folder = tmp_path / holes
        one = scene((240, 320), 1)
        holed = replace(one, depth=one.depth.index_fill(1, torch.tensor([9, 120]), 0))
        export_dataset(Samples({"a": holed}), "ggcnn", folder, holes=holes, any_size=True)
        for model in TARGETS["ggcnn"].models():
            assert failed_in_export(folder, model) == rules, holes
        assert failed_in_export(folder, "graspnet_baseline") >= {"channels"}  # images without a camera hold no points
