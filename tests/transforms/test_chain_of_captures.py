from __future__ import annotations

import copy
import pickle
import warnings

import pytest

from pcdata import transforms as T
from pcdata.errors import ConfigError, DTypeError
from pcdata.rng import seeded
from tests.factories import assert_same, cloud_in_camera, tabletop_frame

BOX = {"frame": "base", "lower": (-0.4, -0.4, -0.05), "upper": (0.4, 0.4, 0.5)}


DEPTH = [T.MaskDepth(far=3.0), T.Deproject()]
CLOUD = [T.ToFrame(frame="base"), T.CropWorkspace(**BOX), T.MergeViews(), T.VoxelDownsample(voxel_size=0.02)]
RANDOM = [T.RandomRotation(), T.RandomJitter(), T.NormalizeUnitSphere()]


def chain(depth=DEPTH, cloud=CLOUD, augment=RANDOM) -> T.Compose:
    return T.Compose([*depth, *cloud, *augment])


def names(steps) -> list[str]:
    return [type(step).__name__ for step in steps]


def test_a_capture_runs_through_all_steps():
    result = chain()(tabletop_frame(), generator=seeded(0))
    assert [step["step"] for step in result.history[0]] == names(chain().steps)
    assert result.num_clouds == 1
    assert result.unit == "normalized"


def test_a_cloud_enters_at_the_first_step_that_takes_one():
    result = chain()(cloud_in_camera((60, 50)), generator=seeded(0))
    assert [step["step"] for step in result.history[0]] == ["Recorded", *names(CLOUD), *names(RANDOM)]
    cloud = cloud_in_camera()
    assert T.Compose(DEPTH)(cloud) is cloud
    assert [step for step, _ in T.Compose(DEPTH).step_through(cloud)] == []
    with pytest.raises(DTypeError, match="MaskDepth takes a DepthFrame, got PointCloud"):
        T.Compose([T.MaskDepth()])(cloud)


def test_a_cloud_needs_no_generator_for_a_random_step_before_it():
    noisy = T.Compose([T.RandomSensorNoise(sensor="realsense_d435"), T.Deproject(), T.Center()])
    cloud = cloud_in_camera()
    assert_same(noisy(cloud), T.Center()(cloud))
    with pytest.raises(ConfigError, match="Compose is random and needs generator"):
        noisy(tabletop_frame())


def test_a_capture_is_refused_by_a_chain_of_clouds():
    with pytest.raises(DTypeError, match=r"Center .*PointCloud.*DepthFrame.*Deproject"):
        T.Compose([T.Center()])(tabletop_frame())


def test_every_step_can_be_looked_at():
    assert names(step for step, _ in chain().step_through(tabletop_frame(), generator=seeded(0))) == names(
        chain().steps
    )


@pytest.mark.parametrize("seed", range(3))
def test_prefix_and_suffix_give_what_the_whole_gives(seed):
    whole, frame = chain(), tabletop_frame()
    prefix, suffix = whole.split()
    assert [len(prefix), len(suffix)] == [6, 3]
    assert_same(suffix(prefix(frame), generator=seeded(seed)), whole(frame, generator=seeded(seed)))


def test_what_may_be_stored_ends_at_the_first_random_step_wherever_it_is():
    prefix, _ = chain(cloud=[T.ToFrame(frame="base"), T.RandomPointDropout(), T.MergeViews()]).split()
    assert names(prefix.steps) == ["MaskDepth", "Deproject", "ToFrame"]
    assert prefix.sections()["augment"] == []
    fixed = chain(augment=[T.NormalizeUnitSphere()])
    assert len(fixed.split()[0]) == 7
    assert not fixed.is_random


def test_the_stored_fingerprint_is_that_of_what_a_dataset_holds():
    assert chain(augment=[T.RandomScale()]).stored_fingerprint() == chain().stored_fingerprint()
    assert chain().split()[0].stored_fingerprint() == chain().stored_fingerprint()
    other = chain(depth=[T.MaskDepth(far=2.0), T.Deproject()])
    assert other.stored_fingerprint() != chain().stored_fingerprint()
    assert other.difference(chain()) == "step 1: MaskDepth(far=2.0) here, MaskDepth(far=3.0) there"
    shorter = chain(cloud=[T.ToFrame(frame="base")])
    assert "step 4: nothing here, CropWorkspace" in shorter.difference(chain())


def test_datasets_of_before_keep_their_fingerprint():
    # Of a dataset that was built when the sections were three chains.
    text = "depth: [MaskDepth: {near: 0.1, far: 3.0}, Deproject]\ncloud: [Center]\naugment: [RandomJitter]"
    assert (
        T.Compose.from_yaml(text).stored_fingerprint()
        == "622b6e922f8c58083b6833d96fcbbdb4b9c078f725e307234c2d1acf00b49a68"
    )


