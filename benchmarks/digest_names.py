"""Every name of pcdata that the digests use: where the package moves or renames, this file alone changes.

The other ``digest_*.py`` files import nothing of pcdata. They see steps, operations and checks by their names, and
results through :data:`NOUNS`: the attributes that hold numbers, and those that hold facts (history, origin).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import make_dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import torch

import pcdata
from pcdata import alignment
from pcdata.build import build_dataset, config_from_yaml
from pcdata.calibration import (  # noqa: F401
    BoardView,
    Calibration,
    Evidence,
    RobotPoses,
    calibrate_hand_eye,
    calibrate_intrinsics,
    check_plane,
    find_board,
    parse_board,
    read_board_images,
    refine_extrinsics,
)
from pcdata.contracts.dispatch import INNER, OPERATIONS, why_unavailable
from pcdata.errors import PcdataError as Refused  # noqa: F401
from pcdata.exports import TARGETS, export_dataset
from pcdata.functional import ParallelJaw, tsdf  # noqa: F401
from pcdata.functional.stored_rows import Role, StoredForm, StoredGroups, find_records, parts_of  # noqa: F401
from pcdata.functional.touching.limits import Limits  # noqa: F401
from pcdata.functional.touching.windows import PixelCamera  # noqa: F401
from pcdata.io import (  # noqa: F401
    AveragedSource,
    CaptureCamera,
    TemporalFilterDepth,
    TemporallyFilteredSource,
    open_source,
    read_calibration,
    read_color,
    read_confidence,
    read_depth,
    read_labels,
    read_mask,
    read_pcd,
    read_ply,
    read_pose,
    write_calibration,
    write_capture_camera,
    write_color,
    write_confidence,
    write_depth,
    write_labels,
    write_mask,
    write_pcd,
    write_ply,
    write_pose,
    write_volume,
)
from pcdata.io.writers.capture_folder import write_capture  # noqa: F401
from pcdata.models import CONTRACTS, preset
from pcdata.structures import (  # noqa: F401
    NORMALIZED,
    Camera,
    Confidence,
    DepthFrame,
    Episode,
    Kind,
    PaddedClouds,
    PointCloud,
    SurfaceMesh,
    TSDFVolume,
    register_to_color,
)
from pcdata.synthetic import SyntheticSource, tabletop  # noqa: F401
from pcdata.transforms.base import REGISTRY
from pcdata.validation import validate_frame, validate_source, verify_overlap  # noqa: F401
from pcdata.validation.measures import edge_offset, extremes, missing_region, occlusion_edges

# Where the public functions are: operations, and what is beside them.
FUNCTIONS: tuple[ModuleType, ...] = (
    pcdata.functional,
    alignment,
    edge_offset,
    extremes,
    missing_region,
    occlusion_edges,
)

# Class -> the attributes that are numbers and names of coordinate frames, and those that are facts.
NOUNS: dict[type, tuple[tuple[str, ...], tuple[str, ...]]] = {
    PointCloud: (
        (
            *("points", "ptr", "colors", "normals", "labels", "source_index", "extra", "kinds", "viewpoint"),
            *("source_from_cloud", "frames", "frame_id", "source_frame", "unit"),
        ),
        ("meta", "history"),
    ),
    PaddedClouds: (
        (
            *("points", "mask", "colors", "normals", "labels", "source_index", "extra"),
            *("source_from_cloud", "frames", "frame_id", "source_frame", "unit"),
        ),
        ("meta",),
    ),
    DepthFrame: (
        (
            *("depth", "camera", "colors", "labels", "confidence", "mask", "world_from_camera", "frame_id"),
            *("capture_index", "sample_id"),
        ),
        ("provenance",),
    ),
    Camera: (("intrinsics", "size", "distortion", "is_window"), ()),
    SurfaceMesh: (("vertices", "triangles"), ()),
    pcdata.ModelBatch: (
        ("tensors", "channels", "frame_id", "unit", "counts", "source_from_cloud", "source_frame", "frames"),
        ("model", "choices", "steps", "meta"),
    ),
}


# Step -> its fields that have another name in benchmarks/results/digests.json; histories hold fields by name.
RENAMED = {"RandomApply": {"step": "transform"}}


def as_recorded(facts: Any) -> Any:
    """Facts with the names of fields that they had when the digests were recorded."""
    if isinstance(facts, (list, tuple)):
        return [as_recorded(entry) for entry in facts]
    if not isinstance(facts, Mapping):
        return facts
    found = {name: as_recorded(value) for name, value in facts.items()}
    if "fields" in found and found.get("step") in RENAMED:  # of a history
        found["fields"] = _renamed(found["fields"], RENAMED[found["step"]])
    return {name: _renamed(value, RENAMED[name]) if name in RENAMED else value for name, value in found.items()}


def _renamed(fields: Mapping[str, Any], names: Mapping[str, str]) -> dict[str, Any]:
    return {names.get(name, name): value for name, value in fields.items()}


class _Functions:
    """Every public function by its name, wherever it is."""

    def __getattr__(self, name: str) -> Any:
        for module in FUNCTIONS:
            if hasattr(module, name):
                return getattr(module, name)
        raise AttributeError(f"digests: no module of FUNCTIONS has {name}")


functional = _Functions()


# -- transforms --------------------------------------------------------------------------------------------------------


def transform_names() -> list[str]:
    """The registered transforms of pcdata itself."""
    return sorted(name for name, cls in REGISTRY.items() if cls.__module__.startswith("pcdata."))


def step(name: str, /, **fields: Any) -> Any:
    """Make a transform by its registered name."""
    return REGISTRY[name](**fields)


def chain(*steps: Any) -> Any:
    """Steps one after another."""
    return REGISTRY["Compose"](list(steps))


def randomly(transform: Any, **fields: Any) -> Any:
    """A transform that runs with a probability."""
    return REGISTRY["RandomApply"](step=transform, **fields)


def takes_frames(transform: Any) -> bool:
    return transform.takes is DepthFrame


def run(transform: Any, data: Any, seed: int = 0) -> Any:
    """Run a transform on a capture or a cloud, with a generator only where it draws."""
    generator = torch.Generator().manual_seed(seed) if transform.is_random else None
    return transform(data, generator=generator)


# -- operations --------------------------------------------------------------------------------------------------------


def operation_names() -> list[str]:
    return sorted(OPERATIONS)


def inner_names() -> list[str]:
    return sorted(INNER)


def backends_of(name: str) -> list[str]:
    """The backends that the digests cover and that serve an operation here."""
    operation = OPERATIONS.get(name) or INNER[name]
    if name == "nearest_chunks":  # a step of those that the core serves whole
        return ["torch", "torch_tree"] if why_unavailable("torch_tree") is None else ["torch"]
    live = why_unavailable("cpu") is None and operation.serves("cpu")
    return ["torch", "cpu"] if live else ["torch"]


def call(name: str, backend: str, arguments: Mapping[str, Any]) -> Any:
    """Call a public operation; what it changes in place is a result too."""
    found = OPERATIONS[name].public(**arguments, backend=backend)
    changed = {argument: stored(arguments[argument]) for argument in OPERATIONS[name].mutates}
    return changed or found


def stored(blocks: Any) -> dict[str, Any]:
    """The voxels of a field, block after block."""
    planes = {plane: blocks.gather(plane, blocks.sorted_rows) for plane in blocks.planes}
    return {"keys": blocks.sorted_keys, **planes}


def call_inner(name: str, backend: str, arguments: Sequence[Any], named: Mapping[str, Any]) -> Any:
    """Call what only pcdata itself calls: its reference, or its compiled kernel."""
    operation = INNER[name]
    body = operation.reference if backend == "torch" else operation.kernels[backend]
    found = body(*arguments, **named)
    if name == "gather_records":  # it fills its first argument
        return arguments[0]
    if name == "find_records":
        parts = parts_of(found, len(arguments[2].roles), len(arguments[0]))
        return [torch.as_tensor(part) for part in (parts.starts, parts.ends, parts.sizes)]  # not the addresses
    if not isinstance(found, Iterator):
        return found
    columns = [torch.cat(parts) for parts in zip(*found)]  # neighbors of some queries at a time, in no fixed order
    order = columns[0].argsort()
    return [column[order] for column in columns]


def has_core() -> bool:
    """Whether the compiled core is there; without it no digest of the backend cpu can be made."""
    return why_unavailable("cpu") is None


# -- datasets, models, exports -----------------------------------------------------------------------------------------


def build(text: str, source: Any, folder: Path) -> Any:
    """Build a dataset from the text of a configuration."""
    return build_dataset(config_from_yaml(text), source, folder)


def pipeline(text: str) -> Any:
    """The whole chain of a configuration's text: depth, cloud and augment."""
    return config_from_yaml(text).pipeline


