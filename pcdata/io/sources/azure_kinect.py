"""Recordings of an Azure Kinect: ``.mkv`` files of its recorder, read without its SDK.

Source: Azure Kinect Sensor SDK, its record file format (tracks, tags, the attached calibration) and its transformation
code: intrinsics are shares of the sensor's sides, of which each mode uses a binned and cropped part, with principal
points counted from the edge of a pixel; fourteen parameters cx cy fx fy k1 .. k6 codx cody p2 p1; the pose of the color
camera is color from depth in metres.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, BinaryIO

from torch import Tensor

from pcdata.errors import CaptureError, IntrinsicsError, PcdataError
from pcdata.files.sample_names import counted, name_some
from pcdata.files.strict_json import json_object
from pcdata.io.calibration.foreign_cameras import matrix_of, pinhole
from pcdata.io.sources.matroska import MAGIC, opened_matroska
from pcdata.io.sources.recording import READ_COLOR, Recorded, RecordingSource, Taken
from pcdata.io.sources.registry import register_layout
from pcdata.structures import Camera

_UNIT = 0.001  # of depth, in every mode
_CALIBRATION = "calibration.json"
_DEPTH, _COLOR = "CALIBRATION_CameraLocationD0", "CALIBRATION_CameraLocationPV0"
# By the size of the image (height, width): that of the whole binned sensor, and the first row and column that are used.
_PARTS = {
    _DEPTH: {
        (288, 320): ((512, 512), (90, 96)),
        (576, 640): ((1024, 1024), (180, 192)),
        (512, 512): ((512, 512), (0, 0)),
        (1024, 1024): ((1024, 1024), (0, 0)),
    },
    _COLOR: {
        (720, 1280): ((960, 1280), (120, 0)),
        (1080, 1920): ((1440, 1920), (180, 0)),
        (1440, 2560): ((1920, 2560), (240, 0)),
        (1536, 2048): ((1536, 2048), (0, 0)),
        (2160, 3840): ((2880, 3840), (360, 0)),
        (3072, 4096): ((3072, 4096), (0, 0)),
    },
}


@register_layout
class _AzureKinectSource(RecordingSource):
    """The recording of one Azure Kinect; times are seconds on the device's clock."""

    kind = "azure_kinect"
    needs = "an .mkv that an Azure Kinect recorded, or a folder with one; reading it needs av (PyAV)"
    suffix = ".mkv"
    role = "recording"
    ticks_per_second = 1.0

    @classmethod
    def _begins_so(cls, stream: BinaryIO) -> bool:
        """Look for the tag of the recorder's depth track: its tags stand before the pictures."""
        head = stream.read(1 << 20)
        return head[:4] == MAGIC and b"K4A_" in head

    def _open(self, where: str, path: Path, registered: bool) -> Recorded:
        read = ["DEPTH", "COLOR"] if registered else ["DEPTH"]
        with opened_matroska(where, path) as recording:
            tracks = recording.tracks()
            if "DEPTH" not in tracks:
                raise CaptureError(f"{where}: has no track DEPTH; it has {name_some(tracks) or 'none'}")
            if registered and "COLOR" not in tracks:
                raise CaptureError(f"{where}: has no track COLOR to register depth to; leave out registered")
            said = json_object(where, recording.attachment(_CALIBRATION).rstrip(b"\0"), error=CaptureError)
            self._calibration = _cameras(where, said)
            depth_times, *color_times = recording.times(*read)
            tags = recording.tags()
            cut = f"it is cut short: {recording.missing} bytes are missing at its end" if recording.missing else ""
        if not depth_times:
            way = f"{cut}; copy it again from where it was recorded" if cut else "was the recording stopped at once?"
            raise CaptureError(f"{where}: its track DEPTH has no image; {way}")
        serial = {"serial": tags["K4A_DEVICE_SERIAL_NUMBER"]} if "K4A_DEVICE_SERIAL_NUMBER" in tags else {}
        return Recorded(
            depth_times=depth_times,
            color_times=color_times[0] if color_times else [],
            metres_per_unit=_UNIT,
            sensor={"sensor_name": "Azure Kinect", **serial},
            unread=[
                *([f"{path.name}: {cut}; {counted(len(depth_times), 'depth image')} can be read"] if cut else []),
                *(
                    f"track {name}; {READ_COLOR}" if name == "COLOR" else f"track {name}"
                    for name in tracks
                    if name not in read
                ),
            ],
        )

    def _take(self, depth: int, color: int | None) -> Taken:
        colors = None
        with opened_matroska(str(self), self.path) as recording:
            units = recording.picture("DEPTH", self._recorded.depth_times[depth], "gray16le")
            if color is not None:
                colors = recording.picture("COLOR", self._recorded.color_times[color], "rgb24").copy()
        camera = self._camera(_DEPTH, (units.shape[0], units.shape[1]))
        if colors is None:
            return Taken(units, camera, None)
        color_camera = self._camera(_COLOR, (colors.shape[0], colors.shape[1]))
        return Taken(units, camera, (colors, color_camera, self._calibration[_COLOR][1]))

    def _camera(self, place: str, size: tuple[int, int]) -> Camera:
        """Return the camera of an image of this size, which tells the mode that it was recorded in."""
        if size not in _PARTS[place]:
            known = ", ".join(f"{width}x{height}" for height, width in _PARTS[place])
            raise IntrinsicsError(f"{self}: no mode of this camera has {size[1]}x{size[0]} pixels; known: {known}")
        (height, width), (top, left) = _PARTS[place][size]
        cx, cy, fx, fy, k1, k2, k3, k4, k5, k6, _, _, p2, p1 = self._calibration[place][0]
        try:
            whole = pinhole(
                (height, width),
                (fx * width, fy * height, cx * width - 0.5, cy * height - 0.5),
                distortion=(k1, k2, p1, p2, k3, k4, k5, k6),
            )
            return whole if whole.size == size else whole.cropped(top, left, size)
        except PcdataError as error:
            raise IntrinsicsError(f"{self}: {_CALIBRATION}: {error}") from error


