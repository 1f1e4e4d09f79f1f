"""Grasp networks on depth images: GG-CNN, GR-ConvNet, FC-GQ-CNN."""

from pcdata.models.contract import Channel, InputTensor, ModelContract, Role

_RELATIVE = Channel("depth_relative", 1, Role.DEPTH, -1.0, 1.0)  # minus the image's mean, clipped
_METRES = Channel("depth", 1, Role.DEPTH, 0.05, 10.0)
_RGB = Channel("rgb_minus_mean", 3, Role.COLOR, -1.0, 1.0)

_NO_CLOUD = "These networks take images: what they need is metres, no holes, and the camera they were trained with."
_FRAME = (
    "An image has the camera's frame by nature. A rendering of a cloud from above is another camera: grasps must go "
    "back through that camera's pose."
)

GGCNN = ModelContract(
    name="ggcnn",
    title="GG-CNN",
    source="dougsm/ggcnn 0c50aa7: utils/data/*.py, utils/dataset_processing/image.py:172-206; "
    "dougsm/mvp_grasp c301ba2: ggcnn/src/ggcnn/ggcnn_torch.py:20-69",
    takes="depth image",
    tensors=(InputTensor("x", "B C H W", (_RELATIVE,), content="depth_image"),),
    image_size=(300, 300),
    traps=(
        _NO_CLOUD,
        "Holes are filled before anything else, here with the nearest reading, by the authors with OpenCV's "
        "Navier-Stokes inpainting: a 0 left in would drag the mean and be clipped to the closest surface.",
        "In millimetres the clip to [-1, 1] turns the image into two values.",
        'Cornell\'s "depth" is the distance along the ray, not z.',
        "The predicted width is in pixels, divided by 150.",
    ),
    wrong_frame=_FRAME,
)

GRCONVNET = ModelContract(
    name="grconvnet",
    title="GR-ConvNet",
    source="skumra/robotic-grasping 183c6f6: utils/data/camera_data.py:45-51; "
    "utils/dataset_processing/image.py:53-56,205-209",
    takes="depth image",
    tensors=(InputTensor("x", "B C H W", (_RELATIVE, _RGB), content="depth_image"),),
    image_size=(224, 224),
    traps=(
        _NO_CLOUD,
        "Depth comes first, then red, green, blue, each divided by 255 and less the image's mean.",
        "Its live camera code normalises depth by the colours' rule (/ 255 - mean), unlike its training code; the "
        "preset follows the training code.",
    ),
    wrong_frame=_FRAME,
)

FCGQCNN = ModelContract(
    name="fcgqcnn",
    title="FC-GQ-CNN",
    source="BerkeleyAutomation/gqcnn 499a609: cfg/*.yaml (sizes and bins; the tensor's layout was not verified in "
    "code)",
    takes="depth image",
    tensors=(InputTensor("im", "B H W C", (_METRES,), content="depth_image"),),
    image_size=(480, 640),
    guide='Guides name an "FC-GraspNet"; no such repository was found. FC-GQ-CNN is the nearest real network.',
    traps=(
        _NO_CLOUD,
        "The network subtracts each of 16 depth bins by itself (im_depth_sub): give metres.",
        "The camera looks straight down in its training data.",
    ),
    wrong_frame=_FRAME,
)

TABLE = (GGCNN, GRCONVNET, FCGQCNN)
