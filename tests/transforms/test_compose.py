from __future__ import annotations

import copy
import pickle
import warnings

import pytest
import torch

from pcdata import transforms as T
from pcdata.errors import ConfigError, DTypeError, ShapeError, TooFewPointsError
from pcdata.rng import seeded
from pcdata.structures import DepthFrame, PointCloud
from tests.factories import (
    assert_same,
    cloud_in_base,
    cloud_in_camera,
    differences,
    frame_with_counts,
    tabletop_frame,
    tree,
)
from tests.messages import told
from tests.transforms.examples import ALL

BOX = {"frame": "base", "lower": (-0.15, -0.15, -0.01), "upper": (0.15, 0.15, 0.2)}


def chain() -> T.Compose:
    return T.Compose(
        [
            T.CropWorkspace(**BOX),
            T.VoxelDownsample(voxel_size=0.01),
            T.RandomRotation(),
            T.NormalizeUnitSphere(),
            T.RandomJitter(),
            T.RandomSample(num_points=20),
        ]
    )


# -- building ------------------------------------------------------------------------------------------------------


def test_neighbors_that_do_not_fit_are_refused_when_the_chain_is_built():
    with pytest.raises(ConfigError, match="step 2, Center, takes a PointCloud but step 1, MaskDepth, gives a DepthFr"):
        T.Compose([T.MaskDepth(), T.Center()])
    with pytest.raises(ConfigError, match="takes a DepthFrame but step 1, Center, gives a PointCloud"):
        T.Compose([T.Center(), T.Deproject()])
    with pytest.raises(ConfigError, match="step 2, CropWorkspace, works in frame 'base' but the cloud is in 'camera'"):
        T.Compose([T.Deproject(), T.CropWorkspace(**BOX)])
    with pytest.raises(ConfigError, match="step 2, RemovePlane, works in metres but the cloud is normalized there"):
        T.Compose([T.NormalizeUnitSphere(), T.RemovePlane()])
    nested = T.Compose([T.ToFrame(frame="base"), T.Compose([T.ToFrame(frame="table")])])
    with pytest.raises(ConfigError, match="works in frame 'base' but the cloud is in 'table' there"):
        T.Compose([nested, T.CropWorkspace(**BOX)])


def test_a_chain_is_made_of_transforms():
    with pytest.raises(ConfigError, match=r"Compose\.steps\.1"):
        T.Compose([T.Center(), "Center"])


def test_a_chain_knows_what_it_takes_gives_and_draws():
    steps = [T.MaskDepth(), T.Deproject(), T.ToFrame(frame="base")]
    assert (T.Compose(steps).takes, T.Compose(steps).gives) == (DepthFrame, PointCloud)
    assert not T.Compose(steps).is_random
    assert T.Compose([*steps, T.Compose([T.RandomFlip()])]).is_random
    assert len(T.Compose(steps)) == 3


def test_the_empty_chain_changes_nothing():
    cloud = cloud_in_base()
    assert T.Compose([])(cloud) is cloud


def test_statistics_before_the_crop_are_warned_about_once_and_where_they_were_written():
    steps = [T.RemoveStatisticalOutliers(), T.CropWorkspace(**BOX)]
    with pytest.warns(T.PipelineOrderWarning, match="RemoveStatisticalOutliers runs before CropWorkspace") as caught:
        pipeline = T.Compose(steps)
    assert [warning.filename for warning in caught] == [__file__]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        pipeline.split()
        T.Compose(steps[::-1])
        T.Compose([T.CropWorkspace(**BOX), *steps])


# -- running -------------------------------------------------------------------------------------------------------


def test_a_chain_is_its_steps_one_after_another():
    cloud = cloud_in_camera()
    steps = [T.ToFrame(frame="base"), T.CropWorkspace(**BOX), T.NormalizeUnitSphere()]
    one_by_one = cloud
    for step in steps:
        one_by_one = step(one_by_one)
    assert_same(T.Compose(steps)(cloud), one_by_one)


def test_every_step_can_be_looked_at():
    cloud = cloud_in_base()
    seen = list(chain().step_through(cloud, generator=seeded(0)))
    assert [type(step).__name__ for step, _ in seen] == [type(step).__name__ for step in chain().steps]
    assert [len(data.history[0]) for _, data in seen] == list(range(2, 8))
    assert_same(seen[-1][1], chain()(cloud, generator=seeded(0)))


