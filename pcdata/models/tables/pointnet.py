"""PointNet and PointNet++."""

from dataclasses import replace

from pcdata.models.contract import NORMALS, XYZ, Channel, InputTensor, ModelContract, Role

_CATEGORY = Channel("category", 16, Role.OTHER, 0.0, 1.0)
_BLOCK = Channel("xyz_column")  # x and y from the column's centre, z as it is
_UNIT_RGB = Channel("rgb", 3, Role.COLOR, 0.0, 1.0)
_ROOM = Channel("xyz_room", 3, Role.OTHER, 0.0, 1.0)  # as parts of the room's extent

_GUIDE = (
    'Guides say "exactly 1,024 or 4,096 points, padded with duplicates". The code: 1024 for classification, 2048 for '
    "parts, 4096 for S3DIS; the networks take any count, the classification loaders crash on a short cloud."
)
_TURNED = (
    "A cloud in the camera frame lies tilted and off to one side: the yaw augmentation then turns it about an axis "
    "that is not its own, and weights trained on upright objects see objects lying down."
)
_UNIT_SPHERE_TRAP = (
    "The stored clouds are uniform samples of a surface, so their first N rows are a fair sample; the first N rows of "
    "a depth image are its top edge. The preset takes farthest points instead."
)

POINTNET_CLS = ModelContract(
    name="pointnet_cls",
    title="PointNet, classification",
    source="charlesq34/pointnet 2618f72: train.py:21,51,182,228; provider.py:90-105",
    tensors=(InputTensor("pointclouds_pl", "B N C", (XYZ,)),),
    frame="",
    axes="the object's own; y up for weights trained on ModelNet",
    count=1024,
    counts=(256, 512, 2048),
    sampler="farthest point",
    pad="error",
    centring="mean",
    scaling="unit sphere",
    normalise="after sampling",
    table="removed",
    guide=_GUIDE,
    traps=(
        "The HDF5 loader does not normalise: the file must be.",
        _UNIT_SPHERE_TRAP,
        "Yaw is drawn about y: turn z-up clouds, or change the axis.",
    ),
    wrong_frame=_TURNED,
)

POINTNET2_CLS = replace(
    POINTNET_CLS,
    name="pointnet2_cls",
    title="PointNet++, classification (PyTorch port)",
    source="yanx27/Pointnet_Pointnet2_pytorch eb64fe0: data_utils/ModelNetDataLoader.py:17-46,97-129; "
    "train_classification.py:42,183",
    tensors=(InputTensor("points", "B C N", (XYZ, replace(NORMALS, optional=True))),),
    counts=(),
    traps=(
        "The port's networks take (B, C, N); the loader gives (B, N, C) and the training script transposes.",
        "Ball radii 0.2 and 0.4 assume the unit sphere.",
        _UNIT_SPHERE_TRAP,
        "Random dropout overwrites dropped points with the first one: duplicates are part of its augmentation.",
    ),
)

POINTNET2_CLS_TF = replace(
    POINTNET2_CLS,
    name="pointnet2_cls_tf",
    title="PointNet++, classification (TensorFlow)",
    source="charlesq34/pointnet2 4292663: modelnet_dataset.py:15-21,84-86,120-124; models/*.py:12-16",
    tensors=(InputTensor("pointclouds_pl", "B N C", (XYZ, replace(NORMALS, optional=True))),),
    traps=("A short cloud crashes in the copy into the fixed batch buffer.", _UNIT_SPHERE_TRAP),
)

POINTNET_PART = replace(
    POINTNET_CLS,
    name="pointnet_part",
    title="PointNet, part segmentation",
    source="charlesq34/pointnet 2618f72: part_seg/train.py:67-68; ShapeNetPart HDF5",
    tensors=(
        InputTensor("pointclouds_ph", "B N C", (XYZ,)),
        InputTensor("input_label_ph", "B C", (_CATEGORY,), content="category"),
    ),
    count=2048,
    counts=(1024,),
    sampler="random with replacement",
    pad="repeat",
    normalise="before sampling",
    choices=("category",),
)

