"""Kill and interrupt every command that writes, at random moments, and look at what is left.

    python benchmarks/interrupted_builds.py [--seed 0] [--kills 2] [--signals 1]    # results/interrupted_builds.json

For every command: so many SIGKILLs, and so many bursts of five SIGINT, SIGTERM and SIGHUP within 100 ms, half of them
while the command ends. The result must be the old one or the new one, byte for byte (of an export that is continued:
finished items of the new one); the next command must succeed, give the new one, and leave no hidden file; no traceback
may be shown; the exit code of an interrupted command is 128 and the number of the signal, and nothing is left.

Commands are forks of one process that has loaded torch, so that the moments fall into the work and not into imports.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

RESULTS = Path(__file__).parent / "results"
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
BURST, PAUSE = 5, 0.02  # signals, seconds between them
PROGRESS = ("build", "export", "fuse", "validate")  # how lines that tell it begin
NUM_CAPTURES, OLD = 10, 4  # captures; of which an old result holds so many

# Runs a command per line of its input, in a fork; prints the number of the process, and its status when it has ended.
SERVER = """
import json, os, sys, torch, h5py, scipy.io, PIL.Image
torch.set_num_threads(1)
import pcdata.build, pcdata.exports, pcdata.calibration, pcdata.validation, pcdata.report.inspection_text, pcdata.io
from pcdata.cli import calib, datasets, export, fuse, main, models, sensors, validate
for line in sys.stdin:
    call = json.loads(line)
    pid = os.fork()
    if not pid:
        os.close(0)
        for number, name in ((1, "out"), (2, "err")):
            os.dup2(os.open(call[name], os.O_WRONLY | os.O_CREAT | os.O_TRUNC), number)
        sys.argv = ["pcdata", *call["arguments"]]
        raise SystemExit(main())
    print(pid, flush=True)
    print(os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]), flush=True)
