"""What was decided is repeated: on the same data bit for bit, on others of the capture where it can be carried over."""

from __future__ import annotations

import dataclasses
import itertools
import json
from typing import Any

import pytest
import torch

from pcdata import transforms as T
from pcdata.build import build_dataset, config_from_yaml
from pcdata.datasets import CachedCloudDataset, collate_packed
from pcdata.errors import PcdataError, ReplayError
from pcdata.geometry import rigid
from pcdata.rng import seeded
from pcdata.structures import DepthFrame, PointCloud
from pcdata.synthetic import SyntheticSource
from pcdata.yaml_nodes import yaml_text
from tests.factories import assert_same, cloud_in_base, cloud_in_camera, frame_with_counts, tabletop_frame
from tests.transforms.examples import ALL, NAMES
from tests.transforms.test_contract import COUNTS, each_example, each_on_clouds, each_spatial, only_some, run

each_about_rows = only_some(
    ALL, NAMES, lambda t: isinstance(t, T.SelectTransform | T.RandomJitter) and t.decides_by != "point"
)
each_about_points = only_some(ALL, NAMES, lambda t: isinstance(t, T.SelectTransform) and t.decides_by == "point")


def told(result: PointCloud | DepthFrame) -> Any:
    """Its history, as a file of JSON gives it back."""
    history = list(result.history) if isinstance(result, PointCloud) else result.provenance["history"]
    return json.loads(json.dumps(history, allow_nan=False))


# -- laws of every step ------------------------------------------------------------------------------------------------


@each_example
@pytest.mark.filterwarnings("ignore::pcdata.transforms.PipelineOrderWarning")
def test_a_chain_from_yaml_gives_the_same_bits_and_the_same_history_again(example):
    chain = T.Compose.from_yaml(T.Compose([example.transform]).to_yaml())
    data = example.make(COUNTS)
    result = run(example, data, seed=3)
    assert_same(chain.replay(data, told(result)), result)


@each_on_clouds
def test_a_ragged_batch_is_repeated_as_its_clouds_are(example):
    data = example.make((120, 60))
    try:
        result = run(example, data, seed=5)
    except PcdataError:
        pytest.skip("this step refuses small clouds")
    histories = told(result)
    batch = example.transform.replay(data, histories)
    if not example.transform.keeps_clouds:
        assert_same(batch, result)
        return
    singles = [example.transform.replay(cloud, one) for cloud, one in zip(data, histories, strict=True)]
    assert_same(batch, PointCloud.cat(singles))


@each_spatial
def test_motions_are_the_same_for_another_cloud(example):
    data, other = example.make(COUNTS), example.make((40, 70, 50))
    other = dataclasses.replace(other, source_from_cloud=data.source_from_cloud, frames=data.frames)
    result = run(example, data, seed=6)
    moved = example.transform.replay(other, told(result))
    matrix = torch.linalg.inv(result.source_from_cloud) @ data.source_from_cloud
    expected = other.transformed(matrix, frame_id=result.frame_id, unit=result.unit)
    assert torch.allclose(moved.points, expected.points, rtol=0, atol=1e-5)
    assert torch.allclose(moved.source_from_cloud, result.source_from_cloud, rtol=0, atol=1e-12)


@each_about_rows
def test_a_choice_among_rows_is_refused_for_other_rows(example):
    result = run(example, example.make(COUNTS), seed=7)
    with pytest.raises(ReplayError, match=rf"^{type(example.transform).__name__}: .*was about its rows.*leave it out"):
        example.transform.replay(example.make((119, 91, 149)), told(result))