def test_nesting_changes_nothing():
    flat = chain()
    steps = list(flat.steps)
    nested = T.Compose([T.Compose(steps[:2]), T.Compose([T.Compose(steps[2:4]), *steps[4:]])])
    assert_same(flat(cloud_in_base(), generator=seeded(4)), nested(cloud_in_base(), generator=seeded(4)))


@pytest.mark.parametrize("seed", range(3))
def test_prefix_and_suffix_give_what_the_whole_gives(seed):
    whole = chain()
    prefix, suffix = whole.split()
    assert [len(prefix), len(suffix)] == [2, 4]
    assert not prefix.is_random
    cloud = cloud_in_base()
    assert_same(suffix(prefix(cloud), generator=seeded(seed)), whole(cloud, generator=seeded(seed)))


def test_a_split_looks_inside_nested_chains():
    steps = list(chain().steps)
    nested = T.Compose([steps[0], T.Compose(steps[1:4]), T.Compose(steps[4:])])
    prefix, suffix = nested.split()
    assert [len(prefix), len(suffix)] == [2, 4]
    assert prefix.fingerprint() == chain().split()[0].fingerprint()
    cloud = cloud_in_base()
    assert_same(suffix(prefix(cloud), generator=seeded(1)), chain()(cloud, generator=seeded(1)))


def test_a_chain_without_random_steps_is_all_prefix():
    prefix, suffix = T.Compose([T.Center(), T.NormalizeUnitSphere()]).split()
    assert [len(prefix), len(suffix)] == [2, 0]


def test_random_steps_of_a_chain_draw_different_numbers():
    twice = T.Compose([T.RandomTranslation(), T.RandomTranslation()])(cloud_in_base((10,)), generator=seeded(0))
    first, second = (step["params"]["matrix"] for step in twice.history[0][-2:])
    assert first != second


def test_adding_a_step_at_the_end_leaves_the_draws_before_it():
    cloud = cloud_in_base()
    short, long = T.Compose([T.RandomRotation()]), T.Compose([T.RandomRotation(), T.RandomJitter(sigma=0.0)])
    assert torch.equal(short(cloud, generator=seeded(1)).points, long(cloud, generator=seeded(1)).points)


def test_the_number_of_generators_is_checked_before_the_first_step():
    with pytest.raises(ShapeError, match="2 generators were given for 3 clouds"):
        chain()(cloud_in_base(), generator=[seeded(0), seeded(1)])
    with pytest.raises(DTypeError, match="generator must be"):
        chain()(cloud_in_base(), generator="seed")
    with pytest.raises(ConfigError, match="Compose is random and needs generator"):
        chain()(cloud_in_base())


def test_an_error_tells_step_and_cloud():
    far = T.CropWorkspace(frame="base", lower=(8, 8, 8), upper=(9, 9, 9))
    with pytest.raises(TooFewPointsError) as caught:
        T.Compose([T.Center(), T.ToFrame(frame="base", start="base/centered", matrix=torch.eye(4)), far])(
            cloud_in_base((7,))
        )
    error = caught.value
    notes = told(error)
    assert "in CropWorkspace(frame='base', lower=(8.0, 8.0, 8.0)" in notes
    assert "PointCloud(7 points in 'base'" in notes


# -- RandomApply ---------------------------------------------------------------------------------------------------


def test_random_apply_applies_as_often_as_it_says():
    counts = (1,) * 400
    cloud = cloud_in_base(counts)
    flipped = T.RandomApply(step=T.RandomFlip(probability=(1, 0, 0)), probability=0.3)
    moved = flipped(cloud, generator=seeded(0)).points[:, 0] != cloud.points[:, 0]
    assert 0.3 - 0.1 < float(moved.double().mean()) < 0.3 + 0.1  # 4 standard deviations are 0.09


@pytest.mark.parametrize("probability", [0.0, 1.0])
def test_random_apply_never_or_always(probability):
    cloud = cloud_in_base()
    inner = T.RandomFlip(probability=(1, 1, 1))
    result = T.RandomApply(step=inner, probability=probability)(cloud, generator=seeded(0))
    expected = inner(cloud, generator=seeded(9)) if probability else cloud
    assert torch.equal(result.points, expected.points)
    names = [[step["step"] for step in steps] for steps in result.history]
    assert names == [["Recorded", *["RandomFlip"] * bool(probability), "RandomApply"]] * 3