"""


@dataclass(frozen=True)
class Case:
    """A command that writes ``out``; with ``again`` it replaces or continues what is there."""

    name: str
    arguments: tuple[str, ...]
    again: tuple[str, ...] = ("--overwrite",)
    old: tuple[str, ...] | None = ("--limit", str(OLD))  # makes the old result; None = there is none
    out: str = "out"
    goes_on: bool = False  # an export that keeps its finished items


class Server:
    """Runs commands."""

    def __init__(self, work: Path) -> None:
        self.work = work
        environment = os.environ | {"OMP_NUM_THREADS": "1"}
        self._process = subprocess.Popen(
            [sys.executable, "-c", SERVER], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment
        )

    def start(self, arguments: tuple[str, ...]) -> int:
        """Start a command and return the number of its process."""
        call = {"arguments": arguments, "out": str(self.work / "stdout"), "err": str(self.work / "stderr")}
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps(call) + "\n")
        self._process.stdin.flush()
        return int(self._line())

    def wait(self) -> int:
        """Return the exit code of what was started; that of a killed one is negative."""
        return int(self._line())

    def run(self, *arguments: str) -> float:
        """Run a command that must succeed; return its seconds."""
        started = time.perf_counter()
        self.start(arguments)
        if self.wait():
            raise RuntimeError(f"{arguments}: {self.errors()}")
        return time.perf_counter() - started

    def errors(self) -> str:
        """Return what the last command wrote to its standard error, without its progress."""
        lines = (self.work / "stderr").read_text().splitlines()
        return "\n".join(line for line in lines if line.split(" ")[0] not in PROGRESS)

    def close(self) -> None:
        """End the process."""
        self._process.communicate()

    def _line(self) -> str:
        assert self._process.stdout is not None
        return self._process.stdout.readline()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--kills", type=int, default=2, help="of each command")
    parser.add_argument("--signals", type=int, default=1, help="bursts of each signal, of each command")
    parser.add_argument("--only", default="", help="commands whose name holds this")
    arguments = parser.parse_args()
    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as name:
        work = Path(name)
        server = Server(work)
        try:
            prepare(server, work)
            for case in cases(work):
                if arguments.only in case.name:
                    rows += trials(server, case, work, arguments)
                    result = summary(rows, arguments.seed)
                    if not arguments.only:  # after every command: a run takes minutes
                        (RESULTS / "interrupted_builds.json").write_text(json.dumps(result, indent=1) + "\n")
        finally:
            server.close()
    print(json.dumps({key: value for key, value in result.items() if key != "left"}, indent=1))
    sys.exit(bool(result["faults"]))


def summary(rows: list[dict[str, Any]], seed: int) -> dict[str, Any]:
    """Count what became of the commands so far."""
    counts = Counter((row["case"], row["signal"], row["left"]) for row in rows)
    return {
        "seed": seed,
        "kills": sum(row["signal"] == "SIGKILL" for row in rows),
        "bursts": sum(row["signal"] != "SIGKILL" for row in rows),
        "stopped": sum(row["stopped"] for row in rows),  # the others had ended before
        "faults": [row for row in rows if row["faults"]],
        "left": [{"case": a, "signal": b, "left": c, "count": n} for (a, b, c), n in sorted(counts.items())],
    }


def trials(server: Server, case: Case, work: Path, arguments: argparse.Namespace) -> list[dict[str, Any]]:
    """Stop one command again and again."""
    draw = random.Random(f"{arguments.seed} {case.name}")
    place = work / "place"
    old: dict[str, str] = {}
    shutil.rmtree(work / "old", ignore_errors=True)
    (work / "old").mkdir()
    command = tuple(part.replace("PLACE", str(place)) for part in case.arguments)
    if case.old is not None:
        restore(work / "old", place)
        server.run(*command, *case.old)
        shutil.copytree(place, work / "old", dirs_exist_ok=True)
        old = tree(place / case.out)
    restore(work / "old", place)
    again = command + (case.again if case.old is not None or case.goes_on else ())
    seconds = server.run(*again)
    new = tree(place / case.out)
    assert new != old, f"{case.name}: old and new are alike"
    rows = []
    for number in [signal.SIGKILL] * arguments.kills + [*SIGNALS] * arguments.signals:
        restore(work / "old", place)
        delay = seconds * (draw.uniform(0, 1.1) if draw.random() < 0.5 else draw.uniform(0.8, 1.1))
        pid = server.start(again)
        time.sleep(delay)
        for _ in range(1 if number == signal.SIGKILL else BURST):
            try:
                os.kill(pid, number)
            except ProcessLookupError:
                break
            time.sleep(PAUSE)
        code, errors = server.wait(), server.errors()
        left = tree(place / case.out)
        hidden = [name for name in os.listdir(place) if name != case.out]
        faults = [] if "Traceback" not in errors and "Exception ignored" not in errors else [f"traceback: {errors}"]
        if left not in (old, new) and not (case.goes_on and is_part(left, new)):
            faults.append(f"neither old nor new: {sorted(set(left.items()) ^ set(new.items()))[:5]}")
        if number == signal.SIGKILL:
            faults += [] if code in (0, -number) else [f"exit code {code}: {errors}"]
        else:
            # By the signal itself, which shells show as 128 and its number too: before or after the command's own work.
            outside = code == -number and not errors
            fine = code == 128 + number or outside or (code == 0 and left == new)
            faults += [] if fine else [f"exit code {code}: {errors}"]
            # A build that has finished a shard keeps it.
            goes_on = case.name.startswith("build") and hidden == [".out.building"]
            faults += [f"left behind: {hidden}"] if hidden and not goes_on else []
            expected = "interrupted; 1 of 1 shards" if goes_on else "interrupted; nothing half-written was left behind"
            if code and not outside and not errors.startswith(expected):
                faults.append(f"said: {errors}")
        next_command = command + (case.again if case.goes_on or left else ())
        server.start(next_command)
        if server.wait():
            faults.append(f"the next command failed: {server.errors()}")
        elif (found := tree(place / case.out)) != new:
            faults.append(f"the next command gave others: {sorted(set(found.items()) ^ set(new.items()))[:5]}")
        if others := [name for name in os.listdir(place) if name != case.out]:
            faults.append(f"still there: {others}")
        state = "old" if left == old else "new" if left == new else "part"
        name = signal.Signals(number).name
        rows.append({"case": case.name, "signal": name, "stopped": code != 0, "left": state, "faults": faults})
        print(f"{case.name:28} {name:8} at {delay:5.2f} of {seconds:5.2f} s: {state:5} {faults or ''}", flush=True)
    return rows


def is_part(left: dict[str, str], new: dict[str, str]) -> bool:
    """Say whether every file but the export's own record is a finished one."""
    return all(new.get(name) == digest for name, digest in left.items() if name != "pcdata_export.json")


def restore(old: Path, place: Path) -> None:
    """Put the old result into an otherwise empty place."""
    shutil.rmtree(place, ignore_errors=True)
    shutil.copytree(old, place)


def tree(path: Path) -> dict[str, str]:
    """Return the digest of every file below a path, hidden ones too; nothing where there is nothing."""
    files = [path] if path.is_file() else [file for file in path.rglob("*") if file.is_file()]
    names = {file: file.relative_to(path).as_posix() for file in files}
    return {name: hashlib.sha256(file.read_bytes()).hexdigest() for file, name in names.items()}


# -- what is written -----------------------------------------------------------------------------------------------