def _cameras(where: str, said: dict[str, Any]) -> dict[str, tuple[list[float], Tensor]]:
    """Return the fourteen numbers and the pose (this camera from depth) of both cameras.

    Raises:
        CaptureError: one is not there, or not as the format says.
        PoseError: a pose is not rigid.
    """
    found = {}
    try:
        for camera in said["CalibrationInformation"]["Cameras"]:
            place, lens = camera["Location"], camera["Intrinsics"]
            if place not in _PARTS:
                continue
            if lens["ModelType"] != "CALIBRATION_LensDistortionModelBrownConrady":
                raise CaptureError(f"{where}: {_CALIBRATION}: the lens model {lens['ModelType']!r:.80} is not known")
            numbers = [float(value) for value in lens["ModelParameters"]]
            if len(numbers) != 14 or any(numbers[10:12]):
                raise CaptureError(
                    f"{where}: {_CALIBRATION}: a lens must have 14 numbers with the distortion about its center"
                )
            turn, shift = camera["Rt"]["Rotation"], camera["Rt"]["Translation"]
            rows = [value for row in range(3) for value in (*turn[3 * row : 3 * row + 3], shift[row])]
            found[place] = (numbers, matrix_of(f"{where}: {_CALIBRATION}: {place}", rows))
    except (KeyError, TypeError, ValueError, IndexError, OverflowError) as error:
        if isinstance(error, PcdataError):
            raise
        raise CaptureError(
            f"{where}: {_CALIBRATION} is not as the recorder writes it: {type(error).__name__} {error}"
        ) from error
    if missing := [place for place in _PARTS if place not in found]:
        raise CaptureError(f"{where}: {_CALIBRATION} has no camera {name_some(missing)}")
    return found
