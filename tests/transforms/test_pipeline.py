from __future__ import annotations

import copy
import pickle
import warnings

import pytest

from pcdata import transforms as T
from pcdata.errors import ConfigError
from pcdata.rng import seeded
from tests.factories import assert_same, cloud_in_camera, tabletop_frame

BOX = {"frame": "base", "lower": (-0.4, -0.4, -0.05), "upper": (0.4, 0.4, 0.5)}


def pipeline(**changes) -> T.Pipeline:
    sections = {
        "depth": [T.MaskDepth(far=3.0), T.Deproject()],
        "cloud": [T.ToFrame(frame="base"), T.CropWorkspace(**BOX), T.MergeViews(), T.VoxelDownsample(voxel_size=0.02)],
        "augment": [T.RandomRotation(), T.RandomJitter(), T.NormalizeUnitSphere()],
    }
    return T.Pipeline(**{**sections, **changes})


def test_a_capture_runs_through_all_sections():
    result = pipeline()(tabletop_frame(), generator=seeded(0))
    names = [step["step"] for step in result.history[0]]
    assert names == [
        type(step).__name__ for section in ("depth", "cloud", "augment") for step in getattr(pipeline(), section)
    ]
    assert result.num_clouds == 1
    assert result.unit == "normalized"


def test_a_cloud_enters_at_the_section_cloud():
    result = pipeline()(cloud_in_camera((60, 50)), generator=seeded(0))
    assert [step["step"] for step in result.history[0]][:2] == ["Recorded", "ToFrame"]
    assert result.num_clouds == 2


def test_every_step_can_be_looked_at():
    steps = [type(step).__name__ for step, _ in pipeline().step_through(tabletop_frame(), generator=seeded(0))]
    assert steps[:2] == ["MaskDepth", "Deproject"]
    assert len(steps) == 9


@pytest.mark.parametrize("seed", range(3))
def test_prefix_and_suffix_give_what_the_whole_gives(seed):
    whole, frame = pipeline(), tabletop_frame()
    prefix, suffix = whole.deterministic_prefix(), whole.random_suffix()
    assert [len(prefix.depth), len(prefix.cloud), len(prefix.augment)] == [2, 4, 0]
    assert_same(suffix(prefix(frame), generator=seeded(seed)), whole(frame, generator=seeded(seed)))


def test_the_prefix_ends_at_the_first_random_step_wherever_it_is():
    cloud = [T.ToFrame(frame="base"), T.RandomPointDropout(), T.MergeViews()]
    prefix = pipeline(cloud=cloud).deterministic_prefix()
    assert [len(prefix.depth), len(prefix.cloud), len(prefix.augment)] == [2, 1, 0]
    fixed = pipeline(augment=[T.NormalizeUnitSphere()])
    assert len(fixed.deterministic_prefix().augment) == 1
    assert not fixed.is_random


def test_the_prefix_reaches_into_nested_chains_of_a_section():
    flat = [T.ToFrame(frame="base"), T.Center(), T.RandomPointDropout()]
    nested = pipeline(cloud=[flat[0], T.Compose(flat[1:])])
    prefix = nested.deterministic_prefix()
    assert [len(prefix.depth), len(prefix.cloud), len(prefix.augment)] == [2, 2, 0]
    assert nested.fingerprint() == pipeline(cloud=flat).fingerprint()


def test_the_fingerprint_is_that_of_what_a_cache_holds():
    same = pipeline(augment=[T.RandomScale()])
    assert same.fingerprint() == pipeline().fingerprint()
    other = pipeline(depth=[T.MaskDepth(far=2.0), T.Deproject()])
    assert other.fingerprint() != pipeline().fingerprint()
    assert other.difference(pipeline()) == "in depth, step 1: MaskDepth(far=2.0) here, MaskDepth(far=3.0) there"
    shorter = pipeline(cloud=[T.ToFrame(frame="base")])
    assert "in cloud, step 2: nothing here, CropWorkspace" in shorter.difference(pipeline())


def test_sections_must_fit_together():
    with pytest.raises(ConfigError, match="depth must end in points; put Deproject last"):
        T.Pipeline(depth=[T.MaskDepth()])
    with pytest.raises(ConfigError, match="depth must start with a step that takes a capture, not with Center"):
        T.Pipeline(depth=[T.Center()])
    with pytest.raises(ConfigError, match="Deproject takes a DepthFrame; it belongs into the section depth, not cloud"):
        T.Pipeline(cloud=[T.Deproject()])
    with pytest.raises(ConfigError, match="works in frame 'base' but the cloud is in 'camera'"):
        T.Pipeline(depth=[T.Deproject()], cloud=[T.CropWorkspace(**BOX)])
    with pytest.raises(ConfigError, match="a depth capture was given but the section depth is empty"):
        T.Pipeline(cloud=[T.Center()])(tabletop_frame())


def test_the_order_is_warned_about_once():
    with pytest.warns(T.PipelineOrderWarning) as caught:
        slow = pipeline(cloud=[T.ToFrame(frame="base"), T.RemoveStatisticalOutliers(), T.CropWorkspace(**BOX)])
    assert len(caught) == 1
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        slow.random_suffix()
        slow.fingerprint()


def test_every_way_of_writing_it_down_leads_back(tmp_path):
    path = tmp_path / "pipeline.yaml"
    path.write_text(pipeline().to_yaml())
    frame = tabletop_frame()
    expected = pipeline()(frame, generator=seeded(0))
    ways = [
        T.Pipeline.load(path),
        T.Pipeline.from_config(pipeline().to_config()),
        pickle.loads(pickle.dumps(pipeline())),
        copy.deepcopy(pipeline()),
    ]
    for twin in ways:
        assert twin.fingerprint() == pipeline().fingerprint()
        assert twin.to_config() == pipeline().to_config()
        assert_same(twin(frame, generator=seeded(0)), expected)


def test_unknown_sections_and_faults_in_any_section_are_told_together():
    with pytest.raises(ConfigError) as caught:
        T.Pipeline.from_yaml("depth:\n  - Deprojekt\naugmentation: []\ncloud:\n  - Centre\n", name="p.yaml")
    own = "one of your own needs --import FILE.py"
    assert str(caught.value).splitlines() == [
        f"p.yaml:2:5: unknown transform 'Deprojekt'; did you mean 'Deproject'?; {own}",
        "p.yaml:3:1: unknown section 'augmentation'; a pipeline has depth, cloud, augment",
        f"p.yaml:5:5: unknown transform 'Centre'; did you mean 'Center' or 'CropCenter'?; {own}",
    ]
    with pytest.raises(ConfigError, match=r"^p\.yaml: Pipeline: .* must end in points"):
        T.Pipeline.from_yaml("depth: [MaskDepth]", name="p.yaml")
