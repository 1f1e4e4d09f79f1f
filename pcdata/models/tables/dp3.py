"""DP3, and the policies that took over its loader."""

from dataclasses import replace

from pcdata.models.contract import (
    RGB_BYTE,
    RGB_UNIT,
    XYZ,
    InputTensor,
    ModelContract,
)

_STORED = (XYZ, replace(RGB_BYTE, optional=True))
_NORMALIZER = (
    "The policy normalizes by itself, to [-1, 1] per channel by the extremes of the whole data set: zero rows and "
    "outliers enter those extremes, and the channels of training and inference must be the same."
)

DP3_SIM = ModelContract(
    name="dp3_sim",
    title="DP3 (3D Diffusion Policy), simulation",
    source="YanjieZe/3D-Diffusion-Policy 47385d9: gym_util/mjpc_wrapper.py:12-81,163-169; "
    "policy/dp3.py:183-187,262-266; model/vision/pointnet_extractor.py:109-178; dataset/adroit_dataset.py:60-68",
    tensors=(InputTensor("point_cloud", "B N C", _STORED),),
    frame="",
    axes="whatever the training data are in: turned world in simulation",
    count=512,
    counts=(1024,),
    any_count=True,
    sampler="farthest point",
    pad="zeros",
    crop_is_open=True,
    table="open",
    max_duplicates=0.5,
    guide='Guides say "voxels of 5-10 mm, 5,000-20,000 of them, in the robot base frame". The code has no voxels: 512 '
    "or 1024 farthest points, and no fixed frame; the released real data are in a turned camera frame.",
    traps=(
        _NORMALIZER,
        "That is Adroit, MetaWorld and the real data; for DexArt the clouds stay in metres: see dexart.",
        "Short clouds get zero rows: points at the origin of whatever frame was chosen.",
        "Six channels are stored, three are used unless use_pc_color is set.",
        "Cropping table and background away is highly recommended by the authors.",
    ),
    wrong_frame="Training runs to the same loss: the policy learns the camera's pose along with the task. Then the "
    "camera moves by a centimetre, or the data of a second camera are added, and the actions are off by as much.",
    checked=(
        "YanjieZe/3D-Diffusion-Policy e65e2ae common/replay_buffer.py, common/sampler.py, dataset/adroit_dataset.py, "
        "model/common/normalizer.py: the exported zarr ran through them with zarr 2.12.0, into memory and from "
        "disk; every sequence of 16, 4 and 1 steps equals what pcdata holds and its EpisodeWindows give, normalized to "
        "[-1, 1].",
        "YanjieZe/3D-Diffusion-Policy e65e2ae gym_util/mjpc_wrapper.py: open box, farthest points on xyz, zero rows. "
        "a406207 model/vision/pointnet_extractor.py: the forward pass of PointNetEncoderXYZ and PointNetEncoderXYZRGB "
        "takes the preset's columns as they are.",
    ),
)

DP3_REAL = replace(
    DP3_SIM,
    name="dp3_real",
    title="DP3 (3D Diffusion Policy), real robot",
    source="YanjieZe/3D-Diffusion-Policy 47385d9: scripts/convert_real_robot_data.py:40-71,155-183",
    axes="whatever the training data are in; the released data: turned camera axes, no translation",
    count=1024,
    counts=(512,),
    traps=(
        *(trap for trap in DP3_SIM.traps if "DexArt" not in trap),
        "The published conversion multiplies from the right and drops the last column: it applies the transposed "
        "rotation and loses the translation. Data made by it do not fit data made by ToFrame.",
        "Its recorded depth is in units of 0.25 mm, its stored clouds are float64; the loaders read both as float32.",
        "Its farthest point sampling fills short clouds with xyz = 0 in the color of the last point; here the color "
        "of such rows is 0 too.",
    ),
    checked=(
        "YanjieZe/3D-Diffusion-Policy 22a78fc scripts/convert_real_robot_data.py: 1024 farthest points of an open box, "
        "colors as stored, the matrix applied from the right.",
    ),
)

DEXART = replace(
    DP3_SIM,
    name="dexart",
    title="DP3 on DexArt",
    source="YanjieZe/3D-Diffusion-Policy 47385d9: dataset/dexart_dataset.py:61-72; env/dexart/dexart_wrapper.py; "
    "config/task/dexart_*.yaml; model/vision/pointnet_extractor.py",
    tensors=(InputTensor("point_cloud", "B N C", (XYZ,)),),
    axes="the simulator's world, z up",
    count=1024,
    counts=(),
    any_count=False,
    sampler="random",
    pad="repeat",
    guide="",
    traps=(
        "Nothing is normalized: the cloud and the imagined robot have an identity normalizer, unlike every other DP3 "
        "task.",
        "The policy joins 96 imagined points of the robot, imagin_robot (96, 7), to the cloud: they come from the "
        "robot's model, not from a camera, so the preset does not make them, and without them the data set does not "
        "open.",
        "A short cloud is filled up with its first point, the preset fills it up with random ones.",
        "Its simulator draws at random, no farthest points, inside an open box of the task's own in the world.",
        "Three channels are stored, no colors.",
    ),
    wrong_frame="The imagined robot is in the world's metres: a cloud in another frame or normalized does not meet it.",
    checked=(
        "YanjieZe/3D-Diffusion-Policy e65e2ae dataset/dexart_dataset.py, env/dexart/dexart_wrapper.py, "
        "config/task/dexart_laptop.yaml: (T, 1024, 3) and (T, 96, 7), create_identity() for both; farthest points only "
        "where the simulator gives more than 1024. The exported zarr ran through DexArtDataset: every sequence is what "
        "pcdata holds, and the cloud is not scaled. a406207 model/vision/pointnet_extractor.py: the forward pass takes "
        "the preset's batch.",
        "Kami-code/dexart-release 2c14d45 dexart/env/rl_env/pc_processing.py: world coordinates, an open box, a random "
        "draw, short clouds filled up with the first point inside.",
    ),
)

