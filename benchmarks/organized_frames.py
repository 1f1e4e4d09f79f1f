"""Organized real captures through normals and outliers, one process per frame: no crash, and the reference's answers.

    PCDATA_TEST_DATA=... python benchmarks/organized_frames.py [--limit 2] [--out RESULTS.json]

Of every folder that a source reads, and of every other folder of 16-bit PNG, EXR or .npy depth images, the first
``--limit`` frames; the latter with a camera made up, for only the geometry of the pixels matters here. In a process of
its own each frame goes through three settings each of statistical outliers, radius outliers and normals, with its image
grid. Compared: masks of the whole frame with those found without the grid, by another search, and masks of 4,000 points
of the first view with torch's; normals of the whole frame with those found without the grid (a thousandth may differ:
where two directions tie, either may be given).
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

SETTINGS: dict[str, list[dict[str, Any]]] = {
    "statistical_outlier_mask": [
        {"num_neighbors": 20, "std_ratio": 2.0},
        {"num_neighbors": 8, "std_ratio": 1.0},
        {"num_neighbors": 40, "std_ratio": 3.0},
    ],
    "radius_outlier_mask": [
        {"min_neighbors": 5, "radius": 0.01},
        {"min_neighbors": 16, "radius": 0.02},
        {"min_neighbors": 3, "radius": 0.005},
    ],
    "estimate_normals": [
        {"radius": 0.02, "max_neighbors": 30},
        {"radius": 0.01, "max_neighbors": 9},
        {"radius": 0.05, "max_neighbors": 48},
    ],
}
MOST_COMPARED = 4000


def check_frame(folder: str, capture: str) -> dict[str, Any]:
    """Run all settings on one capture; return what differs from the reference."""
    import pcdata
    from pcdata import functional as F
    from pcdata.functional.image_grid import ImageGrid

    if Path(capture).is_file():
        depth, intrinsics = read_image(Path(capture))
    else:
        frame = pcdata.open_source(folder).load(capture)
        if isinstance(frame, pcdata.PointCloud):
            return check_cloud(frame)
        depth, intrinsics = frame.depth, frame.camera.intrinsics
    points, ptr, pixel = F.deproject_depth(depth, intrinsics)
    return compared(points, ptr, ImageGrid(pixel, (depth.shape[1], depth.shape[2]), intrinsics))


def check_cloud(cloud: Any) -> dict[str, Any]:
    """Check a cloud whose rows are the pixels of an image, with a Kinect's camera."""
    import torch

    from pcdata.functional.image_grid import ImageGrid

    if "organized_size" not in cloud.meta[0]:
        return {"skipped": "neither a depth frame nor an organized cloud"}
    height, width = cloud.meta[0]["organized_size"]
    camera = [[525.0, 0, (width - 1) / 2], [0, 525.0, (height - 1) / 2], [0, 0, 1]]
    grid = ImageGrid(cloud.source_index, (height, width), torch.tensor([camera], dtype=torch.float64))
    return compared(cloud.points, cloud.ptr, grid)


