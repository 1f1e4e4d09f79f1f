"""Other policies on point clouds: RISE, PerAct and others."""

from dataclasses import replace

from pcdata.models.contract import (
    RGB_IMAGENET,
    RGB_SIGNED,
    RGB_UNIT,
    XYZ,
    Channel,
    InputTensor,
    ModelContract,
    Role,
)

RISE = ModelContract(
    name="rise",
    title="RISE",
    source="rise-policy/RISE 58a61fd: dataset/realworld.py:139-271; utils/constants.py:12-13",
    tensors=(
        InputTensor("input_feats_list", "S C", (XYZ, RGB_IMAGENET)),
        InputTensor(
            "input_coords_list",
            "S C",
            (Channel("cloud", 1, Role.OTHER), Channel("cells", 3, Role.OTHER)),
            "int32",
            "cells_of_batch",
        ),
    ),
    far=3.0,  # Open3D's depth_trunc: what lies beyond would move the corner that the voxels are counted from
    voxel=0.005,
    crop=((-0.5, -0.5, 0.0), (0.5, 0.5, 1.0)),
    crop_before_voxels=False,
    max_duplicates=0.1,
    guide="Guides sample a fixed count; RISE takes as many 5 mm voxels as there are.",
    traps=(
        "Features are metres and colors, not voxel indices.",
        "Cells are cast to integers: cut toward zero, not floored, so the cells next to each axis plane are twice "
        "as wide.",
        "Readings beyond 3 m are dropped before the voxels, as Open3D does by default: they would move the grid.",
        "Actions are projected into the camera frame too.",
    ),
    wrong_frame="The 1 m box is cut out in front of the camera: in the base frame it keeps another part of the scene, "
    "or nothing.",
    checked=(
        "rise-policy/RISE 418178a dataset/realworld.py, 76d94ae utils/constants.py: Open3D's voxels, then the closed "
        "box, ImageNet colors, cells cut toward zero in float64, the cloud's number first. Its load_point_cloud and "
        "the preset gave the same voxels on two noisy synthetic captures: as many, in the same cells; 1 in 7,000 "
        "averages is off by up to 0.4 mm, where rounding puts a point into the next voxel. An export ran through "
        "all of RealWorldDataset: poses in the camera's frame to 0.0001 mm, widths, every pixel's point and color. The "
        "network needs MinkowskiEngine: not run.",
    ),
)

RISE2 = replace(
    RISE,
    name="rise2",
    title="RISE-2",
    source="rise-policy/RISE-2 3cc56ae: dataset/realworld.py:170-330; dataset/data_utils.py; configs/*.yaml",
    tensors=(
        InputTensor("cloud_feats", "S C", (XYZ,)),
        InputTensor("cloud_coords", "S C", RISE.tensors[1].channels, "int32", "cells_of_batch"),
    ),
    decimation=2,
    crop=None,
    crop_is_open=True,
    crop_before_voxels=True,
    guide="",
    traps=(
        "The cloud has no colors: features are xyz alone. Colors enter as an image, image_feats, with the coordinates "
        "of its patches, image_coords: those two tensors the preset does not make.",
        "The workspace belongs to the robot: [-0.7, -0.3, 0.9] to [0.7, 0.55, 1.55] in its dual-arm configurations, in "
        "the camera frame. It is cut out before the voxels are counted, in RISE after.",
        "The cloud is made at half the image's size: every second pixel of every second row. The preset takes the "
        "median reading of each 2 x 2 block: as many points, half a pixel beside, no flying ones more.",
        "Cells are cast to integers: cut toward zero, not floored.",
        "Actions are projected into the camera frame too, and turned with the cloud about its mean.",
    ),
    wrong_frame=RISE.wrong_frame.replace("The 1 m box", "The workspace"),
    checked=(
        "rise-policy/RISE-2 61624a8 dataset/realworld.py, 74f0a21 dataset/data_utils.py, 62b7478 "
        "configs/dual_teleop_dino.yaml: half size, Open3D's 3 m, the box, then voxels of 5 mm; xyz float32 and cells "
        "int32, cut toward zero. The network needs MinkowskiEngine: not run.",
    ),
)

