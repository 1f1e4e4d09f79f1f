"""The laws that every registered transform keeps, for every example of it."""

from __future__ import annotations

import copy
import dataclasses
import json
import pickle
from typing import Any

import pytest
import torch

from pcdata import transforms as T
from pcdata.errors import ConfigError, DTypeError, FrameError, PcdataError, UnitError
from pcdata.rng import seeded
from pcdata.structures import METRE, NORMALIZED, DepthFrame, PointCloud
from pcdata.transforms.field_checks import field_names, length_fields
from tests.factories import assert_same, cloud_in_base, differences, frame_with_counts, torch_defaults, tree
from tests.messages import told
from tests.transforms.examples import ALL, EXAMPLES, NAMES, Example

COUNTS = (120, 90, 150)
each_example = pytest.mark.parametrize("example", ALL, ids=NAMES)


def run(example: Example, data: Any, seed: int = 0) -> Any:
    """Run the step, with a generator only where it is random."""
    return example.transform(data, generator=seeded(seed) if example.transform.is_random else None)


def outcome(example: Example, data: Any, generator: Any) -> Any:
    """What comes out, or the typed error."""
    try:
        return example.transform(data, generator=generator if example.transform.is_random else None)
    except PcdataError as error:
        return type(error)


def only_some(examples: list[Example], names: list[str], wanted) -> Any:
    """Parametrize over the examples whose transform has a property."""
    pairs = [(example, name) for example, name in zip(examples, names) if wanted(example.transform)]
    return pytest.mark.parametrize("example", [pair[0] for pair in pairs], ids=[pair[1] for pair in pairs])


each_on_clouds = only_some(ALL, NAMES, lambda t: t.takes is PointCloud)
each_random = only_some(ALL, NAMES, lambda t: t.is_random)
each_fixed = only_some(ALL, NAMES, lambda t: not t.is_random)
each_spatial = only_some(ALL, NAMES, lambda t: isinstance(t, T.SpatialTransform))
each_select = only_some(ALL, NAMES, lambda t: isinstance(t, T.SelectTransform))
each_in_metres = only_some(ALL, NAMES, lambda t: t.takes is PointCloud and t.unit_needed() == METRE)
each_in_a_frame = only_some(ALL, NAMES, lambda t: t.frame_needed() is not None)


def test_every_registered_transform_has_an_example():
    assert {name for name, cls in T.REGISTRY.items() if cls.__module__.startswith("pcdata.")} == set(EXAMPLES)
    for name, examples in EXAMPLES.items():
        assert examples
        assert all(type(example.transform) is T.REGISTRY[name] for example in examples)


@each_example
def test_it_does_something_on_its_example(example):
    data = example.make(COUNTS)
    results = [run(example, data, seed) for seed in range(5)]
    watched = ("depth", "confidence", "points", "colors", "normals", "labels", "meta", "extra")

    def looked_at(value: Any) -> dict[str, Any]:
        return {name: part for name, part in tree(value).items() if name in watched}

    seen, before = [looked_at(result) for result in results], looked_at(data)
    assert any(differences(before, after) for after in seen)


@each_example
def test_the_input_stays_as_it_was(example):
    data = example.make(COUNTS)
    before = tree(data)
    result = run(example, data)
    assert result is not data
    assert not differences(before, tree(data))


@each_example
def test_the_result_shares_no_mutable_record_with_the_input(example):
    data = example.make(COUNTS)
    if isinstance(data, DepthFrame):
        assert run(example, data).provenance is not data.provenance if example.transform.gives is DepthFrame else True
        return
    result = run(example, data)
    assert result.history is not data.history


@each_example
def test_the_same_generator_gives_the_same_bits(example):
    assert_same(run(example, example.make(COUNTS), 7), run(example, example.make(COUNTS), 7))


@each_random
def test_other_seeds_decide_otherwise(example):
    data = example.make(COUNTS)
    first = tree(run(example, data, 0))
    assert any(differences(first, tree(run(example, data, seed))) for seed in range(1, 6))