def contract_names() -> list[str]:
    return sorted(CONTRACTS)


def open_choices(name: str) -> tuple[str, ...]:
    """What the contract of a model leaves open."""
    return tuple(CONTRACTS[name].required_choices)


def takes_images(name: str) -> bool:
    return CONTRACTS[name].takes == "depth image"


def model_batch(name: str, choices: Mapping[str, Any], captures: Sequence[Any]) -> Any:
    """The batch of a model's preset; capture n is drawn with seed n."""
    made = preset(name, **choices)
    return made.collate([run(made.pipeline, capture, seed) for seed, capture in enumerate(captures)])


def export_names() -> list[str]:
    return sorted(TARGETS)


def export(source: Any, target: str, folder: Path, **options: Any) -> None:
    export_dataset(source, target, folder, **options)


# -- verdicts ----------------------------------------------------------------------------------------------------------


def check_row(check: Any) -> tuple[Any, ...]:
    """One check: its view, verdict, number and limits; what cannot be measured was a warning once."""
    verdict = "warn" if check.verdict.value == "unknown" else check.verdict.value
    return check.view, verdict, check.value, check.threshold, check.fails_at, check.unit


def overlap_verdict(verdict: Any) -> str:
    """The word for it when the digests were first made."""
    return "not measurable" if verdict.value == "unknown" else str(verdict.value)