POINTFLOWMATCH = ModelContract(
    name="pointflowmatch",
    title="PointFlowMatch",
    source="watermelon097/PointFlowMatch 1d394dd, a fork: pfp/data/dataset_pcd.py, pfp/envs/rlbench_env.py, "
    "pfp/common/o3d_utils.py; machine-solution/point-flow-match-fork 2b8ded9, 09a2a15: conf/train.yaml, "
    "conf/model/flow.yaml (the original, robot-learning-freiburg/PointFlowMatch, was out of reach)",
    tensors=(InputTensor("pcd", "B N C", (XYZ,)),),
    stored=(RGB_UNIT,),
    frame="",
    axes="world, z up",
    count=4096,
    any_count=True,
    sampler="random",
    pad="zeros",
    voxel=0.01,
    crop_is_open=True,
    table="open",
    traps=(
        "The policy subtracts norm_pcd_center, [0.4, 0, 1.4] for RLBench, by itself: the batch stays in the world. In "
        "another world that center must be yours.",
        "Clouds are recorded as 5500 points of 10 mm voxels, short ones filled up with zeros; the loader draws 4096 of "
        "those at random, zeros among them. The preset draws 4096 of the voxels.",
        'use_pc_color is off: three channels. With it colors in [0, 1] follow (channels=["xyz", "rgb"]).',
        "Five cameras are joined before the voxels: give captures of all views.",
        "Its states hold the rotation as the first two columns of the matrix, one after the other.",
    ),
    wrong_frame="norm_pcd_center is a place in the world: in another frame it moves the cloud away from the origin "
    "instead of to it, and the states with it.",
    checked=(
        "watermelon097/PointFlowMatch 1d394dd pfp/data/dataset_pcd.py, pfp/envs/rlbench_env.py, "
        "pfp/common/o3d_utils.py: box, voxels of 10 mm, random points or zero rows, 4096 drawn without replacement. "
        "The size of the voxels is an argument; 10 mm is what its example gives. Read, not run.",
        "machine-solution/point-flow-match-fork 2b8ded9 conf/train.yaml, 09a2a15 conf/model/flow.yaml: n_points 4096, "
        "use_pc_color False, norm_pcd_center [0.4, 0, 1.4].",
    ),
)

PERACT = ModelContract(
    name="peract",
    title="PerAct",
    source="peract/peract 02fb876: conf/config.yaml:12-14; conf/method/PERACT_BC.yaml:8; voxel/voxel_grid.py:148-198; "
    "helpers/preprocess_agent.py:20-21",
    tensors=(
        InputTensor(
            "voxel_grid",
            "B C X Y Z",
            (
                XYZ,
                RGB_SIGNED,
                Channel("cell_index", 3, Role.OTHER, 0.0, 1.0),
                Channel("occupied", 1, Role.OTHER, 0.0, 1.0),
            ),
            content="voxel_grid",
        ),
    ),
    frame="",
    axes="world, z up",
    crop_is_open=True,
    max_duplicates=1.0,
    traps=(
        "RLBench's box is [-0.3, -0.5, 0.6] to [0.7, 0.5, 1.6]: 100 cells of 1 cm. Its z starts at 0.6 because the "
        "table is at 0.75; a robot with its table at z = 0 needs its own box.",
        "Colors are in [-1, 1].",
        "RLBench stores negative focal lengths: a deprojection that takes them as positive mirrors x and y.",
    ),
    wrong_frame="Actions are cells of this grid: in another frame the box cuts another part of the scene, and the best "
    "cell is no place of the robot's.",
    checked=(
        "peract/peract 4848e5b voxel/voxel_grid.py, helpers/preprocess_agent.py, "
        "agents/peract_bc/qattention_peract_bc_agent.py: the preset's grid is equal to that of VoxelGrid (same cells, "
        "means to within 1e-5), points outside the box included.",
    ),
)

DIFFUSER_ACTOR = ModelContract(
    name="3d_diffuser_actor",
    title="3D Diffuser Actor",
    source="nickgkan/3d_diffuser_actor 4faf00b: diffuser_actor/trajectory_optimization/diffuser_actor.py:238-246; "
    "diffuser_actor/utils/encoder.py:194-250; datasets/dataset_engine.py:126-142",
    tensors=(
        InputTensor("pcd_obs", "B V C H W", (XYZ,), content="organized"),
        InputTensor("rgb_obs", "B V C H W", (RGB_UNIT,), content="organized"),
    ),
    frame="",
    axes="world, z up",
    image_size=(256, 256),
    max_duplicates=1.0,
    traps=(
        "The cloud stays organized: one point per pixel, (0, 0, 0) where the sensor saw nothing. Simulated depth has "
        "no holes; the model's bilinear resize mixes those zeros into their neighbors, so complete the depth first.",
        "The model brings xyz to [-1, 1] by the bounds of the gripper's positions, by itself.",
        "On disk colors are in [-1, 1], the model takes [0, 1].",
    ),
    wrong_frame="The normalization by the gripper's bounds sends points of another frame far out of [-1, 1], where the "
    "rotary position code repeats itself.",
    checked=(
        "nickgkan/3d_diffuser_actor ba9c8f6 diffuser_actor/trajectory_optimization/diffuser_actor.py, 3c3a2b3 "
        "diffuser_actor/utils/encoder.py, datasets/dataset_engine.py: (B, cameras, 3, H, W), rgb_obs in [0, 1], "
        "pcd_obs in world coordinates, normalized inside. The network needs CLIP weights: not run.",
    ),
)

TABLE = (RISE, RISE2, POINTFLOWMATCH, PERACT, DIFFUSER_ACTOR)