@each_random
def test_a_random_step_refuses_to_run_without_a_generator(example):
    with pytest.raises(ConfigError, match=r"is random and needs generator"):
        example.transform(example.make(COUNTS))


@each_random
def test_a_random_step_refuses_what_is_no_generator(example):
    with pytest.raises(DTypeError, match=r"generator must be a torch\.Generator"):
        example.transform(example.make(COUNTS), generator=5)


@each_random
def test_a_random_step_refuses_too_many_or_too_few_generators(example):
    data = example.make(COUNTS)
    streams = 3 if isinstance(data, PointCloud) else 1  # a capture is one sample, however many views it has
    for count in (2, 4):
        with pytest.raises(PcdataError, match=f"{count} generators were given for {streams} clouds"):
            example.transform(data, generator=[seeded(b) for b in range(count)])


@each_fixed
def test_a_fixed_step_never_touches_the_generator(example):
    generator = seeded(3)
    before = generator.get_state()
    with_one = example.transform(example.make(COUNTS), generator=generator)
    assert torch.equal(generator.get_state(), before)
    assert_same(with_one, example.transform(example.make(COUNTS), generator=None))


@each_example
def test_the_global_generator_is_never_touched(example):
    before = torch.get_rng_state()
    run(example, example.make(COUNTS))
    assert torch.equal(torch.get_rng_state(), before)


@each_on_clouds
def test_a_batch_equals_its_clouds_one_after_another(example):
    data = example.make(COUNTS)
    generator = seeded(1)
    batch = outcome(example, data, generator)
    generator = seeded(1)
    singles = [outcome(example, cloud, generator) for cloud in data.unbatch()]
    assert_same(batch, PointCloud.cat(singles))


@each_on_clouds
@pytest.mark.parametrize("counts", [COUNTS, (30, 0, 40), (1, 1, 1), (1, 60)], ids=str)
def test_a_batch_with_a_generator_per_cloud_equals_its_clouds(example, counts):
    data = example.make(counts)
    batch = outcome(example, data, [seeded(b) for b in range(len(counts))])
    singles = [outcome(example, cloud, [seeded(b)]) for b, cloud in enumerate(data.unbatch())]
    errors = [single for single in singles if isinstance(single, type)]
    if errors:
        assert batch is errors[0]
    else:
        assert_same(batch, PointCloud.cat(singles))


@each_on_clouds
def test_every_field_of_every_kind_survives(example):
    data = example.make(COUNTS)
    result = run(example, data)
    assert set(data.fields()) <= set(result.fields())
    for name, value in data.fields().items():
        assert result.kind(name) is data.kind(name)
        assert result.fields()[name].dtype == value.dtype
        assert result.fields()[name].shape[1:] == value.shape[1:]


def real_rows(data: PointCloud, result: PointCloud) -> tuple[torch.Tensor, torch.Tensor]:
    """The rows of the result that are not zero filling, and the row of the input that each comes from."""
    assert result.source_index is not None
    real = torch.nonzero(result.source_index >= 0).squeeze(1)
    return real, result.extra["row"][real]


@each_on_clouds
def test_rows_stay_together(example):
    data = example.make(COUNTS)
    result = run(example, data)
    real, origin = real_rows(data, result)
    assert torch.equal(result.source_index[real], data.source_index[origin])
    anchored = (result.extra["anchor"] - result.points)[real].norm(dim=1) / scale_of(result)[real]
    assert float(anchored.max()) <= example.displacement + 1e-6
    if example.displacement == 0:
        assert torch.equal(result.extra["weight"][real], data.extra["weight"][origin])


def scale_of(cloud: PointCloud) -> torch.Tensor:
    """(N,) how many of the cloud's units a metre of its source is, for lengths of normalized clouds."""
    scale = torch.linalg.det(cloud.source_from_cloud[:, :3, :3]).abs() ** (-1 / 3)
    return torch.repeat_interleave(scale, cloud.counts)