def prepare(server: Server, work: Path) -> None:
    """Write captures, configurations, datasets and side files."""
    import numpy as np

    from pcdata.io.writers.capture_folder import write_capture
    from pcdata.synthetic import SyntheticSource

    source = SyntheticSource(num_scenes=NUM_CAPTURES, num_objects=2, num_views=1, size=(60, 80))
    captures = work / "captures"
    for number, sample_id in enumerate(source.ids):
        write_capture(source.load(sample_id), work / "one")
        for file in [file for file in (work / "one" / "view0").rglob("*") if file.is_file()]:
            place = captures / file.relative_to(work / "one" / "view0")
            place.parent.mkdir(parents=True, exist_ok=True)
            shutil.move(file, place if place.parent == captures else place.with_stem(f"{number:04}"))
        shutil.rmtree(work / "one")
    steps = "depth: [MaskDepth: {near: 0.1, far: 3.0}, Deproject]\ncloud: [ToFrame: {frame: base}, SIZE]\n"
    sample = "FarthestPointSample: {num_points: 512, if_short: repeat}"
    whole = "FarthestPointSample: {num_points: 2048, if_short: repeat}, NormalizeUnitSphere: {}"
    for name, output in {
        "hdf5": "{format: hdf5}",
        "hdf5_gzip": "{format: hdf5, compression: gzip}",
        "npz": "{format: npz}",
        "npz_raw": "{format: npz, keep_raw: true}",
        "pt": "{format: pt}",
    }.items():
        (work / f"{name}.yaml").write_text(steps.replace("SIZE", sample) + f"output: {output}\n")
    (work / "shapes.yaml").write_text(steps.replace("SIZE", whole) + "output: {format: hdf5}\n")
    server.run("build", f"{work}/npz.yaml", "--source", f"{captures}", "--out", f"{work}/dataset")
    server.run("build", f"{work}/shapes.yaml", "--source", f"{captures}", "--out", f"{work}/shapes")
    names = [f"{number:04}" for number in range(NUM_CAPTURES)]
    for many, file in ((NUM_CAPTURES, "all"), (OLD, "few")):
        (work / file).mkdir()
        robot = np.zeros((many, 7))
        np.savez(work / file / "0001.npz", samples=np.array(names[:many]), state=robot, action=robot)
    rows = [f"{name},{'mug' if number % 2 else 'bowl'},train" for number, name in enumerate(names)]
    (work / "table.csv").write_text("\n".join(["sample,class,split", *rows]) + "\n")
    (work / "poses.json").write_text(json.dumps({"unit": "metre", "poses": robot_poses()}))


def robot_poses() -> list[dict[str, Any]]:
    """A robot that looks at a board from twelve sides, exact to a tenth of a millimetre."""
    import torch

    from pcdata.geometry import rigid

    draw = torch.Generator().manual_seed(0)

    def pose(scale: float = 1.0) -> torch.Tensor:
        quaternion = torch.randn(4, generator=draw, dtype=torch.float64)
        offset = scale * torch.randn(3, generator=draw, dtype=torch.float64)
        return rigid.from_rotation_translation(rigid.rotation_from_quaternion(quaternion), offset)

    gripper_from_camera, base_from_target = pose(0.05), pose(0.4)
    poses = []
    for _ in range(12):
        base_from_gripper = pose(0.3)
        seen = torch.linalg.inv(base_from_gripper @ gripper_from_camera) @ base_from_target
        seen[:3, 3] += 1e-4 * torch.randn(3, generator=draw, dtype=torch.float64)
        poses.append({"base_from_gripper": base_from_gripper.tolist(), "camera_from_target": seen.tolist()})
    return poses


def cases(work: Path) -> list[Case]:
    """Every command that writes, in every form."""
    captures = f"{work}/captures"
    found = []
    for name in ("hdf5", "hdf5_gzip", "npz", "npz_raw", "pt"):
        build = ("build", f"{work}/{name}.yaml", "--source", captures, "--out", "PLACE/out")
        found += [Case(f"build {name}", build, old=None), Case(f"build {name} --overwrite", build)]
    dataset, out = f"{work}/dataset", ("--out", "PLACE/out")
    for target, path, options in (
        ("pointcept", dataset, ()),
        ("contact_graspnet", captures, ("--set", "label_offset=1")),
        ("dp3", dataset, ("--set", f"episodes={work}/all", "--set", "colors=false")),
        ("pointnet", f"{work}/shapes", ("--set", f"table={work}/table.csv")),
    ):
        export = ("export", path, "--to", target, *out, *options)
        found.append(Case(f"export {target}", export, old=None))
        found.append(Case(f"export {target} --continue", export, ("--continue",), old=None, goes_on=True))
    graspnet = ("export", captures, "--to", "contact_graspnet", *out, "--set", "label_offset=1")
    found.append(Case("export contact_graspnet --overwrite", graspnet))
    for name, options in (("volume.npz", ()), ("cloud.ply", ()), ("mesh.ply", ("--mesh",))):
        fuse = ("fuse", captures, "--voxel-size", "0.01", "--out", f"PLACE/{name}", *options)
        found.append(Case(f"fuse {name}", fuse, out=name))
    hand_eye = ("calib", "hand-eye", f"{work}/poses.json", "--setup", "eye-in-hand", "--out", "PLACE/cell.yaml")
    found.append(
        Case("calib hand-eye", hand_eye, ("--camera", "wrist"), ("--camera", "wrist", "--date", "then"), "cell.yaml")
    )
    validate = ("validate", captures, "--json", "PLACE/report.json")
    found.append(Case("validate --json", validate, (), out="report.json"))
    return found


if __name__ == "__main__":
    main()
