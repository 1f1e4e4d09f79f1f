"""Pipelines as YAML: what can be written, and where each fault is."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pcdata import transforms as T
from pcdata.errors import ConfigError


def faults(text: str) -> list[str]:
    with pytest.raises(ConfigError) as caught:
        T.Compose.from_yaml(text, name="p.yaml")
    return str(caught.value).splitlines()


GOOD = """\
- Deproject
- ToFrame: {frame: base}
- CropWorkspace:
    frame: base
    lower: [-0.5, -0.5, 0]
    upper: [0.5, 0.5, 1]
- RandomApply:
    probability: 0.3
    step: {RandomFlip: {about: centroid}}
- Compose:
    steps:
      - Center:
      - NormalizeUnitSphere
"""


def test_names_fields_and_steps_within_steps_are_read():
    pipeline = T.Compose.from_yaml(GOOD)
    assert [type(step).__name__ for step in pipeline.steps] == [
        "Deproject", "ToFrame", "CropWorkspace", "RandomApply", "Center", "NormalizeUnitSphere",
    ]  # fmt: skip
    assert pipeline.steps[2].lower == (-0.5, -0.5, 0.0)
    assert pipeline.steps[3].step.about == "centroid"
    assert T.Compose.from_yaml(pipeline.to_yaml()).fingerprint() == pipeline.fingerprint()


def test_an_empty_list_is_an_empty_pipeline_and_an_empty_file_is_none():
    assert len(T.Compose.from_yaml("[]")) == 0
    for text in ("", "# nothing\n"):
        with pytest.raises(ConfigError, match="is empty"):
            T.Compose.from_yaml(text)


@pytest.mark.parametrize("text", ["5e-3", "5E-3", "0.005", "5.0e-3", "+.5e-2", ".005"])
def test_small_numbers_may_be_written_as_engineers_write_them(text):
    assert T.Compose.from_yaml(f"- VoxelDownsample: {{voxel_size: {text}}}").steps[0].voxel_size == 0.005


@settings(max_examples=50, deadline=None)
@given(st.floats(min_value=1e-300, max_value=1e300))
def test_every_number_comes_back_bit_for_bit(value):
    pipeline = T.Compose([T.VoxelDownsample(voxel_size=value)])
    assert T.Compose.from_yaml(pipeline.to_yaml()).steps[0].voxel_size == value


@settings(max_examples=25, deadline=None)
@given(st.text(min_size=1, max_size=8))
def test_every_name_comes_back_as_it_was(name):
    pipeline = T.Compose([T.ToFrame(frame=name)])
    assert T.Compose.from_yaml(pipeline.to_yaml()).steps[0].frame == name


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("- Deprojct", "p.yaml:1:3: unknown transform 'Deprojct'; did you mean 'Deproject'?"),
        ("- randomflip: {}", "p.yaml:1:3: unknown transform 'randomflip'; did you mean 'RandomFlip' or "),
        ("- Center\n- {RandomScale: {hihg: 2}}", "p.yaml:2:18: RandomScale.hihg: no such field; did you mean 'high'?"),
        (
            "- VoxelDownsample:\n    voxel_sise: {a: 1}",
            "p.yaml:2:5: VoxelDownsample.voxel_sise: no such field; did you mean 'voxel_size'?",
        ),
        ("- Center: {axis: 1}", "p.yaml:1:12: Center.axis: no such field; Center has []"),
        ("- CropWorkspace:\n    frame: base", "p.yaml:2:5: CropWorkspace.lower: Field required"),
        ("- ToFrame", "p.yaml:1:3: ToFrame.frame: Field required"),
        (
            "- VoxelDownsample:\n    voxel_size: small",
            "p.yaml:2:17: VoxelDownsample.voxel_size: Input should be a valid number (got 'small')",
        ),
        (
            "- VoxelDownsample: {voxel_size: '0.01'}",
            "p.yaml:1:33: VoxelDownsample.voxel_size: Input should be a valid number (got '0.01')",
        ),
        (
            "- RandomSample: {num_points: yes}",
            "p.yaml:1:30: RandomSample.num_points: Input should be a valid integer (got True)",
        ),
        (
            "- RandomSample: {num_points: 10.0}",
            "p.yaml:1:30: RandomSample.num_points: Input should be a valid integer (got 10.0)",
        ),
        (
            "- VoxelDownsample: {voxel_size: .inf}",
            "p.yaml:1:33: VoxelDownsample.voxel_size: Input should be a finite number (got inf)",
        ),
        (
            "- NormalizeWorkspace: {frame: base, lower: [0, x, 0], upper: [1, 1, 1]}",
            "p.yaml:1:48: NormalizeWorkspace.lower.1: Input should be a valid number (got 'x')",
        ),
        (
            "- RandomApply: {step: {RandomFlip: {about: me}}}",
            "p.yaml:1:44: RandomFlip.about: Input should be 'origin' or 'centroid' (got 'me')",
        ),
        ("- RandomApply: {step: Flip}", "p.yaml:1:23: unknown transform 'Flip'; known: BilateralFilterDepth, Center"),
        ("- MaskDepth: {near: 1, near: 2}", "p.yaml:1:24: MaskDepth: 'near' is given twice"),
        ("- Center: &c\n- *c", "p.yaml:2:3: YAML aliases (*name) are not allowed; write the value out"),
        (
            "- Center:\n  RandomFlip:",
            "p.yaml:1:3: a step is one name with its fields, got 2 names: ['Center', 'RandomFlip']",
        ),
        ("- {}", "p.yaml:1:3: a step is one name with its fields, got 0 names: []"),
        ("- [Center]", "p.yaml:1:3: a step must be a name, or a name with its fields, not a list"),
        ("- MaskDepth: [1]", "p.yaml:1:14: MaskDepth must be a mapping of names to values, not a list"),
        ("- MaskDepth: 3", "p.yaml:1:14: MaskDepth must be a mapping of names to values, not the single value '3'"),
        (
            "Center: {}",
            "p.yaml:1:1: unknown section 'Center'; a pipeline has depth, cloud, augment; a list of steps has",
        ),
        (
            "Center",
            "p.yaml:1:1: a pipeline must be a list, each entry starting with '- ', not the single value 'Center'",
        ),
        ("- MaskDepth: {near: 2.0, far: 1.0}", "p.yaml:1:3: MaskDepth: near must be below far, got near=2.0, far=1.0"),
        ("- MaskDepth: {near: !!int x}", "p.yaml:1:21: YAML tags (tag:yaml.org,2002:int) are not allowed"),
        ("- MaskDepth: {near: 2024-13-45}", "p.yaml:1:21: cannot read this value: month must be in 1..12"),
        (
            "- ToFrame: {frame: !!python/name:os.system x}",
            "p.yaml:1:20: YAML tags (tag:yaml.org",
        ),
        ("- Center\n- {a: b", "p.yaml:2:8: not valid YAML: expected ',' or '}'"),
        ("- Center: {}\n---\n- Center", "p.yaml:2:1: not valid YAML: but found another document"),
        ("- Deproject\n- Deproject", "p.yaml:2:3: step 2, Deproject, takes a DepthFrame"),
        (
            "- \x00",
            "p.yaml: not valid YAML: character 2 is number 0, which no text has; is it another file",
        ),
        ("[" * 700, "p.yaml:1:51: nested too deeply"),
        ("#" * 1_000_001, "p.yaml: 1000001 characters are no file of this kind"),
    ],
    ids=lambda value: value[:40] if len(value) < 400 else "long",
)
def test_each_fault_is_told_with_its_place(text, expected):
    assert faults(text)[0].startswith(expected)


def test_one_fault_is_told_once():
    for text in ("- [Center]", "- Deprojct", "- MaskDepth: 3", "- MaskDepth: {near: 1, near: 2}", "- {}"):
        assert len(faults(text)) == 1


def test_all_faults_are_told_at_once_in_the_order_of_the_file():
    told = faults(
        "- Deprojct\n"
        "- MaskDepth: {near: -1, fra: 2}\n"
        "- CropWorkspace: {frame: base, lower: [0, 0], upper: [1, 1, 1]}\n"
        "- RandomApply:\n"
        "    probability: 2\n"
        "    step: Flip\n"
        "- Center: {}\n"
        "- Center\n"
    )
    assert [line.split(": ")[0] for line in told] == [
        "p.yaml:1:3", "p.yaml:2:21", "p.yaml:2:25", "p.yaml:3:39", "p.yaml:5:18", "p.yaml:6:11",
    ]  # fmt: skip


def test_plain_data_may_use_one_list_twice():
    lower, upper = [0.0, 0.0, 0.0], [1.0, 1.0, 1.0]
    box = {"frame": "base", "lower": lower, "upper": upper}
    pipeline = T.Compose.from_config([{"CropWorkspace": box}, {"NormalizeWorkspace": box}])
    assert pipeline.steps[0].lower == pipeline.steps[1].lower == (0.0, 0.0, 0.0)
    assert T.Compose.from_config(["Center"]).fingerprint() == T.Compose([T.Center()]).fingerprint()
    with pytest.raises(ConfigError, match=r"^<config>: VoxelDownsample\.voxel_size: Input should be a valid number"):
        T.Compose.from_config([{"VoxelDownsample": {"voxel_size": object()}}])


def test_a_file_is_named_in_its_faults(tmp_path):
    path = tmp_path / "steps.yaml"
    path.write_text("- Center\n- Cente\n")
    with pytest.raises(ConfigError, match=r"steps\.yaml:2:3: unknown transform 'Cente'"):
        T.Compose.load(path)
    with pytest.raises(ConfigError, match=r"missing\.yaml: no such file"):
        T.Compose.load(tmp_path / "missing.yaml")
    path.write_bytes(b"\xff\xfe")
    with pytest.raises(ConfigError, match=r"steps\.yaml: must be"):
        T.Compose.load(path)


def test_fields_given_in_python_are_checked_the_same_way():
    with pytest.raises(ConfigError) as caught:
        T.CropWorkspace(frame="base", lower=[0, 0], upper=3)
    assert str(caught.value).splitlines() == [
        "CropWorkspace.lower.2: Field required",
        "CropWorkspace.upper: Input should be a valid tuple (got 3), or: Input should be a valid string (got 3)",
    ]
    with pytest.raises(TypeError, match="voxel_sise"):
        T.VoxelDownsample(voxel_sise=1)
    with pytest.raises(TypeError, match="positional"):
        T.VoxelDownsample(0.01)


def test_arrays_and_lists_become_plain_values_that_cannot_change():
    import numpy as np

    lower = [0.0, 0.0, 0.0]
    step = T.CropWorkspace(frame="base", lower=lower, upper=np.ones(3, dtype=np.float32))
    lower[0] = 9.0
    assert (step.lower, step.upper) == ((0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
    assert T.RandomSample(num_points=np.int64(5)).num_points == 5
    labels = [1, 2]
    mask = T.MaskDepth(drop_labels=labels)
    labels.append(3)
    assert mask.drop_labels == (1, 2)