@each_spatial
def test_spatial_steps_keep_every_row_in_its_place(example):
    data = example.make(COUNTS)
    result = run(example, data)
    assert torch.equal(result.ptr, data.ptr)
    for name in ("colors", "labels", "source_index", "row", "weight"):
        assert torch.equal(result.fields()[name], data.fields()[name])
    assert torch.equal(result.extra["anchor"], result.points)
    assert torch.equal(result.extra["heading"], result.normals)
    assert float((result.normals.norm(dim=1) - 1).abs().max()) < 1e-6


@each_select
def test_select_steps_keep_every_field_bit_for_bit(example):
    data = example.make(COUNTS)
    result = run(example, data)
    real, origin = real_rows(data, result)
    for name, value in data.fields().items():
        assert torch.equal(result.fields()[name][real], value[origin]), name
    owner = torch.repeat_interleave(torch.arange(data.num_clouds), data.counts)
    kept = torch.repeat_interleave(torch.arange(result.num_clouds), result.counts)
    assert torch.equal(owner[origin], kept[real])
    assert torch.equal(result.source_from_cloud, data.source_from_cloud)


@each_on_clouds
def test_the_way_back_leads_to_the_source(example):
    data = example.make(COUNTS)
    result = run(example, data)
    real, origin = real_rows(data, result)
    source = data.in_source_frame() if result.source_frame == data.source_frame else data
    assert source.frame_id == result.source_frame
    back = result.in_source_frame()
    assert back.frame_id == result.source_frame
    assert back.unit == METRE
    error = (back.points[real] - source.points[origin]).norm(dim=1)
    assert float(error.max()) <= example.displacement + 1e-6


@each_spatial
def test_a_plane_that_was_found_moves_along_and_comes_back(example):
    data = example.make(COUNTS)
    source = data.in_source_frame() if data.frame_id != data.source_frame else data
    corners = [part.points[:3].double() for part in source.unbatch()]
    stored = []
    for a, b, c in corners:
        normal = torch.nn.functional.normalize(torch.linalg.cross(b - a, c - a), dim=0)
        hull = torch.stack([a, b, c]).tolist()
        stored.append({"planes": [{"normal": normal.tolist(), "offset": -float(normal @ a), "hull": hull}]})
    before = data.with_meta(stored)
    result = run(example, before)
    for b, (was, now) in enumerate(zip(before.unbatch(), result.unbatch())):
        old, new = T.planes_in_cloud(before, b)[0], T.planes_in_cloud(result, b)[0]
        scale = float(now.points.abs().max()) + 1
        off = now.points.double() @ new[:3] + new[3]
        assert float(off[:3].abs().max()) < 1e-5 * scale
        side = was.points.double() @ old[:3] + old[3]
        clear = side.abs() > 1e-3 * float(was.points.abs().max())
        assert torch.equal(off[clear] > 0, side[clear] > 0)
        hull, corner = T.plane_hulls_in_cloud(result, b)[0], now.points[:3].double()
        mirrored = bool(torch.linalg.det(result.source_from_cloud[b, :3, :3]) < 0)
        torch.testing.assert_close(hull, corner.flip(0) if mirrored else corner, atol=1e-5 * scale, rtol=0)
        around = torch.linalg.cross(hull[1] - hull[0], hull[2] - hull[0])
        assert float(around @ new[:3]) > 0  # counterclockwise from where the normal points to
        back = T.planes_in_cloud(result.in_source_frame(), b)[0]
        expected = torch.tensor([*stored[b]["planes"][0]["normal"], stored[b]["planes"][0]["offset"]])
        torch.testing.assert_close(back, expected.double(), atol=1e-6, rtol=0)


