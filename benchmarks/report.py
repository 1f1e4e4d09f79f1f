"""How long ``pcdata report`` takes, in what memory, how large its page is, and how soon a browser shows it.

    python benchmarks/report.py [--captures 500] [--browser-python PYTHON] [--pictures]     # about 10 minutes

Writes results/report.json. Captures are two cameras of 640x480 with the noise of stereo above a synthetic table, 24
rendered and these again and again, and where ``PCDATA_TEST_DATA`` is set the 50 frames of ``seven_scenes`` again and
again. In the recording that the pictures are made of (docs/report_*.png), one camera of three stands 6 mm from where
its pose says, from the eleventh capture on. The browser is run by a Python that has playwright.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import torch
from PIL import Image
from timing import RESULTS, facts

from pcdata import PointCloud
from pcdata.io import write_color, write_depth, write_pose
from pcdata.report.html.page import page_of
from pcdata.synthetic import Tabletop, tabletop

HERE = Path(__file__).parent
NUM_RENDERED = 24
PIPELINE = HERE.parent / "configs" / "multiview_objects.yaml"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--captures", type=int, default=500)
    parser.add_argument("--browser-python", metavar="PYTHON", help="a Python that has playwright")
    parser.add_argument("--pictures", action="store_true", help="make docs/report_*.png too")
    arguments = parser.parse_args()
    counts = sorted({max(1, arguments.captures // 10), max(1, 2 * arguments.captures // 5), arguments.captures})
    result: dict[str, Any] = {"benchmark": "report", **facts([]), "page_without_data_bytes": len(page_of("", [], []))}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        store(folder / "rendered", NUM_RENDERED, num_views=2)
        for camera in ("cam0", "cam1"):
            for kind in ("depth", "color", "poses"):
                repeat(folder / "rendered" / camera / kind, folder / "rig" / camera / kind, arguments.captures)
            shutil.copy(folder / "rendered" / camera / "intrinsics.json", folder / "rig" / camera)
        page = folder / "report.html"
        result["synthetic_two_cameras"] = []
        for count in counts:
            result["synthetic_two_cameras"].append(reported(folder / "rig", page, count, samples=50))
            keep(result)
        if data := os.environ.get("PCDATA_TEST_DATA"):
            repeat(Path(data) / "seven_scenes", folder / "scenes", arguments.captures)
            result["seven_scenes_repeated"] = reported(
                folder / "scenes", folder / "scenes.html", arguments.captures, samples=50
            )
            keep(result)
        if arguments.browser_python:
            many = folder / "many.html"
            many_points(200_000).show(max_points=200_000).save(many)
            in_browser = [arguments.browser_python, str(HERE / "report_in_browser.py")]
            measured = subprocess.run([*in_browser, "measure", page, many], check=True, capture_output=True, text=True)
            result["browser"] = json.loads(measured.stdout)
            keep(result)
            if arguments.pictures:
                store(folder / "moved", 24, num_views=3, moved_from=10)
                reported(folder / "moved", page, 24, samples=8, config=PIPELINE)
                subprocess.run([*in_browser, "pictures", page, folder], check=True)
                for picture in folder.glob("report_*.png"):
                    few = Image.open(picture).convert("RGB").quantize(64, dither=Image.Dither.NONE)
                    few.save(HERE.parent / "docs" / picture.name, optimize=True)


def keep(result: dict[str, Any]) -> None:
    """Write what was measured so far."""
    result["machine"]["load_after"] = os.getloadavg()[0]
    (RESULTS / "report.json").write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")


def store(folder: Path, count: int, *, num_views: int, moved_from: int | None = None) -> None:
    """Write captures of a rig, a folder for each camera; from one on, the second camera stands 6 mm away."""
    here = scene(num_views).frame.world_from_camera
    there = here.clone()
    there[1, :3, 3] += torch.tensor([0.0036, 0.0048, 0.0])
    scenes = scene(num_views), scene(num_views, there)
    generator = torch.Generator().manual_seed(0)
    for number in range(count):
        has_moved = moved_from is not None and number >= moved_from
        frame = scenes[has_moved].render(seed_noise=number)
        for view in range(num_views):
            own, name = folder / f"cam{view}", f"f{number:04d}"
            for kind in ("depth", "color", "poses"):
                (own / kind).mkdir(parents=True, exist_ok=True)
            # Noise in the last bit of the colors, as any camera has it.
            noise = torch.randint(0, 2, frame.colors[view].shape, dtype=torch.uint8, generator=generator)
            write_depth(own / "depth" / f"{name}.png", frame.depth[view], metres_per_unit=0.001, round_to_unit=True)
            write_color(own / "color" / f"{name}.png", frame.colors[view] ^ noise)
            write_pose(own / "poses" / f"{name}.txt", here[view])
            (fx, _, cx), (_, fy, cy), _ = frame.camera.intrinsics[view].tolist()
            height, width = frame.size
            said = {"fx": fx, "fy": fy, "cx": cx, "cy": cy, "width": width, "height": height}
            said |= {"metres_per_unit": 0.001, "frame_id": "base"}
            (own / "intrinsics.json").write_text(json.dumps(said), encoding="utf-8")


def scene(num_views: int, world_from_camera: torch.Tensor | None = None) -> Tabletop:
    return tabletop(0, num_views=num_views, noise="stereo", world_from_camera=world_from_camera)


def repeat(source: Path, folder: Path, count: int) -> None:
    """Link the files of a recording under new numbers until there are so many; those without a number as they are."""
    folder.mkdir(parents=True)
    numbered: dict[str, list[Path]] = {}
    for file in sorted(source.iterdir()):
        stem = file.name.partition(".")[0]
        if stem[-1].isdigit():
            numbered.setdefault(stem, []).append(file)
        elif file.is_file():
            os.link(file, folder / file.name)
    stems = sorted(numbered)
    for number in range(count):
        stem = stems[number % len(stems)]
        name = f"{stem.rstrip('0123456789')}{number:06d}"
        for file in numbered[stem]:
            os.link(file, folder / file.name.replace(stem, name))


def reported(source: Path, page: Path, count: int, *, samples: int, config: Path | None = None) -> dict[str, Any]:
    """Run the command in a process of its own and say what it took."""
    words = ["report", source, "--out", page, "--limit", count, "--samples", samples]
    words += [] if config is None else ["--config", config]
    begun = time.perf_counter()
    process = subprocess.Popen([sys.executable, "-m", "pcdata", *map(str, words)], stderr=subprocess.DEVNULL)
    _, status, used = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise SystemExit(f"pcdata {' '.join(map(str, words))} ended with {process.returncode}")
    return {
        "captures": count,
        "samples": samples,
        "seconds": round(time.perf_counter() - begun, 1),
        "processor_seconds": round(used.ru_utime + used.ru_stime, 1),
        "peak_mb": round(used.ru_maxrss / 1024),
        "page_mb": round(page.stat().st_size / 1e6, 2),
        "load": round(os.getloadavg()[0], 1),
    }


def many_points(count: int) -> PointCloud:
    generator = torch.Generator().manual_seed(0)
    points = torch.randn(count, 3, generator=generator)
    points = 0.3 * torch.nn.functional.normalize(points, dim=1)
    return PointCloud(points=points, colors=points / 0.6 + 0.5, frame_id="base")


if __name__ == "__main__":
    main()