def test_clouds_not_chosen_stay_bit_for_bit():
    cloud = cloud_in_base((20,) * 12)
    result = T.RandomApply(step=T.RandomRotation(axis=None))(cloud, generator=seeded(0))
    for before, after in zip(cloud.unbatch(), result.unbatch()):
        chosen = after.history[0][-1]["params"]["chosen"]
        assert torch.equal(before.points, after.points) != chosen


def test_whether_a_cloud_is_chosen_shifts_no_later_draw():
    cloud = cloud_in_base((20,))
    results = [
        T.Compose([T.RandomApply(step=T.RandomFlip(), probability=p), T.RandomScale()])(cloud, generator=seeded(5))
        for p in (0.0, 1.0)
    ]
    factors = [result.history[0][-1]["params"]["matrix"] for result in results]
    assert factors[0] == factors[1]


def test_random_apply_takes_what_its_step_takes_and_gives():
    with pytest.raises(ConfigError, match="RandomApply: Deproject does not turn captures into captures"):
        T.RandomApply(step=T.Deproject())
    noise = T.RandomApply(step=T.RandomSensorNoise(sensor="realsense_d435"), probability=0.5)
    chain = T.Compose([noise, T.Deproject(), T.RandomApply(step=T.RandomFlip())])
    frame, drawn = tabletop_frame(2), set()
    for seed in range(8):
        result = chain(frame, generator=seeded(seed))
        noisy = bool((noise(frame, generator=seeded(seed)).depth != frame.depth).any())
        assert noisy == any(entry["step"] == "RandomSensorNoise" for entry in result.history[0])
        assert_same(chain.replay(frame, list(result.history)), result)
        drawn.add(noisy)
    assert drawn == {False, True}
    with pytest.raises(ConfigError, match=r"step 2, RandomApply, takes a DepthFrame"):
        T.Compose([T.Deproject(), noise])
    with pytest.raises(ConfigError, match=r"RandomApply\.probability"):
        T.RandomApply(step=T.Center(), probability=1.5)
    with pytest.raises(ConfigError, match=r"RandomApply\.step: .*instance of Transform"):
        T.RandomApply(step="Center")


# -- copies --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("twin", [copy.deepcopy, lambda t: pickle.loads(pickle.dumps(t))])
def test_copies_of_a_chain_give_the_same(twin):
    cloud = cloud_in_base()
    assert not differences(tree(chain()(cloud, generator=seeded(0))), tree(twin(chain())(cloud, generator=seeded(0))))
    assert twin(chain()).fingerprint() == chain().fingerprint()


def test_the_fingerprint_depends_on_the_order():
    steps = [T.Center(), T.NormalizeUnitSphere()]
    assert T.Compose(steps).fingerprint() != T.Compose(steps[::-1]).fingerprint()


def test_a_chain_of_captures_runs_to_clouds():
    result = T.Compose([T.MaskDepth(use_mask=False), T.Deproject(), T.RandomRotation()])(
        frame_with_counts((20, 30)), generator=seeded(0)
    )
    assert result.counts.tolist() == [20, 30]
    assert result.history[0][-1]["params"] != result.history[1][-1]["params"]


# -- inside another module -------------------------------------------------------------------------------------------


def test_a_policy_that_holds_transforms_is_a_module_like_any_other(tmp_path):
    policy = torch.nn.Sequential()
    policy.points = T.Compose([T.Center(), T.RandomApply(step=T.RandomFlip(), probability=0.5)])
    policy.others = torch.nn.ModuleList([example.transform for example in ALL])
    policy.head = torch.nn.Linear(3, 2)
    seen = []
    assert policy.apply(lambda module: seen.append(type(module).__name__)) is policy
    assert {*T.REGISTRY, "Linear"} <= {*seen}
    policy.to(torch.float64).train().eval().requires_grad_(False).share_memory().zero_grad()
    torch.save(policy.state_dict(), tmp_path / "policy.pt")
    policy.load_state_dict(torch.load(tmp_path / "policy.pt", weights_only=True))
    cloud = cloud_in_base((20, 30))
    for twin in (pickle.loads(pickle.dumps(policy)), copy.deepcopy(policy)):
        assert repr(twin.points) == repr(policy.points)
        assert torch.equal(
            twin.points(cloud, generator=seeded(1)).points, policy.points(cloud, generator=seeded(1)).points
        )