def round_trips(transform: T.Transform) -> dict[str, T.Transform]:
    """The same transform through every way it can be written down."""
    chain = T.Compose([transform])
    from_config, from_yaml = T.Compose.from_config([transform.to_config()]), T.Compose.from_yaml(chain.to_yaml())
    if not isinstance(transform, T.Compose):  # which is opened: it is its steps
        (from_config,), (from_yaml,) = from_config.steps, from_yaml.steps
    ((name, fields),) = json.loads(json.dumps(transform.to_config(), allow_nan=False)).items()
    ways = {"config": from_config, "yaml": from_yaml, "deepcopy": copy.deepcopy(transform)}
    ways["pickle"] = pickle.loads(pickle.dumps(transform))
    if not list(transform.children()):
        ways["json"] = T.REGISTRY[name](**fields)
    return ways


@each_example
@pytest.mark.filterwarnings("ignore::pcdata.transforms.PipelineOrderWarning")
def test_written_down_and_read_back_it_is_the_same(example):
    expected = tree(run(example, example.make(COUNTS)))
    for way, twin in round_trips(example.transform).items():
        assert twin.fingerprint() == example.transform.fingerprint(), way
        assert twin.to_config() == example.transform.to_config(), way
        assert repr(twin) == repr(example.transform), way
        again = run(dataclasses.replace(example, transform=twin), example.make(COUNTS))
        assert not differences(expected, tree(again)), way


def changed_values(value: Any) -> list[Any]:
    """Values unlike the given one; some will not be valid."""
    if isinstance(value, bool):
        return [not value]
    if isinstance(value, (int, float)):
        return [value + 1, value / 2, value * 0.9, 0.3]
    if isinstance(value, str):
        return [
            f"{value}x",
            "camera",
            "all",
            "above",
            "none",
            "centroid",
            "keep",
            "kinect_v1",
            "hallucinated",
            "nearest",
            "mean",
            "angle",
            "floor",
            "never",
            "normalized",
            "planarity",
            "inside",
            "outside",
            "largest",
            "slab",
            "warn",
            "y",
            "equidistant",
            "image",
        ]
    if isinstance(value, T.Transform):
        return [T.Center()]
    if value is None:
        return [0.7, 3, "base", (0.0, 0.0, 1.0), "reliable"]
    if isinstance(value, dict):
        return [{**value, "colors": "first"}, {**value, "colors": "max"}]
    items = list(value)
    if not items or isinstance(items[0], T.Transform):
        return [[*items, 1], [*items, T.Center()], [*items, T.RandomFlip()]]
    return [[*items[:i], new, *items[i + 1 :]] for i, item in enumerate(items) for new in changed_values(item)]


@pytest.mark.parametrize("name", EXAMPLES)
def test_every_field_is_part_of_the_fingerprint(name):
    cls = T.REGISTRY[name]
    untested = set(field_names(cls))
    for example in EXAMPLES[name]:
        fields = example.transform.config_fields()
        for field, value in fields.items():
            for changed in changed_values(value):
                try:
                    other = cls(**{**fields, field: changed})
                except PcdataError:
                    continue
                if other.to_config() == example.transform.to_config():
                    continue
                assert other.fingerprint() != example.transform.fingerprint(), (field, changed)
                untested.discard(field)
    assert not untested


def test_the_fingerprint_tells_all_examples_apart():
    assert len({example.transform.fingerprint() for example in ALL}) == len(ALL)


@each_example
@pytest.mark.parametrize("version", [99])
def test_the_version_is_part_of_the_fingerprint(example, version, monkeypatch):
    before = example.transform.fingerprint()
    monkeypatch.setattr(type(example.transform), "version", version)
    assert example.transform.fingerprint() != before


@each_example
@pytest.mark.parametrize("counts", [(0,), (1,), (2,), (0, 0), (40, 0, 50), (0, 40, 1)], ids=str)
def test_empty_clouds_and_single_points_pass_or_raise_a_typed_error(example, counts):
    try:
        result = run(example, example.make(counts))
    except PcdataError as error:
        assert str(error)  # noqa: PT017 - passing is fine too
        return
    if isinstance(result, PointCloud):
        assert int(result.ptr[-1]) == result.num_points