@each_about_points
def test_a_region_is_the_same_for_another_cloud(example):
    data = example.make(COUNTS)
    result = run(example, data, seed=8)
    # Every second point: what stays of them is what stays of all.
    index = torch.cat([torch.arange(start, stop, 2) for start, stop in itertools.pairwise(data.ptr.tolist())])
    half = data.select(index, torch.tensor([0, *itertools.accumulate((count + 1) // 2 for count in COUNTS)]))
    if isinstance(example.transform, T.RemovePlane) and example.transform.keep == "over":
        with pytest.raises(ReplayError, match=r"RemovePlane: .*about its rows"):
            example.transform.replay(half, told(result))
        return
    kept = set(result.extra["row"].tolist())
    try:
        found = example.transform.replay(half, told(result))
    except PcdataError:
        found = None
    expected = [row for row in half.extra["row"].tolist() if row in kept]
    assert (found.extra["row"].tolist() if found is not None else expected) == expected


# -- chains ------------------------------------------------------------------------------------------------------------

CHAIN = [
    T.MaskDepth(near=0.1),
    T.Deproject(),
    T.ToFrame(frame="base"),
    T.MergeViews(),
    T.RemovePlane(distance=0.005),
    T.RandomApply(step=T.Compose([T.RandomFlip(about="centroid"), T.RandomPointDropout()]), probability=0.7),
    T.RandomRotation(about="centroid"),
    T.RandomScale(),
    T.RandomJitter(),
    T.RandomSample(num_points=256),
    T.NormalizeUnitSphere(),
]


def test_a_chain_from_images_repeats_all_its_steps():
    chain, frame = T.Compose(CHAIN), tabletop_frame(2)
    for seed in range(4):
        result = chain(frame, generator=seeded(seed))
        assert_same(chain.replay(frame, told(result)), result)
        assert_same(chain.replay(frame, told(result)[0]), result)


def test_views_that_are_not_merged_have_a_history_each():
    chain, frame = T.Compose([T.Deproject(), T.RandomRotation(), T.RandomSample(num_points=50)]), tabletop_frame(2)
    result = chain(frame, generator=seeded(1))
    assert_same(chain.replay(frame, told(result)), result)
    with pytest.raises(ReplayError, match="RandomRotation: the histories tell of 1 clouds and there are 2"):
        chain.replay(frame, told(result)[:1])


def test_what_was_drawn_for_each_view_is_found_in_the_merged_history():
    steps = [
        T.Deproject(),
        T.RandomPointDropout(),
        T.ToFrame(frame="base"),
        T.RandomJitter(),
        T.MergeViews(),
        T.Center(),
    ]
    chain, frame = T.Compose(steps), tabletop_frame(2)
    result = chain(frame, generator=seeded(2))
    assert_same(chain.replay(frame, told(result)), result)


def test_views_that_went_different_ways_are_refused_where_their_history_is_lost():
    steps = [T.Deproject(), T.RandomApply(step=T.RandomPointDropout()), T.ToFrame(frame="base"), T.MergeViews()]
    chain, frame = T.Compose(steps), tabletop_frame(2)
    outcomes = set()
    for seed in range(8):
        result = chain(frame, generator=seeded(seed))
        try:
            assert_same(chain.replay(frame, told(result)), result)
            outcomes.add("same")
        except ReplayError as error:
            assert "of view 0 alone" in str(error)  # noqa: PT017 - the other outcome is fine too
            outcomes.add("refused")
    assert outcomes == {"same", "refused"}


def test_objects_are_split_as_they_were():
    chain = T.Compose([T.ClusterObjects(eps=0.03, min_points=4, min_size=5), T.SplitObjects(), T.RandomRotation()])
    scenes = cloud_in_base((200, 240))
    result = chain(scenes, generator=seeded(0))
    assert result.num_clouds > 2
    assert_same(chain.replay(scenes, told(result)), result)
    one = chain.replay(scenes[0], told(result)[1])  # the second object of the first scene
    assert_same(one, result[1])


def test_a_cloud_enters_where_a_cloud_is_taken():
    chain = T.Compose([T.MaskDepth(near=0.1), T.Deproject(), T.RandomRotation()])
    result = chain(cloud_in_camera(), generator=seeded(0))
    assert_same(chain.replay(cloud_in_camera(), told(result)), result)


# -- stored samples and workers --------------------------------------------------------------------------------------


def test_what_a_loaders_workers_did_is_repeated_from_the_history_of_each_sample(tmp_path):
    source = SyntheticSource(num_scenes=3, num_views=1, size=(24, 32))
    steps = [T.Deproject(), T.ToFrame(frame="base"), T.FarthestPointSample(num_points=64)]
    random = [T.RandomRotation(), T.RandomScale(), T.RandomJitter(), T.RandomPointDropout()]
    chain = T.Compose([*steps, *random])
    config = yaml_text({**chain.sections(), "output": {"format": "packed"}})
    build_dataset(config_from_yaml(config), source, tmp_path / "set")
    dataset = CachedCloudDataset(tmp_path / "set", seed=1)
    loader = torch.utils.data.DataLoader(dataset, batch_size=3, num_workers=1, collate_fn=collate_packed)
    batch = next(iter(loader))
    plain = PointCloud.cat([CachedCloudDataset(tmp_path / "set", augment=None)[i] for i in range(3)])
    assert_same(T.Compose(random).replay(plain, told(batch)), batch)
    for sample in batch:
        assert torch.equal(chain.replay(source.load(sample.meta[0]["sample_id"]), told(sample)).points, sample.points)


# -- a second modality -----------------------------------------------------------------------------------------------


def test_another_cameras_cloud_moves_as_the_first_one_did():
    motions = [T.RandomRotation(about="centroid"), T.RandomScale(), T.RandomTranslation(), T.NormalizeUnitSphere()]
    chain = T.Compose([T.Deproject(), T.ToFrame(frame="base"), *motions])
    scene = tabletop_frame(2)
    first = chain(scene.view(0), generator=seeded(5))
    second = chain.replay(scene.view(1), told(first))
    in_base = T.Compose([T.Deproject(), T.ToFrame(frame="base")])
    pairs = zip((first, second), (in_base(scene.view(0)), in_base(scene.view(1))), strict=True)
    motions_found = [torch.linalg.inv(moved.frame_from_cloud("base")) for moved, _ in pairs]
    assert torch.allclose(*motions_found, rtol=0, atol=1e-12)


def test_the_plane_of_the_first_camera_is_removed_from_the_second_ones_cloud():
    chain = T.Compose([T.Deproject(), T.ToFrame(frame="base"), T.RemovePlane(distance=0.005)])
    scene = tabletop_frame(2)
    first = chain(scene.view(0))
    second = chain.replay(scene.view(1), told(first))
    assert second.meta[0]["planes"][0]["normal"] != []
    (found,) = T.planes_in_cloud(second)
    (expected,) = T.planes_in_cloud(first)
    assert torch.allclose(found, expected, rtol=0, atol=1e-9)
    distance = (second.points.double() @ found[:3] + found[3]).abs()
    assert float(distance.min()) >= 0.005 - 1e-6


def test_steps_that_chose_rows_are_left_out_for_another_cloud():
    steps = [T.RandomRotation(), T.RandomJitter(), T.RandomSample(num_points=30), T.RandomScale()]
    first, other = cloud_in_base((100,)), cloud_in_base((60,), seed=9)
    result = T.Compose(steps)(first, generator=seeded(0))
    with pytest.raises(ReplayError, match=r"^RandomJitter: .*; give data with the same points.*leave it out"):
        T.Compose(steps).replay(other, told(result))
    moved = T.Compose([steps[0], steps[3]]).replay(other, told(result))
    matrices = [
        torch.tensor(step["params"]["matrix"], dtype=torch.float64)
        for step in told(result)[0]
        if "matrix" in step.get("params", {})
    ]
    expected = other.transformed(matrices[0][None]).transformed(matrices[1][None])
    assert torch.equal(moved.points, expected.points)


def test_the_same_pixels_are_chosen_from_a_cloud_with_other_labels_and_colors():
    cloud = cloud_in_base(COUNTS)
    other = cloud.with_fields(labels=cloud.labels + 5, colors=1 - cloud.colors)
    chain = T.Compose([T.RandomRotation(), T.FarthestPointSample(num_points=20), T.RandomSample(num_points=9)])
    result = chain(cloud, generator=seeded(2))
    again = chain.replay(other, told(result))
    assert torch.equal(again.source_index, result.source_index)
    assert torch.equal(again.points, result.points)
    assert torch.equal(again.labels, result.labels + 5)


def test_an_image_mask_is_turned_and_cut_as_its_capture_was():
    frame = frame_with_counts()
    chain = T.Compose([T.CropCenter(size=(10, 10)), T.RandomTurnDepth(quarter_turns=(1, 2, 3))])
    result = chain(frame, generator=seeded(3))
    mask = torch.zeros_like(frame.mask)
    mask[:, 4, 5] = True
    again = chain.replay(dataclasses.replace(frame, mask=mask), told(result))
    turns = told(result)[-1]["params"]["quarter_turns"]
    assert torch.equal(again.mask, torch.rot90(mask[:, 1:11, 3:13], turns, (1, 2)))
    assert torch.equal(again.depth, result.depth)


def test_a_capture_that_was_turned_goes_the_same_way():
    frame = frame_with_counts((120,))
    chain = T.Compose([T.Deproject(), T.ToFrame(frame="base"), T.RandomRotation(), T.RandomCuboid(low=0.2, high=0.3)])
    result = chain(frame, generator=seeded(4))
    turned = chain.replay(T.TurnDepth()(frame), told(result)[0])
    assert turned.num_points == result.num_points
    order, other = (cloud.points[:, 0].argsort() for cloud in (result, turned))
    assert torch.allclose(result.points[order], turned.points[other], rtol=0, atol=1e-5)


def test_noise_of_pixels_is_refused_for_images_of_another_size():
    step, frame = T.RandomSensorNoise(sensor="realsense_d435"), frame_with_counts()
    result = step(frame, generator=seeded(0))
    assert_same(step.replay(frame, told(result)), result)
    with pytest.raises(ReplayError, match=r"RandomSensorNoise: .*about its rows"):
        step.replay(T.TurnDepth()(frame), told(result))


def test_a_box_of_signals_is_the_one_that_was():
    cloud = cloud_in_base((80, 90))
    lower, upper = torch.full((2, 3), -0.15), torch.full((2, 3), 0.15)
    pose = rigid.from_rotation_translation(
        rigid.rotation_about_axis(torch.tensor([[0.0, 0.0, 1.0]] * 2), torch.tensor([0.3, -0.4])), torch.zeros(2, 3)
    )
    signals = {"lower": (lower, "invariant"), "upper": (upper, "invariant"), "box": (pose, "pose matrix")}
    boxed = cloud
    for name, (values, kind) in signals.items():
        boxed = boxed.with_signal(name, values, kind)
    step = T.CropWorkspace(frame="base", lower="lower", upper="upper", frame_from_box="box")
    result = step(boxed)
    again = step.replay(cloud, told(result))  # which has no such signals
    assert torch.equal(again.points, result.points)
    singles = [
        T.CropWorkspace(frame="base", lower=(-0.15,) * 3, upper=(0.15,) * 3, frame_from_box=pose[b].tolist())(cloud[b])
        for b in range(2)
    ]
    assert torch.equal(result.points, torch.cat([single.points for single in singles]))


# -- refusals ----------------------------------------------------------------------------------------------------------


def test_a_history_of_other_steps_is_refused_with_what_it_has():
    result = T.Compose([T.RandomRotation(), T.Center()])(cloud_in_base(), generator=seeded(0))
    with pytest.raises(ReplayError, match=r"lacks step 1, RandomScale\(\)(.|\n)*RandomRotation\(version 1\)"):
        T.Compose([T.RandomScale(), T.Center()]).replay(cloud_in_base(), told(result))
    with pytest.raises(ReplayError, match="lacks step 1, RandomRotation"):
        T.Compose([T.RandomRotation(degrees=20.0), T.Center()]).replay(cloud_in_base(), told(result))


def test_it_is_not_guessed_which_of_equal_steps_is_meant():
    steps = [T.RandomRotation(), T.RandomJitter(), T.RandomRotation(), T.RandomScale(), T.Center()]
    result = T.Compose(steps)(cloud_in_base(), generator=seeded(0))
    with pytest.raises(ReplayError, match="RandomRotation in several places"):
        T.Compose([steps[0], steps[4]]).replay(cloud_in_base(), told(result))
    last = T.RandomRotation().replay(cloud_in_base(), told(result))
    assert told(last)[0][-1]["params"] == told(result)[0][3]["params"]


def test_coordinates_in_another_frame_or_unit_are_refused():
    step = T.RandomTranslation()
    result = step(cloud_in_base(), generator=seeded(0))
    with pytest.raises(ReplayError, match=r"was in 'base' \[m\] after it and is in 'camera' \[m\]"):
        step.replay(cloud_in_camera(), told(result))
    normalized = dataclasses.replace(cloud_in_base(), unit="normalized")
    with pytest.raises(ReplayError, match=r"is in 'base' \[normalized\]"):
        step.replay(normalized, told(result))


@pytest.mark.parametrize(
    "history",
    [None, "RandomRotation", [], 3, [1, 2], [[]], {"step": "RandomRotation"}, [["a"]], [[{}], [{}], [{}]]],
    ids=str,
)
def test_what_is_no_history_is_refused(history):
    with pytest.raises(ReplayError):
        T.RandomRotation().replay(cloud_in_base(), history)


@pytest.mark.parametrize(
    "params",
    [
        {},
        None,
        {"matrix": "x"},
        {"matrix": [[1.0]]},
        {"matrix": [[0.0] * 4] * 4},
        {"matrix": [[float("nan")] * 4] * 4},
        {"per_view": []},
    ],
    ids=str,
)
def test_damaged_params_are_refused(params):
    result = T.RandomRotation()(cloud_in_base((50,)), generator=seeded(0))
    (history,) = told(result)
    history[-1]["params"] = params
    with pytest.raises(ReplayError, match="RandomRotation"):
        T.RandomRotation().replay(cloud_in_base((50,)), history)


@pytest.mark.parametrize("stream", [None, 2**64, "7", 1.5])
def test_a_damaged_stream_is_refused(stream):
    result = T.RandomSample(num_points=5)(cloud_in_base((50,)), generator=seeded(0))
    (history,) = told(result)
    history[-1]["stream"] = stream
    with pytest.raises(ReplayError, match="RandomSample: is random, and the history does not tell its stream"):
        T.RandomSample(num_points=5).replay(cloud_in_base((50,)), history)


def test_a_step_of_your_own_is_repeated_by_its_draws():
    class OneRow(T.SelectTransform, abstract=True):
        is_random = True

        def pick(self, cloud, streams):
            return cloud.ptr[:-1] + (streams.uniform(0.0, 1.0) * cloud.counts).long(), torch.arange(len(cloud) + 1)

    cloud = cloud_in_base()
    result = OneRow()(cloud, generator=seeded(0))
    assert_same(OneRow().replay(cloud, told(result)), result)


def test_a_forward_of_your_own_is_not_passed_over():
    class Loud(T.SpatialTransform, abstract=True):
        def make_params(self, data, streams):
            return {"matrix": torch.eye(4, dtype=torch.float64).repeat(len(data), 1, 1)}

        def forward(self, data, *, generator=None):
            return super().forward(data, generator=generator)

    result = Loud()(cloud_in_base())
    with pytest.raises(ReplayError, match="has a forward of its own"):
        Loud().replay(cloud_in_base(), told(result))
