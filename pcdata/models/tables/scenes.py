"""Scene understanding: Pointcept (Point Transformer V3)."""

from dataclasses import replace

from pcdata.models.contract import NORMALS, RGB_UNIT, XYZ, Channel, InputTensor, ModelContract, Role

POINTCEPT = ModelContract(
    name="pointcept",
    title="Pointcept (Point Transformer V3, ScanNet configuration)",
    source="Pointcept/Pointcept d74c646: pointcept/datasets/defaults.py:35-143; transform.py:143-185,840-865; "
    "configs/scannet/semseg-pt-v3m1-0-base.py:96-163",
    tensors=(
        InputTensor("coord", "S C", (XYZ,)),
        InputTensor("grid_coord", "S C", (Channel("cells", 3, Role.OTHER),), "int64", "grid_cells"),
        InputTensor("feat", "S C", (replace(RGB_UNIT, optional=True), replace(NORMALS, optional=True))),
        InputTensor("offset", "B", (), "int64", "offset"),
    ),
    frame="",
    axes="z up; x and y from the middle of the scene's box, z from its floor",
    voxel=0.02,
    voxel_rule="random",
    centering="floor",
    normalize="before sampling",
    max_duplicates=0.1,
    traps=(
        "feat is what feat_keys name; the ScanNet weights want colors and normals.",
        "Colors are stored 0-255 and divided by 255 in the loader: files with 0-1 are nearly black.",
        "A random point of each voxel is kept, not the mean.",
        "Its pipeline centers x and y once more after the voxels, on their own box: at most a voxel off the preset's.",
        "In training a sphere of 102,400 points is cut out of larger scenes; the preset keeps the scene.",
        "offset holds the ends of the clouds, so its last value is the number of points.",
    ),
    wrong_frame="z = 0 is no longer the floor, and the serialization orders points along the wrong axes: the network "
    "runs and labels badly.",
    checked=(
        "Pointcept/Pointcept 0be8049 pointcept/datasets/defaults.py: the exported folders ran through DefaultDataset, "
        "by split "
        "and by list of splits; 041f5f6 transform.py, 10b7490 configs/scannet/semseg-pt-v3m1-0-base.py: CenterShift, "
        "GridSample (cells from the lowest), colors / 255, feat = color, normal. The network needs CUDA: not run.",
    ),
)

TABLE = (POINTCEPT,)