@each_example
def test_the_history_gains_the_step(example):
    data = example.make(COUNTS)
    result = run(example, data)
    if isinstance(result, DepthFrame):
        histories = [(list(data.provenance.get("history", ())), result.provenance["history"])]
    elif isinstance(data, DepthFrame):
        histories = [([], list(steps)) for steps in result.history]
    else:
        histories = [(list(data.history[0]), list(steps)) for steps in result.history]
        if example.transform.keeps_clouds:
            histories = [(list(old), list(new)) for old, new in zip(data.history, result.history)]
    for old, new in histories:
        assert [step["step"] for step in new[: len(old)]] == [step["step"] for step in old]
        assert len(new) > len(old)
        if not list(example.transform.children()):
            (entry,) = new[len(old) :]
            assert entry["step"] == type(example.transform).__name__
            assert {entry["step"]: entry["fields"]} == example.transform.to_config()
        json.dumps(new, allow_nan=False)


@each_on_clouds
def test_the_history_counts_the_points(example):
    result = run(example, example.make(COUNTS))
    assert [steps[-1]["points"] for steps in result.history] == result.counts.tolist()


@each_example
def test_what_was_found_is_plain_data(example):
    result = run(example, example.make(COUNTS))
    plain = list(result.meta) if isinstance(result, PointCloud) else dict(result.provenance)
    assert json.loads(json.dumps(plain, allow_nan=False)) == plain


@each_example
def test_the_result_is_what_the_class_promises(example):
    transform, data = example.transform, example.make(COUNTS)
    result = run(example, data)
    assert isinstance(data, transform.takes)
    assert isinstance(result, transform.gives)
    if isinstance(result, PointCloud):
        frame = data.frame_id if isinstance(data, PointCloud) else None
        unit = data.unit if isinstance(data, PointCloud) else METRE
        assert result.frame_id == transform.frame_after(frame)
        assert result.unit == (transform.unit_given() or unit)
        assert result.points.dtype == torch.float32
        assert result.source_from_cloud.dtype == torch.float64
        assert bool(torch.isfinite(result.points).all())


@each_example
def test_the_wrong_kind_of_data_is_refused(example):
    wrong = cloud_in_base(COUNTS) if example.transform.takes is DepthFrame else frame_with_counts()
    with pytest.raises(DTypeError, match=r"takes a (PointCloud|DepthFrame), got "):
        run(example, wrong)
    with pytest.raises(DTypeError, match="takes a"):
        run(example, torch.zeros(4, 3))


@each_in_metres
def test_steps_in_metres_refuse_a_normalized_cloud(example):
    data = dataclasses.replace(example.make(COUNTS), unit=NORMALIZED)
    with pytest.raises(UnitError, match="lengths in metres but the cloud is normalized"):
        run(example, data)
    with pytest.raises(ConfigError, match="works in metres but the cloud is normalized there"):
        T.Compose([T.NormalizeUnitSphere(), example.transform])


@each_in_a_frame
def test_steps_in_a_frame_refuse_another(example):
    data = dataclasses.replace(example.make(COUNTS), frame_id="elsewhere")
    with pytest.raises(FrameError, match=f"given in frame '{example.transform.frame_needed()}' but .* 'elsewhere'"):
        run(example, data)
    with pytest.raises(ConfigError, match=r"works in frame .* but the cloud is in 'elsewhere' there"):
        T.Compose([T.ToFrame(frame="elsewhere"), example.transform])


@each_example
def test_it_runs_in_inference_mode(example):
    expected = tree(run(example, example.make(COUNTS)))
    data = example.make(COUNTS)
    with torch.inference_mode():
        assert not differences(expected, tree(run(example, data)))
        assert not differences(expected, tree(run(example, example.make(COUNTS))))


@each_example
@pytest.mark.parametrize("defaults", [{"dtype": torch.float64}, {"dtype": torch.float16}, {"device": "meta"}], ids=str)
def test_torchs_defaults_change_no_bit(example, defaults):
    data = example.make(COUNTS)
    expected = tree(run(example, data, 3))
    with torch_defaults(**defaults):
        again = dataclasses.replace(example, transform=copy.copy(example.transform))
        if not list(example.transform.children()):
            again = dataclasses.replace(example, transform=type(example.transform)(**example.transform.config_fields()))
        found = tree(run(again, data, 3))
    assert not differences(expected, found)