MANIFLOW = replace(
    DP3_SIM,
    name="maniflow",
    title="ManiFlow on RoboTwin",
    source="pummmmpkin/ManiFlow_Policy eb37c38, a fork: ManiFlow/maniflow/dataset/robotwin_dataset.py; "
    "config/robotwin_task/*_pointcloud.yaml; model/vision_3d/pointnet_extractor.py; "
    "third_party/RoboTwin1.0/script/pkl2zarr_maniflow.py (the original, geyan21/ManiFlow_Policy, was out of reach); "
    "RoboTwin-Platform/RoboTwin 2701a07: envs/camera/camera.py",
    tensors=(InputTensor("point_cloud", "B N C", (XYZ, replace(RGB_UNIT, optional=True))),),
    axes="the simulator's world, z up",
    count=1024,
    counts=(),
    guide="",
    traps=(
        "Colors are stored in [0, 1], unlike DP3's 0-255: RoboTwin clamps them there.",
        _NORMALIZER,
        "Six channels are stored, three are used unless use_pc_color is set.",
        "The encoder draws 128 farthest points of them by itself (visual_cond_len).",
        "RoboTwin's box is [-0.6, -0.35, 0.7401] to [0.6, 0.35, 2]: 0.1 mm above its table top of 0.74 m.",
        "A short cloud gets rows of zeros before its farthest points are drawn; all rows are then taken.",
    ),
    checked=(
        "pummmmpkin/ManiFlow_Policy eb37c38 ManiFlow/maniflow/dataset/robotwin_dataset.py, "
        "ManiFlow/maniflow/config/robotwin_task/block_hammer_beat_pointcloud.yaml: point_cloud (1024, 6), state, "
        "action, no img; normalized by the extremes of the data set. The exported zarr ran through it, with its change "
        "of colors too: every sequence is what pcdata holds.",
        "RoboTwin-Platform/RoboTwin 2701a07 envs/camera/camera.py: world coordinates, a closed box, colors in [0, 1], "
        "zero rows, farthest points on xyz.",
    ),
)

DEMOGEN = replace(
    DP3_REAL,
    name="demogen",
    title="DemoGen",
    source="TEA-Lab/DemoGen 06faf73: demo_generation/demo_generation/demogen.py; "
    "diffusion_policies/diffusion_policies/env/metaworld/metaworld_wrapper.py; TRAIL-rcvlab/DemoGen 89c6ae3, a fork: "
    "real_world/utils/pcd_process.py",
    tensors=(InputTensor("point_cloud", "B N C", (XYZ,)),),
    stored=(RGB_BYTE,),
    axes="the robot base's, z up, for real robots; the simulator's world",
    table="removed",
    guide="",
    traps=(
        "It moves objects by adding to x and y of points, states and actions: all three must be in one frame whose z "
        "is up, the robot base's, and actions must be displacements in it.",
        "The table must be cropped away: what is no object is taken for the robot and moved with it. Its real box "
        "starts 5 mm above the table.",
        "Its real recorder draws 5,000 points, drops what DBSCAN (12 mm, 10 points) leaves in clusters of fewer than "
        "50, then takes 1024 farthest points; the preset takes the farthest points of the crop: put RemoveOutliers "
        "before them for a noisy camera.",
        "The generator takes the action of a step for the motion that led to it: its home is state[0] - action[0]. "
        "With actions that follow their step, as policies learn them, the hand of a generated episode ends beside the "
        "moved object by what the first and the last step of the approach differ (3.3 mm in a simulated set, at most "
        "one step); with those that led to it, at it to rounding. Give the generator the latter.",
        "Which points are the object it finds by masks of its authors' own camera: intrinsics and pose are constants "
        "in demo_generation/mask_util.py, for images of 1920x1080.",
        "The generator reads state, action and point_cloud; the policies for robosuite and MetaWorld read agent_pos "
        "instead of state.",
        'Columns beside x, y, z are copied as they are; the policies take three. channels=["xyz", "rgb_255"] makes '
        "files with colors.",
    ),
    wrong_frame="A translation along the table becomes one along the camera's axes: the generated objects float or "
    "sink, and the generated actions reach beside them.",
    checked=(
        "TEA-Lab/DemoGen 06faf73 demo_generation/demo_generation/demogen.py, "
        "demo_generation/demo_generation/mask_util.py: the exported zarr ran through the generator for tasks of one "
        "object: it reads what pcdata holds, and all points of the object are moved.",
        "TEA-Lab/DemoGen 06faf73 diffusion_policies/diffusion_policies/env/metaworld/metaworld_wrapper.py: 512 "
        "farthest points of a closed box in the world. Read, not run.",
        "TRAIL-rcvlab/DemoGen 89c6ae3 real_world/utils/pcd_process.py: robot base, an open box, clusters, 1024 "
        "farthest points. The loader of robosuite data was read without its commit: agent_pos, action and point_cloud "
        "(T, 1024, 3).",
    ),
)

