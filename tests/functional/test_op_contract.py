"""The laws that every registered operation keeps; a new operation joins by an entry in EXAMPLES."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

import pcdata.functional
import pcdata.functional.tsdf  # noqa: F401 - registers operations
from pcdata.contracts.dispatch import BACKEND_MODULES, OPERATIONS, why_unavailable
from pcdata.contracts.numbers import (
    checked_count,
    checked_counts,
    checked_edges,
    checked_fraction,
    checked_image_size,
    checked_length,
    checked_lengths,
    checked_places,
    checked_positive,
    checked_word,
)
from pcdata.contracts.tensors import parse_spec
from pcdata.errors import (
    BackendError,
    ConfigError,
    DeviceError,
    DTypeError,
    NonFiniteError,
    PcdataError,
    ShapeError,
    TooFewPointsError,
)
from pcdata.functional.rows import ptr_from_counts
from pcdata.rng import seeded
from tests.warm import run_python

COUNTS = (60, 25, 90)


def points(count: int, seed: int) -> Tensor:
    """Half of them on a plane, with a few repeats."""
    cloud = torch.rand(count, 3, generator=seeded(seed)) * 0.2
    cloud[::2, 2] = 0.1
    cloud[5::7] = cloud[4:-1:7][: len(cloud[5::7])] if count > 6 else cloud[5::7]
    return cloud


def one_cloud(count: int, seed: int) -> dict[str, Tensor]:
    return {"points": points(count, seed)}


def with_queries(count: int, seed: int) -> dict[str, Tensor]:
    return {"points": points(count, seed), "queries": points(count // 2 + 1, seed + 50)}


def with_features(count: int, seed: int) -> dict[str, Tensor]:
    features = torch.rand(count, 4, generator=seeded(seed + 3))
    return {**with_queries(count, seed), "features": features}


def in_six_dimensions(count: int, seed: int) -> dict[str, Tensor]:
    return {key: torch.cat([value, value.flip(1)], 1) for key, value in with_queries(count, seed).items()}


def with_starts(count: int, seed: int) -> dict[str, Tensor]:
    return {"points": points(count, seed), "start": torch.tensor([count // 2])}


def with_seeds(count: int, seed: int) -> dict[str, Tensor]:
    return {"points": points(count, seed), "seeds": torch.tensor([seed + 7])}


def with_weights(count: int, seed: int) -> dict[str, Tensor]:
    return {"points": points(count, seed), "weights": torch.rand(count, generator=seeded(seed)) * 2}


def with_normals(count: int, seed: int) -> dict[str, Tensor]:
    normals = torch.nn.functional.normalize(torch.randn(count, 3, generator=seeded(seed + 9)), dim=1)
    return {"points": points(count, seed), "normals": normals}


def with_labels(count: int, seed: int) -> dict[str, Tensor]:
    return {"points": points(count, seed), "labels": torch.randint(-1, 3, (count,), generator=seeded(seed))}


def in_a_plane(count: int, seed: int) -> dict[str, Tensor]:
    return {"points": points(count, seed)[:, :2].contiguous()}


def two_clouds(count: int, seed: int) -> dict[str, Tensor]:
    return {"points_a": points(count, seed), "points_b": points(count // 2 + 1, seed + 50)}


def two_clouds_with_normals(count: int, seed: int) -> dict[str, Tensor]:
    clouds = two_clouds(count, seed)
    for side in "ab":
        normals = torch.randn(len(clouds[f"points_{side}"]), 3, generator=seeded(seed + 9))
        clouds[f"normals_{side}"] = torch.nn.functional.normalize(normals, dim=1)
    return clouds


def on_an_image(count: int, seed: int) -> dict[str, Tensor]:
    pixels = torch.randperm(192, generator=seeded(seed))[:count].sort().values
    return {"points": points(count, seed), "pixel_index": pixels}


def with_a_plane(count: int, seed: int) -> dict[str, Tensor]:
    return {"points": points(count, seed), "planes": torch.tensor([[0.0, 0.0, 2.0, -0.2]], dtype=torch.float64)}


INTRINSICS = torch.tensor([[[30.0, 0.1, 8.2], [0.0, 31.0, 6.1], [0.0, 0.0, 1.0]]], dtype=torch.float64)
LENS = torch.tensor([[0.05, -0.02, 0.001, -0.002, 0.01]], dtype=torch.float64)


def depth_image(count: int, seed: int) -> dict[str, Tensor]:
    """A 12 x 16 image with ``count`` readings."""
    depth = torch.zeros(192)
    depth[torch.randperm(192, generator=seeded(seed))[:count]] = 0.5
    depth *= 1 + torch.rand(192, generator=seeded(seed + 1))
    intrinsics = INTRINSICS.clone()
    intrinsics[:, 0, 0] += seed
    return {"depth": depth.reshape(1, 12, 16), "intrinsics": intrinsics, "distortion": LENS}


def lens_image(count: int, seed: int) -> dict[str, Tensor]:
    images = depth_image(count, seed)
    image = images["depth"][..., None].expand(-1, -1, -1, 2).contiguous()
    return {
        "image": image,
        "intrinsics": images["intrinsics"],
        "distortion": LENS,
        "new_intrinsics": INTRINSICS,
    }


def lens_depth(count: int, seed: int) -> dict[str, Tensor]:
    return {**depth_image(count, seed), "new_intrinsics": INTRINSICS}


def in_front_of_a_camera(count: int, seed: int) -> dict[str, Tensor]:
    return {"points": points(count, seed) + 0.5, "intrinsics": INTRINSICS, "distortion": LENS}


def triangles_in_front_of_a_camera(count: int, seed: int) -> dict[str, Tensor]:
    corners = points(3 * count, seed).reshape(count, 3, 3) + 0.5
    return {"triangles": corners, "intrinsics": INTRINSICS, "distortion": LENS}


def depth_alone(count: int, seed: int) -> dict[str, Tensor]:
    return {"depth": depth_image(count, seed)["depth"]}


def in_pairs(count: int, seed: int) -> dict[str, Tensor]:
    cloud = points(count, seed)
    targets = cloud[:, [1, 2, 0]] + 0.01 * torch.rand(count, 3, generator=seeded(seed + 7))
    return {"points": cloud, "targets": targets, "weights": torch.rand(count, generator=seeded(seed + 9))}


def onto_a_copy(count: int, seed: int) -> dict[str, Tensor]:
    cloud = points(count, seed)
    initial = torch.eye(4, dtype=torch.float64)[None].clone()
    initial[:, :3, 3] = 0.001
    return {"points": cloud, "targets": cloud[: count // 2 + 1] + 0.004, "initial": initial}


def in_pairs_of_a_plane(count: int, seed: int) -> dict[str, Tensor]:
    pairs = in_pairs(count, seed)
    return {name: pairs[name][:, :2].contiguous() for name in ("points", "targets")}


def ranges_alone(count: int, seed: int) -> dict[str, Tensor]:
    return {"ranges": depth_image(count, seed)["depth"]}


def disparity_alone(count: int, seed: int) -> dict[str, Tensor]:
    return {"disparity": depth_image(count, seed)["depth"]}


def color_image(count: int, seed: int) -> dict[str, Tensor]:
    return {"colors": torch.randint(256, (count, 5, 3), generator=seeded(seed), dtype=torch.uint8)}


def beside_a_color_camera(count: int, seed: int) -> dict[str, Tensor]:
    color_from_depth = torch.eye(4, dtype=torch.float64)[None].clone()
    color_from_depth[:, 0, 3] = 0.03 + 0.01 * seed
    seen = {"color_intrinsics": 1.5 * INTRINSICS, "color_from_depth": color_from_depth, "color_distortion": -0.5 * LENS}
    seen["color_intrinsics"][:, 2, 2] = 1.0
    return {**depth_image(count, seed), **seen}


@dataclass(frozen=True)
class Example:
    """One way to call an operation.

    ``gives`` says what each output is, so that outputs of single clouds can be packed as the batch packs them:
    ``row`` and ``cloud`` values follow one another, ``ptr`` are row pointers of clouds and ``rows_ptr`` of rows,
    ``index`` are rows of the points (their number stands for none), ``group`` are rows of the output that ``ptr`` cuts.
    """

    name: str
    cloud: Callable[[int, int], dict[str, Tensor]]
    gives: tuple[str, ...]
    options: Mapping[str, Any] = field(default_factory=dict)


EXAMPLES = [
    Example("ball_query", one_cloud, ("index", "row", "row"), {"radius": 0.03, "max_neighbors": 5}),
    Example("ball_query", with_queries, ("index", "row", "row"), {"radius": 0.03, "max_neighbors": 5}),
    Example("bilateral_filter", depth_alone, ("row",), {"max_jump": 0.3, "sigma_depth": 0.2}),
    Example("boundary_mask", with_normals, ("row",), {"radius": 0.05, "max_neighbors": 12}),
    Example(
        "ball_query",
        with_queries,
        ("index", "row", "row"),
        {"radius": 0.04, "max_neighbors": 5, "norm": "linf"},
    ),
    Example("box_mask", one_cloud, ("row",), {"lower": (0.0, 0.05, 0.0), "upper": (0.15, 0.2, 0.1)}),
    Example("chamfer_distance", two_clouds, ("cloud",)),
    Example("chamfer_distance", two_clouds_with_normals, ("cloud",), {"norm": "l1", "squared": False}),
    Example("f_score", two_clouds, ("cloud",), {"threshold": 0.02}),
    Example(
        "hard_voxels",
        one_cloud,
        ("index", "row", "row", "ptr"),
        {"voxel_size": 0.04, "lower": (0.0, 0.02, 0.0), "upper": (0.2, 0.2, 0.12), "max_points": 3, "max_voxels": 20},
    ),
    Example("hausdorff_distance", two_clouds, ("cloud",)),
    Example("frustum_mask", in_front_of_a_camera, ("row",), {"size": (9, 12), "near": 0.52, "far": 0.65}),
    Example("hidden_point_mask", one_cloud, ("row",), {"viewpoint": (0.1, 0.1, 0.5)}),
    Example("core_point_mask", with_weights, ("row",), {"eps": 0.03, "min_points": 4}),
    Example("dbscan", with_weights, ("row",), {"eps": 0.03, "min_points": 4}),
    Example("dbscan", one_cloud, ("row",), {"eps": 0.03, "min_points": 4}),
    Example("decimate_depth", depth_alone, ("row", "row"), {"factor": 3}),
    Example("deproject_depth", depth_image, ("row", "ptr", "row")),
    Example("deproject_ranges", ranges_alone, ("row", "ptr", "row")),
    Example("depth_normals", depth_image, ("row", "row"), {"reach": 2, "max_jump": 0.3}),
    Example("duplicate_mask", one_cloud, ("row",)),
    # Neighborhoods wide enough to have one normal: on three points in a line, backends may choose different ones.
    Example("estimate_normals", one_cloud, ("row",), {"radius": 0.05, "max_neighbors": 12}),
    Example("estimate_normals", one_cloud, ("row",), {"radius": None, "max_neighbors": 7}),
    Example("farthest_point_sample", one_cloud, ("index", "ptr"), {"num_samples": 20}),
    Example("farthest_point_sample", with_starts, ("index", "ptr"), {"num_samples": 20}),
    Example("farthest_point_sample", with_seeds, ("index", "ptr"), {"ratio": 0.3}),
    Example("farthest_point_sample", with_labels, ("index", "ptr"), {"num_samples": 20}),
    Example("farthest_point_groups", with_starts, ("index", "ptr", "group", "row"), {"num_samples": 20}),
    Example("farthest_point_groups", with_seeds, ("index", "ptr", "group", "row"), {"ratio": 0.3}),
    Example("fill_holes", depth_alone, ("row", "row"), {"rule": "nearest"}),
    Example("find_voxel_size", one_cloud, ("cloud",), {"num_points": 12}),
    Example("fit_paired_points", in_pairs, ("cloud",) * 3, {"with_scale": True}),
    Example("fit_paired_points", in_pairs_of_a_plane, ("cloud",) * 3),
    Example("flying_pixel_mask", depth_alone, ("row",)),
    Example("image_clusters", on_an_image, ("row",), {"size": (12, 16), "eps": 0.1, "reach": 2}),
    Example("interpolate_features", with_features, ("row",), {"k": 5}),
    Example("iterate_closest_points", onto_a_copy, ("cloud",) * 5, {"max_rounds": 8, "with_scale": True}),
    Example("knn", one_cloud, ("index", "row"), {"k": 4}),
    Example("knn", with_queries, ("index", "row"), {"k": 40}),
    Example("knn", with_queries, ("index", "row"), {"k": 7, "norm": "l1"}),
    Example("knn", one_cloud, ("index", "row"), {"k": 4, "norm": "linf", "exclude_self": True}),
    Example("knn", in_six_dimensions, ("index", "row"), {"k": 4}),
    Example("knn", one_cloud, ("index", "row"), {"k": 4, "exclude_self": True}),
    Example("median_filter", depth_alone, ("row",), {"reach": 2}),
    Example("median_filter", depth_alone, ("row",), {"max_jump": 0.3}),
    Example("neighborhood_covariance", with_queries, ("row", "row", "row"), {"radius": 0.05, "max_neighbors": 12}),
    Example("pack_colors", color_image, ("row",)),
    Example("polygon_mask", in_a_plane, ("row",), {"polygon": [[0.0, 0.0], [0.2, 0.0], [0.1, 0.05], [0.0, 0.2]]}),
    Example("project_points", in_front_of_a_camera, ("row", "row")),
    Example("radius_neighbors", with_queries, ("index", "row", "rows_ptr"), {"radius": 0.05, "norm": "l1"}),
    Example("radius_neighbors", with_queries, ("index", "row", "rows_ptr"), {"radius": 0.03}),
    Example("radius_neighbors", one_cloud, ("index", "row", "rows_ptr"), {"radius": 0.06, "exclude_self": True}),
    Example("radius_outlier_mask", one_cloud, ("row",), {"radius": 0.03, "min_neighbors": 2}),
    Example("ransac_circle", one_cloud, ("cloud",) * 3 + ("row",), {"num_hypotheses": 100}),
    Example("ransac_cylinder", one_cloud, ("cloud",) * 4 + ("row",), {"num_hypotheses": 100, "radius": (0.01, 1.0)}),
    Example("ransac_cylinder", with_normals, ("cloud",) * 4 + ("row",), {"num_hypotheses": 100}),
    Example("ransac_line", one_cloud, ("cloud",) * 3 + ("row",), {"num_hypotheses": 100}),
    Example("ransac_sphere", one_cloud, ("cloud",) * 2 + ("row",), {"num_hypotheses": 100}),
    Example("ransac_sphere", with_normals, ("cloud",) * 2 + ("row",), {"num_hypotheses": 100}),
    Example("ransac_plane", one_cloud, ("cloud", "row"), {"distance": 0.01, "num_hypotheses": 100}),
    Example("register_depth", beside_a_color_camera, ("row",) * 4, {"color_size": (18, 24)}),
    Example("render_points", in_front_of_a_camera, ("row", "index"), {"size": (12, 16), "point_size": 0.05}),
    Example("render_ranges", one_cloud, ("row", "index"), {"size": (12, 16)}),
    Example("render_triangles", triangles_in_front_of_a_camera, ("row", "index", "row"), {"size": (12, 16)}),
    Example("resize_depth", depth_alone, ("row", "row"), {"size": (7, 30), "max_jump": 0.3}),
    Example("segment_planes", one_cloud, ("row", "ptr", "row"), {"num_hypotheses": 50, "min_share": 0.1}),
    Example("spatial_filter", disparity_alone, ("row",), {"delta": 0.3}),
    Example("statistical_outlier_mask", one_cloud, ("row",), {"num_neighbors": 6, "std_ratio": 1.0}),
    Example("supporting_plane", one_cloud, ("cloud", "row"), {"num_hypotheses": 50, "distance": 0.005}),
    Example(
        "table_surface", with_a_plane, ("row", "row", "row", "row", *("cloud",) * 4), {"viewpoint": (0.1, 0.1, 1.0)}
    ),
    Example("undistort_depth", lens_depth, ("row", "row"), {"rule": "surface", "max_jump": 0.3}),
    Example("undistort_image", lens_image, ("row", "row"), {"size": (7, 30)}),
    Example("voxel_downsample", one_cloud, ("row", "ptr", "group"), {"voxel_size": 0.04}),
    Example(
        "voxel_downsample",
        one_cloud,
        ("row", "ptr", "group"),
        {"voxel_size": [[0.04, 0.06, 0.11]], "origin": (0.03, 0.1, -0.2), "min_points": 3},
    ),
]

each_example = pytest.mark.parametrize(
    "example", EXAMPLES, ids=lambda example: f"{example.name}-{example.cloud.__name__}"
)


def row_pointers(example: Example) -> dict[str, str]:
    """Row pointer argument -> the tensor argument whose rows it cuts."""
    specs = {key: parse_spec(text) for key, text in OPERATIONS[example.name].contract.tensors.items()}
    tensors = {spec.dims[0]: key for key, spec in reversed(specs.items()) if not spec.is_ptr}
    return {key: tensors[spec.dims[0]] for key, spec in specs.items() if spec.is_ptr}


def packed(example: Example, clouds: list[dict[str, Tensor]], *, with_ptr: bool = True) -> dict[str, Tensor]:
    """The arguments for clouds one after another."""
    together = {key: torch.cat([cloud[key] for cloud in clouds]) for key in clouds[0]}
    for ptr, rows in row_pointers(example).items():
        if rows in together:
            together[ptr] = ptr_from_counts([len(cloud[rows]) for cloud in clouds]) if with_ptr else None
    return together


def clouds_of(example: Example, counts=COUNTS) -> list[dict[str, Tensor]]:
    return [example.cloud(count, seed) for seed, count in enumerate(counts)]


def call(example: Example, arguments: dict[str, Any], **options: Any) -> tuple[Tensor, ...]:
    result = OPERATIONS[example.name].public(**arguments, **{**example.options, **options})
    result = result if isinstance(result, tuple) else (result,)
    assert len(result) == len(example.gives)
    return result


def outcome(example: Example, arguments: dict[str, Any]) -> tuple[Tensor, ...] | type[PcdataError]:
    try:
        return call(example, arguments)
    except PcdataError as error:
        assert str(error).startswith(f"{example.name}: ")  # noqa: PT017 - passing is fine too
        return type(error)


def packed_results(
    example: Example, clouds: list[dict[str, Tensor]], results: list[tuple[Tensor, ...]]
) -> list[Tensor]:
    """Pack the outputs of single clouds as the batch does."""
    outputs = []
    for place, kind in enumerate(example.gives):
        values = [result[place] for result in results]
        if kind == "ptr":
            outputs.append(ptr_from_counts([int(value[-1]) for value in values]))
            continue
        if kind == "rows_ptr":
            outputs.append(ptr_from_counts(torch.cat([value.diff() for value in values])))
            continue
        if kind == "index":
            sizes = [len(next(iter(cloud.values()))) for cloud in clouds]
            starts = ptr_from_counts(sizes).tolist()
            values = [
                torch.where(value == size, starts[-1], value + start)
                for value, size, start in zip(values, sizes, starts)
            ]
        if kind == "group":
            made = [int(result[example.gives.index("ptr")][-1]) for result in results]
            starts = ptr_from_counts(made).tolist()
            values = [torch.where(value < 0, value, value + start) for value, start in zip(values, starts)]
        outputs.append(torch.cat(values))
    return outputs


def assert_equal(one, other) -> None:
    assert len(one) == len(other)
    for place, (a, b) in enumerate(zip(one, other)):
        assert a.dtype == b.dtype
        assert torch.equal(a, b), f"output {place} differs"


def test_every_operation_on_tensors_has_an_example():
    on_tensors = {name for name, operation in OPERATIONS.items() if operation.contract.tensors_alone}
    assert {
        example.name for example in EXAMPLES
    } == on_tensors  # the others: tests/functional/tsdf/test_step_contract.py


def test_every_argument_of_every_contract_is_in_an_example():
    for name, operation in OPERATIONS.items():
        if not operation.contract.tensors_alone:
            continue
        used = set()
        for example in EXAMPLES:
            if example.name == name:
                used |= set(packed(example, clouds_of(example)))
        assert used == set(operation.contract.tensors), name


@each_example
def test_the_input_stays_as_it_was_and_the_answer_repeats(example):
    arguments = packed(example, clouds_of(example))
    before = {key: value.clone() for key, value in arguments.items()}
    state = torch.get_rng_state()
    first = call(example, arguments)
    for key, value in arguments.items():
        assert torch.equal(value, before[key])
    assert_equal(first, call(example, arguments))
    assert torch.equal(torch.get_rng_state(), state)


@each_example
@pytest.mark.parametrize("counts", [COUNTS, (30, 0, 40), (50, 1, 2), (0, 0)], ids=str)
def test_a_batch_equals_its_clouds_one_after_another(example, counts):
    clouds = clouds_of(example, counts)
    batch = outcome(example, packed(example, clouds))
    singles = [outcome(example, packed(example, [cloud])) for cloud in clouds]
    errors = [single for single in singles if isinstance(single, type)]
    if errors:
        assert batch is errors[0]
    else:
        assert_equal(batch, packed_results(example, clouds, singles))


@each_example
def test_no_row_pointers_mean_one_cloud(example):
    cloud = clouds_of(example, (60,))
    assert_equal(call(example, packed(example, cloud)), call(example, packed(example, cloud, with_ptr=False)))


@each_example
@pytest.mark.parametrize("count", [0, 1, 2, 3])
def test_few_points_pass_or_raise_a_typed_error(example, count):
    outcome(example, packed(example, clouds_of(example, (count,))))


@each_example
def test_points_that_are_all_the_same_pass_or_raise_a_typed_error(example):
    clouds = clouds_of(example, (40, 30))
    for cloud in clouds:
        for key in cloud:
            if "points" in key or key == "queries":
                cloud[key] = torch.full_like(cloud[key], 0.3)
    batch = outcome(example, packed(example, clouds))
    if not isinstance(batch, type):
        assert_equal(batch, packed_results(example, clouds, [call(example, packed(example, [one])) for one in clouds]))


@each_example
def test_wrong_tensors_are_refused_by_name(example):
    good = packed(example, clouds_of(example))
    for key, value in good.items():
        spec = parse_spec(OPERATIONS[example.name].contract.tensors[key])

        def refused(bad: Any, error: type[PcdataError], key: str = key) -> None:
            with pytest.raises(error, match=rf"^{example.name}: .*{key}"):
                call(example, {**good, key: bad})

        refused(value.to(torch.int32 if spec.is_ptr else torch.float16), DTypeError)
        refused(value[None], ShapeError)
        refused(value.tolist(), DTypeError)
        refused(value.numpy(), DTypeError)
        if value.dtype.is_floating_point:
            for bad in (torch.nan, torch.inf, -torch.inf):
                spoiled = value.clone()
                spoiled.flatten()[-1:] = bad
                refused(spoiled, NonFiniteError)
        if key != next(iter(good)):
            refused(value.to("meta"), DeviceError)


# What a value may not be, by its spec; specs of one operation alone are tested with it.
WRONG = {
    checked_count: [(0, ConfigError), (-3, ConfigError), (1.0, DTypeError), (True, DTypeError), ("1", DTypeError)],
    checked_length: [
        (0.0, ConfigError),
        (-1.0, ConfigError),
        (math.inf, ConfigError),
        (math.nan, ConfigError),
        ("1", DTypeError),
    ],
    checked_positive: [
        (0.0, ConfigError),
        (-1.0, ConfigError),
        (math.nan, ConfigError),
        (None, DTypeError),
        (True, DTypeError),
    ],
    checked_fraction: [(0.0, ConfigError), (1.01, ConfigError), (math.nan, ConfigError), ("1", DTypeError)],
    checked_word: [("other", ConfigError), (None, ConfigError)],
    checked_image_size: [((4,), ConfigError), ((0, 4), ConfigError), ((4, 4, 4), ConfigError)],
    checked_counts: [(-1, ConfigError), (1.5, DTypeError), ([1], ShapeError), (1000, TooFewPointsError)],
    checked_places: [([0.0, 1.0], ShapeError), ([0.0, 1.0, math.nan], ConfigError)],
    checked_edges: [
        (0.0, ConfigError),
        ([[0.1, 0.1]], ShapeError),
        ([[0.1, 0.1, 0.1]] * 2, ShapeError),
        ([[0.1, 0.0, 0.1]], ConfigError),
    ],
    checked_lengths: [
        (0.0, ConfigError),
        (math.inf, ConfigError),
        ([0.1], ShapeError),
        ([0.1, 0.1, -1.0], ConfigError),
    ],
}


@each_example
def test_wrong_values_are_refused_by_name_before_any_backend(example):
    arguments = packed(example, clouds_of(example))
    contract = OPERATIONS[example.name].contract
    for key, spec in contract.others.items():
        for value, error in WRONG.get(getattr(spec, "func", spec), []):
            if value is None and contract.signature.parameters[key].default is None:
                continue
            words = {checked_counts: "counts|number of samples|points were asked"}.get(spec, key)
            with pytest.raises(error, match=rf"^{example.name}: .*({words})"):
                call(example, arguments, **{key: value, "backend": "none"})


@each_example
def test_wrong_row_pointers_are_refused(example):
    good = packed(example, clouds_of(example))
    for key, rows in row_pointers(example).items():
        if rows not in good:
            continue
        count = len(good[rows])
        for wrong in ([0, count + 1, count, count], [1, 2, 3, count], [0, 1, 2, count - 1], [0, 1, 2, count + 1]):
            with pytest.raises(ShapeError, match=rf"^{example.name}: {key}"):
                call(example, {**good, key: torch.tensor(wrong)})


LIVE = [backend for backend in BACKEND_MODULES if why_unavailable(backend) is None]  # asking loads the kernels


@pytest.mark.parametrize(
    ("example", "backend"),
    [(example, backend) for example in EXAMPLES for backend in LIVE if OPERATIONS[example.name].serves(backend)],
    ids=lambda value: value if isinstance(value, str) else f"{value.name}-{value.cloud.__name__}",
)
def test_every_backend_gives_what_the_reference_gives(example, backend):
    arguments = packed(example, clouds_of(example))
    expected = call(example, arguments, backend="torch")
    for found, wanted in zip(call(example, arguments, backend=backend), expected, strict=True):
        if wanted.is_floating_point():  # sums may be taken in another order
            torch.testing.assert_close(found, wanted, rtol=1e-5, atol=1e-6)
        else:
            assert torch.equal(found, wanted)


@each_example
@pytest.mark.parametrize("backend", ["toch", "CUDA", "", None])
def test_an_unknown_backend_is_refused(example, backend):
    arguments = packed(example, clouds_of(example))
    with pytest.raises(BackendError, match=rf"^{example.name}: unknown backend {backend!r}; known: 'auto', 'torch'"):
        call(example, arguments, backend=backend)


@each_example
def test_it_runs_in_inference_mode_and_on_slices(example):
    arguments = packed(example, clouds_of(example))
    expected = call(example, arguments)
    with torch.inference_mode():
        assert_equal(expected, call(example, arguments))
    # Rows of a wider tensor: not contiguous.
    strided = {
        key: torch.cat([value, value], dim=-1)[..., : value.shape[-1]] if value.ndim > 1 else value
        for key, value in arguments.items()
    }
    assert_equal(expected, call(example, strided))


def is_rows(example: Example, key: str) -> bool:
    return not parse_spec(OPERATIONS[example.name].contract.tensors[key]).is_ptr


@each_example
@pytest.mark.parametrize("layout", ["column_major", "expanded", "every_other"])
@pytest.mark.parametrize("backend", ["auto", "torch"])
def test_any_strides_give_the_same_answer(example, layout, backend):
    arguments = packed(example, clouds_of(example))
    if layout == "expanded":  # all rows are one row in memory
        arguments = {
            key: value[:1].repeat_interleave(len(value), 0) if is_rows(example, key) else value
            for key, value in arguments.items()
        }

    def laid_out(value: Tensor) -> Tensor:
        if layout == "expanded" and value.ndim > 1:
            return value[:1].expand(value.shape)
        if layout == "every_other" or value.ndim < 2:
            return torch.stack([value, value], dim=-1)[..., 0]
        return value.mT.contiguous().mT

    strange = {key: laid_out(value) for key, value in arguments.items()}
    try:
        expected = call(example, arguments, backend=backend)
    except PcdataError as error:
        with pytest.raises(type(error)):
            call(example, strange, backend=backend)
    else:
        assert_equal(expected, call(example, strange, backend=backend))


@each_example
def test_an_operation_without_a_gradient_runs_its_kernel_on_inputs_that_require_one(example, monkeypatch):
    operation = OPERATIONS[example.name]
    arguments = packed(example, clouds_of(example))
    expected = call(example, arguments)
    leaves = {
        key: value.clone().requires_grad_() if value.dtype.is_floating_point else value
        for key, value in arguments.items()
    }
    if not operation.gradient and "cpu" in operation.kernels and why_unavailable("cpu") is None:
        monkeypatch.setattr(operation, "reference", None)  # the slow body is not called
    found = call(example, leaves)
    if operation.gradient:
        for one, other in zip(found, expected, strict=True):
            torch.testing.assert_close(one.detach(), other, rtol=1e-5, atol=1e-6)
    else:
        assert_equal(found, expected)
        assert not any(one.requires_grad for one in found)


@each_example
@pytest.mark.parametrize("backend", ["auto", "torch"])
def test_torchs_default_device_and_dtype_change_nothing(example, backend):
    arguments = packed(example, clouds_of(example))
    expected = call(example, arguments, backend=backend)
    before = torch.get_default_dtype()
    try:
        torch.set_default_dtype(torch.float64)
        assert_equal(expected, call(example, arguments, backend=backend))
        with torch.device("meta"):
            assert_equal(expected, call(example, arguments, backend=backend))
    finally:
        torch.set_default_dtype(before)


OPTIMIZED = """
import dis, io, sys
from importlib.machinery import SourceFileLoader
for name in [name for name in sys.modules if name.split(".")[0] in ("pcdata", "tests")]:
    del sys.modules[name]