def passed(result: Any) -> bool:
    """Whether every limit of a calibration step held."""
    return str(result.verdict.value) != "fail"


def reports(source: Any) -> list[tuple[str, list[tuple[str, tuple[Any, ...]]]]]:
    """Sample id -> the rows of its checks by name, over all captures of a source."""
    found = validate_source(source)
    return [(report.sample_id, [(check.name, check_row(check)) for check in report.findings]) for report in found]


def votes_row(votes: Any) -> Any:
    """The votes of the rims of one image, under the names that they were recorded by."""
    histogram, num_edges = votes
    return make_dataclass("Votes", ["histogram", "num_edges", "scale"])(
        histogram, num_edges, (len(histogram[0, 0]) - 25) // 8
    )


def overlap_rows(result: Any) -> dict[str, Any]:
    """What the overlap of several cameras says, in numbers, names and verdicts."""
    pairs = ("first", "second", "overlap", "meeting", "num_samples", "median", "p90", "mean", "verdict", "histogram")
    cameras = (
        *("name", "shift", "shift_vector", "shift_sigma", "measured_shift_sigma", "rotation_degrees"),
        *("rotation_sigma_degrees", "measured_rotation_sigma_degrees", "center", "correction", "verdict"),
    )
    return {
        "verdict": overlap_verdict(result.verdict),
        "wrong": result.wrong,
        "candidates": result.candidates,
        "reference": result.reference,
        "pairs": [_row(pair, pairs) for pair in result.pairs],
        "cameras": [_row(camera, cameras) for camera in result.cameras],
    }


def _row(found: Any, names: tuple[str, ...]) -> list[Any]:
    values = (getattr(found, name) for name in names)
    return [overlap_verdict(value) if name == "verdict" else value for name, value in zip(names, values)]


def finding_rows(result: Any) -> list[tuple[str, bool]]:
    """The verdict of every limit of a calibration step."""
    return [
        (
            finding.name.partition(",")[0] if finding.name.startswith("solvers apart") else finding.name,
            finding.verdict.value != "fail",
        )
        for finding in result.findings
    ]