def strided(value: torch.Tensor) -> torch.Tensor:
    """The same values column by column, as (K^-1 @ pixels).T and Fortran arrays are."""
    return value.transpose(-1, -2).contiguous().transpose(-1, -2) if value.ndim > 1 else value.repeat(2, 1).T[:, 0]


@each_example
def test_the_order_of_the_memory_changes_no_bit(example):
    data = example.make(COUNTS)
    if isinstance(data, PointCloud):
        same = data.with_fields(**{name: strided(value) for name, value in data.fields().items()})
        same = dataclasses.replace(same, layout=data.layout)
        assert not same.points.is_contiguous()
    else:
        same = dataclasses.replace(
            data, depth=strided(data.depth), labels=strided(data.labels) if data.labels is not None else None
        )
    assert not differences(tree(run(example, data, 3)), tree(run(example, same, 3)))


@each_on_clouds
def test_points_that_require_a_gradient_come_to_the_same_result(example):
    data = example.make(COUNTS)
    leaf = data.points.clone().requires_grad_()
    asked = dataclasses.replace(data.with_fields(points=leaf), layout=data.layout)
    assert not differences(tree(run(example, data, 3)), tree(run(example, asked, 3)), tolerance=2e-6)


@each_example
def test_an_error_says_in_which_step_it_happened(example):
    with pytest.raises(DTypeError) as caught:
        run(example, torch.zeros(2, 3))
    assert "in " in told(caught.value)


@each_example
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device to compare the CPU with")
def test_cuda_agrees_with_the_cpu(example):
    data = example.make(COUNTS)
    on_cpu, on_gpu = run(example, data), run(example, data.to("cuda"))
    assert on_gpu.device.type == "cuda"
    assert_same(on_cpu, on_gpu.to("cpu"), tolerance=2e-6)


def test_every_length_in_metres_makes_its_step_refuse_normalized_clouds():
    with_lengths = {name for name, cls in T.REGISTRY.items() if length_fields(cls) and cls.takes is PointCloud}
    assert {"ClusterObjects", "EstimateNormals", "RandomColumn", "RemovePlane", "VoxelDownsample"} <= with_lengths
    for name in with_lengths:
        assert any(example.transform.unit_needed() == METRE for example in EXAMPLES[name]), name


@pytest.mark.parametrize("step", [T.VoxelDownsample, T.VoxelSample, T.RandomVoxelSample])
def test_a_voxel_size_works_in_the_unit_that_it_is_given_in(step):
    cloud = cloud_in_base(COUNTS)
    sphere = T.NormalizeUnitSphere()
    with pytest.raises(UnitError, match=r"lengths in metres but the cloud is normalized; .* or say unit: normalized"):
        step(voxel_size=0.1)(sphere(cloud), generator=seeded(0))
    with pytest.raises(ConfigError, match=r"works in metres but the cloud is normalized there; .*unit: normalized"):
        T.Compose([sphere, step(voxel_size=0.1)])
    with pytest.raises(UnitError, match=r"the unit of normalized clouds but the cloud is in metres; put it after"):
        step(voxel_size=0.1, unit="normalized")(cloud, generator=seeded(0))
    with pytest.raises(ConfigError, match=r"works on normalized clouds but the cloud is in metres there"):
        T.Compose([T.RemovePlane(), step(voxel_size=0.1, unit="normalized")])
    followed = T.Compose([sphere, step(voxel_size=0.1, unit="normalized"), T.RandomJitter()])
    assert 0 < followed(cloud, generator=seeded(0)).num_points < cloud.num_points
    random_suffix = T.Compose([step(voxel_size=0.1, unit="normalized"), T.RandomJitter()])
    assert random_suffix(sphere(cloud), generator=seeded(0)).unit == NORMALIZED