def test_sections_must_fit_together():
    def told(text: str) -> str:
        with pytest.raises(ConfigError) as caught:
            T.Compose.from_yaml(text, name="p.yaml")
        return str(caught.value)

    box = "CropWorkspace: {frame: base, lower: [0, 0, 0], upper: [1, 1, 1]}"
    assert told("depth:\n- MaskDepth\ncloud: [Center]") == (
        "p.yaml:2:3: the section depth must end in points; put Deproject last"
    )
    assert told("depth:\n- Center\n- Deproject") == (
        "p.yaml:2:3: Center takes a PointCloud; it belongs into the section cloud, not depth"
    )
    assert told("depth: [Deproject, Deproject]") == (
        "p.yaml:1:20: Deproject takes a DepthFrame; the steps before it give a cloud already: put it before them, or "
        "leave it out"
    )
    for section in ("cloud", "augment"):
        assert told(f"{section}:\n- Center\n- Deproject") == (
            f"p.yaml:3:3: Deproject takes a DepthFrame; it belongs into the section depth, not {section}"
        )
    assert told(f"depth: [Deproject]\ncloud:\n- {box}") == (
        "p.yaml:3:3: step 2, CropWorkspace, works in frame 'base' but the cloud is in 'camera' there; put "
        "ToFrame(frame='base') before it"
    )


def test_the_order_is_warned_about_once():
    text = "RemoveStatisticalOutliers, CropWorkspace: {frame: base, lower: [0, 0, 0], upper: [1, 1, 1]}"
    with pytest.warns(T.PipelineOrderWarning) as caught:
        slow = T.Compose.from_yaml(f"depth: [Deproject]\ncloud: [ToFrame: {{frame: base}}, {text}]")
    assert len(caught) == 1
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        slow.split()
        slow.stored_fingerprint()


def test_every_way_of_writing_it_down_leads_back(tmp_path):
    path = tmp_path / "pipeline.yaml"
    path.write_text(chain().to_yaml())
    frame = tabletop_frame()
    expected = chain()(frame, generator=seeded(0))
    ways = [
        T.Compose.load(path),
        T.Compose.from_config(chain().sections()),
        T.Compose.from_config([step.to_config() for step in chain().steps]),
        T.Compose.from_config([chain().to_config()]),
        pickle.loads(pickle.dumps(chain())),
        copy.deepcopy(chain()),
    ]
    for twin in ways:
        assert twin.fingerprint() == chain().fingerprint()
        assert twin.to_config() == chain().to_config()
        assert twin.sections() == chain().sections()
        assert_same(twin(frame, generator=seeded(0)), expected)


def test_unknown_sections_and_faults_in_any_section_are_told_together():
    with pytest.raises(ConfigError) as caught:
        T.Compose.from_yaml("depth:\n  - Deprojekt\naugmentation: []\ncloud:\n  - Centr\n", name="p.yaml")
    own = "one of your own needs --import FILE.py"
    assert str(caught.value).splitlines() == [
        f"p.yaml:2:5: unknown transform 'Deprojekt'; did you mean 'Deproject'?; {own}",
        "p.yaml:3:1: unknown section 'augmentation'; a pipeline has depth, cloud, augment",
        f"p.yaml:5:5: unknown transform 'Centr'; did you mean 'Center' or 'CropCenter'?; {own}",
    ]


@pytest.mark.parametrize(
    ("config", "expected"),
    [
        ({"depth": ["Deprojekt"]}, "c: unknown transform 'Deprojekt'"),
        ({"depth": "Deproject"}, "c: section depth must be a list, not str 'Deproject'"),
        ({"cloud": [{"Center": 3}]}, "c: Center must be a mapping of names to values, not int 3"),
        ({"cloud": [{"Center": {}, "ToFrame": {}}]}, "c: a step is one name with its fields, got 2 names"),
        (
            {"cloud": [{"MaskDepth": {}}]},
            "c: MaskDepth takes a DepthFrame; it belongs into the section depth, not cloud",
        ),
        ({"cloud": [["Center"]]}, "c: a step must be a name, or a name with its fields, not a list"),
        ({"cloud": [{"VoxelDownsample": {"voxel_size": "small"}}]}, "c: VoxelDownsample.voxel_size: Input should be a"),
        ({"cloud": [{1: {}}]}, "c: a step must be a mapping of names to values, not dict {1: {}}"),
        ({"clouds": []}, "c: unknown section 'clouds'"),
        (5, "c: a pipeline must be a list, not int 5"),
    ],
)
def test_faults_of_plain_data_are_told(config, expected):
    with pytest.raises(ConfigError) as caught:
        T.Compose.from_config(config, name="c")
    assert str(caught.value).splitlines()[0].startswith(expected)
