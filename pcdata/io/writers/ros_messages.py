"""ROS 2 messages of images, cameras, poses and arrays, made for rosbags to serialize."""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pcdata.extras import require
from pcdata.structures import Camera

_ENCODED = {  # type of the pixels, and whether they are of color: what ROS calls it
    ("uint16", False): "16UC1",
    ("float32", False): "32FC1",
    ("int32", False): "32SC1",
    ("uint8", False): "mono8",
    ("uint8", True): "rgb8",
}


class RosMessages:
    """Makes messages of ROS 2's own types; ``pack`` gives the bytes of one."""

    def __init__(self) -> None:
        """Load the types.

        Raises:
            MissingExtraError: rosbags is not installed.
        """
        require("rosbags")
        typesys = importlib.import_module("rosbags.typesys")
        self.types: Any = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)

    def pack(self, message: Any) -> Any:
        """Serialize a message."""
        return self.types.serialize_cdr(message, message.__msgtype__)

    def header(self, stamp: int, frame_id: str) -> Any:
        """Return a header of a time in nanoseconds and a frame."""
        return self._made("std_msgs/msg/Header", stamp=self._time(stamp), frame_id=frame_id)

    def image(self, header: Any, pixels: NDArray[Any]) -> Any:  # (H, W) or (H, W, 3)
        """Return an image as it is: whole numbers, float32, or RGB."""
        pixels = np.ascontiguousarray(pixels, dtype=pixels.dtype.newbyteorder("<"))
        height, width = pixels.shape[:2]
        return self._made(
            "sensor_msgs/msg/Image",
            header=header,
            height=height,
            width=width,
            encoding=_ENCODED[pixels.dtype.name, pixels.ndim == 3],
            is_bigendian=0,
            step=pixels.nbytes // height,
            data=pixels.reshape(-1).view(np.uint8),
        )

    def compressed(self, header: Any, form: str, data: bytes) -> Any:
        """Return a compressed image: ``form`` is "jpeg" or "png"."""
        return self._made(
            "sensor_msgs/msg/CompressedImage", header=header, format=form, data=np.frombuffer(data, np.uint8)
        )

    def camera_info(self, header: Any, camera: Camera) -> Any:
        """Return the intrinsics and the lens of one camera.

        A polynomial of 8 and more coefficients is called the rational one; of 4 the missing one, k3, is 0. A lens of
        another model has ROS's name for it, ``equidistant``, or RealSense's.
        """
        k = camera.intrinsics[0].numpy()
        model, lens = camera.lenses[0] if camera.lenses else ("opencv", [])
        lens += [0.0] * (len(lens) == 4 and model == "opencv")
        names = {"opencv": "plumb_bob" if len(lens) <= 5 else "rational_polynomial", "fisheye": "equidistant"}
        height, width = camera.size
        whole = self._made(
            "sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
        )
        return self._made(
            "sensor_msgs/msg/CameraInfo",
            header=header,
            height=height,
            width=width,
            distortion_model=names.get(model, model),
            d=np.array(lens, dtype=np.float64),
            k=k.reshape(-1),
            r=np.eye(3).reshape(-1),
            p=np.hstack([k, np.zeros((3, 1))]).reshape(-1),
            binning_x=0,
            binning_y=0,
            roi=whole,
        )

    def transforms(self, stamp: int, frame: str, poses: Sequence[tuple[str, Tensor, Tensor]]) -> Any:
        """Return the places of other frames in one: name, position (3,) and quaternion (w, x, y, z) of each."""
        return self._made(
            "tf2_msgs/msg/TFMessage",
            transforms=[
                self._made(
                    "geometry_msgs/msg/TransformStamped",
                    header=self.header(stamp, frame),
                    child_frame_id=name,
                    transform=self._transform(position, turn),
                )
                for name, position, turn in poses
            ],
        )

    def array(self, values: NDArray[np.float64]) -> Any:
        """Return an array of any shape."""
        strides = [int(np.prod(values.shape[axis:])) for axis in range(values.ndim)]
        axes = [
            self._made("std_msgs/msg/MultiArrayDimension", label=f"axis{axis}", size=size, stride=stride)
            for axis, (size, stride) in enumerate(zip(values.shape, strides))
        ]
        layout = self._made("std_msgs/msg/MultiArrayLayout", dim=axes, data_offset=0)
        return self._made(
            "std_msgs/msg/Float64MultiArray", layout=layout, data=np.ascontiguousarray(values).reshape(-1)
        )

    def text(self, text: str) -> Any:
        """Return a text."""
        return self._made("std_msgs/msg/String", data=text)

    def _transform(self, position: Tensor, turn: Tensor) -> Any:
        x, y, z = position.tolist()
        w, i, j, k = turn.tolist()
        return self._made(
            "geometry_msgs/msg/Transform",
            translation=self._made("geometry_msgs/msg/Vector3", x=x, y=y, z=z),
            rotation=self._made("geometry_msgs/msg/Quaternion", x=i, y=j, z=k, w=w),
        )

    def _time(self, stamp: int) -> Any:
        return self._made("builtin_interfaces/msg/Time", sec=stamp // 10**9, nanosec=stamp % 10**9)

    def _made(self, kind: str, **fields: Any) -> Any:
        return self.types.types[kind](**fields)


def exact_as_doubles(values: Tensor) -> bool:
    """Say whether numbers are the same as float64."""
    if values.dtype not in (torch.int64, torch.uint64):  # a comparison in fewer bits would wrap
        return True
    numbers = values.cpu().numpy()
    most = numbers.dtype.type(1 << 53)
    return bool((numbers <= most).all()) and (values.dtype is torch.uint64 or bool((numbers >= -most).all()))
