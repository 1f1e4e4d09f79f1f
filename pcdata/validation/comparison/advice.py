"""What to do about differences that no step was found to close."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from pcdata.validation.comparison.placements import stands
from pcdata.validation.comparison.result import Difference, Measured
from pcdata.validation.comparison.sides import Side
from pcdata.verdicts import Verdict

_ADVICE = {
    "distances": "the cameras see other distances: place the virtual camera alike, or train on both",
    "lens": "give the simulator's camera the intrinsics of the real one; of two real ones calibrate anew",
    "density": "give both one VoxelDownsample, or one FarthestPointSample, at the end of the pipeline",
    "noise": "no sensor's noise brings them together: look at both, and at the filters that one went through",
    "flying pixels": "RemoveFlyingPixels in both",
    "holes": "FillHoles or CompleteDepth in the one with more; holes alone are drawn by RandomSensorNoise(strength=0)",
    "table": "the table stands elsewhere: move it, or the simulator's, or make clouds relative to it",
    "camera": "the camera is placed otherwise: move it, calibrate, or give the simulator its pose",
    "extent": "the clouds end elsewhere: give both one CropWorkspace",
    "objects": "the scenes hold other objects: record or render as many, and as large ones",
}
_FACTS = {
    "kind": "",
    "frame": ("frame", "bring both into one: ToFrame(frame=...) in the pipeline, --frame for captures"),
    "unit": ("unit", "leave the step that normalizes out of one, or put it into both"),
    "views": ("views", "give both as many cameras (--camera), or compare one by one"),
    "size": ("image size", "ResizeDepth, or CropCenter, in one"),
    "colors": ("colors", "leave colors out of one, or record them in the other"),
}


def family_advice(family: str, rows: Sequence[Measured]) -> str:
    """Return what to do where no step closed a family."""
    if family != "colors":
        return _ADVICE.get(family, "look at both sources")
    bright = next((one for one in rows if one.name == "brightness" and min(one.a, one.b) > 0), None)
    if bright is None:
        return "set exposure and white balance, or cover it: RandomColorJitter"
    reach = min(1.0, abs(max(bright.a, bright.b) / min(bright.a, bright.b) - 1))
    return (
        "set exposure and white balance alike; or cover it in training: RandomColorJitter(brightness="
        f"{max(0.05, round(reach, 2)):g}), which reaches from one to the other but moves no mean"
    )


def fact_differences(sides: tuple[Side, Side]) -> Iterable[Difference]:
    """Yield what one source is and the other is not."""
    for name, said in _FACTS.items():
        a, b = (side.fact(name) for side in sides)
        if said and a and b and a != b:
            yield difference_of_fact(said[0], f"{a} in A, {b} in B", said[1])
    shared = {key[1] for key in sides[0].series.keys} & {key[1] for key in sides[1].series.keys}
    for view in sorted(one for one in shared if one is not None):
        still = [stands(side.series, view) for side in sides]
        if None not in still and still[0] != still[1]:
            yield Difference(
                name="camera motion",
                verdict=Verdict.WARN,
                found=f"view {view}: the camera stands in {'AB'[still.index(True)]} and moves in "
                f"{'AB'[still.index(False)]}",
                advice="draw the camera's place in the source that stands, or train on both",
            )


def difference_of_fact(name: str, found: str, advice: str = "") -> Difference:
    """Return a difference that needs no statistics."""
    return Difference(name=name, verdict=Verdict.FAIL, found=found, advice=advice)