def compared(points: Any, ptr: Any, grid: Any) -> dict[str, Any]:
    """Run all settings with the grid, without it, and on a part by the reference."""
    import torch

    from pcdata import functional as F
    from pcdata.functional.image_grid import ImageGrid

    if len(points) == 0:
        return {"points": 0, "differences": 0}
    first = int(ptr[1]) // 2
    part = slice(max(0, first - MOST_COMPARED // 2), min(int(ptr[1]), first + MOST_COMPARED // 2))
    some, some_ptr = points[part], torch.tensor([0, part.stop - part.start])
    some_grid = ImageGrid(grid.pixel_index[part], grid.size, grid.intrinsics[:1])
    differences = 0
    for name, settings in SETTINGS.items():
        function = getattr(F, name)
        for options in settings:
            with_grid = function(points, ptr, **options, grid=grid)
            without = function(points, ptr, **options)
            if with_grid.dtype is torch.bool:
                reference = function(some, some_ptr, **options, backend="torch_tree")
                ours = function(some, some_ptr, **options, grid=some_grid)
                differences += int((with_grid != without).sum()) + int((ours != reference).sum())
            else:
                # Sums taken in another order: directions that stand out agree; where two tie, any may be given.
                apart = torch.minimum((with_grid - without).abs().amax(1), (with_grid + without).abs().amax(1))
                differences += int((~torch.isfinite(with_grid)).sum()) + int((apart > 1e-3).sum() > len(apart) // 1000)
    return {"points": len(points), "differences": differences}


def read_image(path: Path) -> tuple[Any, Any]:
    """Read one depth image in metres, (1, H, W), and a camera that could have taken it."""
    import numpy as np
    import torch

    if path.suffix == ".npy":
        values = np.load(path, allow_pickle=False)
    elif path.suffix == ".exr":
        import cv2

        values = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    else:
        from PIL import Image

        values = np.asarray(Image.open(path))
    values = np.squeeze(values if values.ndim < 3 or values.shape[-1] in (1,) else values[..., 0])
    scale = 0.001 if values.dtype.kind in "iu" else 1.0
    depth = np.nan_to_num(values.astype(np.float32) * np.float32(scale), nan=0, posinf=0, neginf=0).clip(0, 50)
    height, width = depth.shape
    camera = [[0.9 * width, 0, (width - 1) / 2], [0, 0.9 * width, (height - 1) / 2], [0, 0, 1]]
    return torch.from_numpy(depth)[None], torch.tensor([camera], dtype=torch.float64)


def depth_images(folder: Path) -> list[str]:
    files = [path for path in sorted(folder.iterdir()) if path.suffix in (".png", ".npy", ".exr")]
    return [str(path) for path in files if "depth" in f"{folder.name}/{path.name}".lower()]


def frames(data: Path, limit: int) -> list[tuple[str, str]]:
    """List (folder, capture) of everything below the data that opens as a source."""
    import pcdata

    found = []
    for folder in [*sorted(path for path in data.glob("*") if path.is_dir()), *sorted(data.glob("*/*/"))]:
        try:
            ids = list(pcdata.open_source(folder).ids)
        except Exception as error:
            ids = depth_images(folder)
            if not ids:
                print(f"{folder.name:40s} skipped: {str(error).splitlines()[0][:100]}")
        found += [(str(folder), capture) for capture in ids[:limit]]
    return found


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--limit", type=int, default=2)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--frame", nargs=2, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.frame:
        print(json.dumps(check_frame(*options.frame)))
        return
    os.environ.setdefault("OPENCV_IO_ENABLE_OPENEXR", "1")
    data = Path(os.environ["PCDATA_TEST_DATA"])
    rows = []
    for folder, capture in frames(data, options.limit):
        start = time.perf_counter()
        command = [sys.executable, __file__, "--frame", folder, capture]
        done = subprocess.run(command, capture_output=True, text=True, timeout=600)
        # A loose file is named by its own path, a capture by its id within the folder.
        row: dict[str, Any] = {"frame": str((Path(folder) / capture).relative_to(data)), "exit": done.returncode}
        if done.returncode == 0:
            row |= json.loads(done.stdout.splitlines()[-1])
        else:
            row["error"] = (done.stderr.strip().splitlines() or [""])[-1]
        rows.append(row)
        print(f"{row['frame']:60s} {row} {time.perf_counter() - start:.1f} s", flush=True)
    crashes = sum(row["exit"] < 0 for row in rows)
    differences = sum(row.get("differences", 0) for row in rows)
    print(f"{len(rows)} frames, {crashes} crashes, {differences} differences")
    if options.out:
        options.out.write_text(json.dumps({"crashes": crashes, "differences": differences, "frames": rows}, indent=1))


if __name__ == "__main__":
    main()