def without_asserts(loader, name):
    path = loader.get_filename(name)
    return compile(loader.get_data(path), path, "exec", dont_inherit=True, optimize=1)
SourceFileLoader.get_code = without_asserts
sys.path.insert(0, {root!r})
import torch
import pcdata.functional.clusters as clusters
words = io.StringIO()
for function in vars(clusters).values():
    if getattr(function, "__module__", "") == clusters.__name__ and hasattr(function, "__code__"):
        dis.dis(function, file=words)
if not words.getvalue() or "ASSERTION" in words.getvalue().upper():
    sys.exit("asserts are on")
from tests.functional.test_op_contract import EXAMPLES, call, clouds_of, packed
for example in EXAMPLES:
    arguments = packed(example, clouds_of(example))
    strange = {{
        key: value.mT.contiguous().mT if value.ndim > 1 else torch.stack([value, value], 1)[:, 0]
        for key, value in arguments.items()
    }}
    for one, other in zip(call(example, arguments), call(example, strange)):
        if not torch.equal(one, other):
            sys.exit(example.name + " differs")
    empty = {{key: value[:0] for key, value in arguments.items() if "ptr" not in key}}
    try:
        call(example, empty)
    except (ValueError, TypeError, RuntimeError):
        pass
print("fine")
"""


def test_without_asserts_nothing_reads_or_writes_astray():
    code = OPTIMIZED.format(root=str(Path(__file__).parents[2]))
    done = run_python(code)  # python -O would compile all of torch once more
    assert done.returncode == 0, done.stderr[-2000:]
    assert done.stdout.strip().endswith("fine")


@each_example
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device to compare the CPU with")
def test_cuda_agrees_with_the_cpu(example):
    arguments = packed(example, clouds_of(example))
    on_gpu = call(example, {key: value.to("cuda") for key, value in arguments.items()})
    for cpu, gpu in zip(call(example, arguments), on_gpu):
        assert gpu.device.type == "cuda"
        if cpu.dtype.is_floating_point:
            torch.testing.assert_close(gpu.cpu(), cpu, atol=1e-6, rtol=1e-6)
        else:
            assert torch.equal(gpu.cpu(), cpu)