POINTNET2_PART = replace(
    POINTNET_PART,
    name="pointnet2_part",
    title="PointNet++, part segmentation (PyTorch port)",
    source="yanx27/Pointnet_Pointnet2_pytorch eb64fe0: data_utils/ShapeNetDataLoader.py:105-110; train_partseg.py:193",
    tensors=(
        InputTensor("points", "B C N", (XYZ, replace(NORMALS, optional=True))),
        InputTensor("cls_label", "B 1 C", (_CATEGORY,), content="category"),
    ),
    counts=(2500,),
    traps=(
        "Normalised on the full cloud first, then drawn with replacement even where there are enough points: about a "
        "third of the rows come twice.",
        "The category is an input: it must be known before the parts.",
    ),
)

POINTNET_SEMSEG = ModelContract(
    name="pointnet_semseg",
    title="PointNet, semantic segmentation (S3DIS)",
    source="charlesq34/pointnet 2618f72: sem_seg/train.py:22,63-85; sem_seg/gen_indoor3d_h5.py:14-69",
    tensors=(InputTensor("pointclouds_pl", "B N C", (_BLOCK, _UNIT_RGB, _ROOM)),),
    frame="",
    axes="z up; the scene's lowest corner is the origin",
    count=4096,
    sampler="random",
    pad="repeat",
    centring="corner",
    normalise="before sampling",
    column=1.0,
    max_duplicates=0.75,  # 1,025 points in a column are enough for its code
    guide=_GUIDE,
    traps=(
        "z is not centred: it says how high above the floor a point is.",
        "The original sampler draws until a column of 1 m has more than 1024 points, and so hangs for ever on a small "
        "or thin scene; the preset gives up after 100 draws and says so.",
        "Colours are stored 0-255 and divided by 255 in the loader.",
    ),
    wrong_frame="With z along the camera's view a column of 1 m x 1 m becomes a tunnel away from the camera, and the "
    "height above the floor, the strongest cue for floor and table, becomes a distance.",
)

POINTNET2_SEMSEG = replace(
    POINTNET_SEMSEG,
    name="pointnet2_semseg",
    title="PointNet++, semantic segmentation (PyTorch port)",
    source="yanx27/Pointnet_Pointnet2_pytorch eb64fe0: data_utils/S3DISDataLoader.py:54-76, indoor3d_util.py:59-60; "
    "models/pointnet2_sem_seg.py:9-12; train_semseg.py:184",
    tensors=(InputTensor("points", "B C N", (_BLOCK, _UNIT_RGB, _ROOM)),),
)

POINTNET2_POLICY_GUIDE = ModelContract(
    name="pointnet2_policy_guide",
    title="PointNet++ policy, as guides describe it",
    source="practitioners' guides; no repository fixes this contract",
    tensors=(InputTensor("points", "B N C", (XYZ, replace(NORMALS, optional=True))),),
    frame="",
    axes="the robot base's",
    count=1024,
    counts=(4096,),
    sampler="farthest point",
    pad="tile",
    table="open",
    guide="This is the guide's contract: exactly 1,024 or 4,096 farthest points, padded with duplicates, in metres.",
    traps=("Policies in code use DP3's PointNet: 512 or 1024 points, short clouds filled up with zero rows.",),
    wrong_frame="Actions are learnt in the robot's frame; a cloud in the camera frame hides the camera's pose in the "
    "weights, and the policy fails as soon as the camera moves.",
)

TABLE = (
    POINTNET_CLS,
    POINTNET_PART,
    POINTNET_SEMSEG,
    POINTNET2_CLS,
    POINTNET2_CLS_TF,
    POINTNET2_PART,
    POINTNET2_SEMSEG,
    POINTNET2_POLICY_GUIDE,
)