DP3_VOXELS_GUIDE = ModelContract(
    name="dp3_guide",
    title="3D Diffusion Policy, as guides describe it",
    source="practitioners' guides; the code of DP3 has no voxels",
    tensors=(InputTensor("point_cloud", "S C", (XYZ, replace(RGB_UNIT, optional=True))),),
    frame="",
    axes="the robot base's",
    count_range=(5000, 20000),
    voxel_count=10000,
    crop_is_open=True,
    table="open",
    max_duplicates=0.1,
    guide="This is the guide's contract: voxels of 5-10 mm in the robot base frame, 5,000 to 20,000 of them. Size and "
    "count fit together for some crops alone: a table of 0.8 m is more than 20,000 voxels of 5 mm. The preset keeps "
    "the count, and finds the size cloud by cloud.",
    traps=(
        "DP3's own code takes 512 or 1024 farthest points: see dp3_sim and dp3_real.",
        "With voxel_size the count is whatever the crop leaves, and is refused outside 5,000 to 20,000.",
    ),
    wrong_frame=DP3_SIM.wrong_frame,
)

IDP3 = ModelContract(
    name="idp3",
    title="iDP3 (Improved 3D Diffusion Policy)",
    source="YanjieZe/Improved-3D-Diffusion-Policy f5b27fa: common/multi_realsense.py:77-101,159-243; deploy.py; "
    "dataset/gr1_dex_dataset_3d.py:75-91; model/vision_3d/point_process.py:14-32, multi_stage_pointnet.py; "
    "YanjieZe/Humanoid-Teleoperation 2487195: humanoid_teleoperation/scripts/convert_demos.py",
    tensors=(InputTensor("point_cloud", "B N C", (XYZ,)),),
    stored=(RGB_BYTE,),
    count=10000,
    counts=(4096,),
    sampler="random with replacement",
    pad="zeros",
    voxel=0.005,
    voxel_rule="first",
    crop=((-10.0, -10.0, 0.1), (10.0, 10.0, 1.0)),
    table="open",
    max_duplicates=0.8,
    traps=(
        "The camera frame is meant: no extrinsics anywhere, so that the policy needs no calibration.",
        "Training files hold 10,000 rows per cloud, filled up with zeros; the loader then draws 4096 of them without "
        "replacement, zeros among them. deploy.py alone records 4096 (num_points=4096), with replacement.",
        'Six channels are stored, colors 0-255 (channels=["xyz", "rgb_255"]). The policy cuts them to three: its '
        "encoder is a convolution of three channels, and six raise, use_pc_color or not.",
        "Where more points are left than asked, the recorder draws with replacement: many rows come twice.",
        "The box is open on both sides: a reading clamped to 1.0 m is dropped.",
        "The recorder uses the depth stream's intrinsics for depth aligned to color.",
        "Nothing is normalized: cloud and state have an identity normalizer.",
    ),
    guide="Guides put every diffusion policy into the robot base frame; this one must not be.",
    wrong_frame="In the base frame the crop by depth 0.1-1.0 m cuts by height instead, and egocentric weights meet a "
    "view from nowhere.",
    checked=(
        "YanjieZe/Improved-3D-Diffusion-Policy 3216526 common/multi_realsense.py, dataset/gr1_dex_dataset_3d.py, "
        "model/vision_3d/point_process.py, deploy.py: the first point of each 5 mm cell, drawn with replacement or "
        "filled up with zeros, no normalization. The exported zarr ran through GR1DexDataset3D with 4096, 10,000 and "
        "12,000 points: states and actions are what pcdata holds, points are drawn among the stored ones. "
        "multi_realsense.py was not run: it records from a camera.",
        "YanjieZe/Improved-3D-Diffusion-Policy 3216526 model/vision_3d/multi_stage_pointnet.py, "
        "model/vision_3d/pointnet_extractor.py: conv_in has three channels; the forward pass of the encoder takes the "
        "preset's batch and draws 4096 of its rows.",
        "YanjieZe/Humanoid-Teleoperation 2487195 humanoid_teleoperation/scripts/convert_demos.py: at most 10,000 rows, "
        "float32, beside state and action.",
    ),
)

TABLE = (DP3_SIM, DP3_REAL, DP3_VOXELS_GUIDE, DEXART, MANIFLOW, DEMOGEN, IDP3)
