"""Open one export with the loader that it is for; run by ``official_loaders.py`` in the Python of the loaders.

    python official_open.py TARGET CHECKOUTS EXPORT TRUTH.npz RESULT.json TOLD

Needs nothing of pcdata. The result has the samples that were loaded, what was equal, figures, what stood in for
modules that are not installed, versions, and every file of the checkouts that was imported with its git blob id.
"""

from __future__ import annotations

import hashlib
import importlib
import json
import subprocess
import sys
import types
from pathlib import Path
from unittest.mock import MagicMock

import numpy as np

SUITES = {
    "dp3": ("3D-Diffusion-Policy",),
    "dexart": ("3D-Diffusion-Policy", "ManiFlow_Policy"),
    "idp3": ("Improved-3D-Diffusion-Policy",),
    "maniflow": ("ManiFlow_Policy",),
    "demogen": ("DemoGen", "3D-Diffusion-Policy"),
    "rise": ("RISE", "pytorch3d"),
    "contact_graspnet": ("contact_graspnet",),
    "graspnet": ("graspnet-baseline",),
    "graspnet_scene": ("graspnet-baseline",),
    "pointnet": ("pointnet",),
    "pointnet_part": ("pointnet",),
    "modelnet": ("Pointnet_Pointnet2_pytorch", "pointnet2"),
    "pointcept": ("Pointcept",),
    "ggcnn": ("ggcnn",),
}


class Run:
    """One target: where its files are, and what was found."""

    def __init__(self, target: str, checkouts: Path, export: Path, truth: Path, told: dict) -> None:
        self.target, self.checkouts, self.export, self.told = target, checkouts, export, told
        held = np.load(truth)
        self.truth = {key.replace("|", "/"): held[key] for key in held.files}
        self.scratch = truth.parent / f"loader_{target}"
        self.scratch.mkdir(exist_ok=True)
        self.loaded: dict[str, int] = {}
        self.equal: dict[str, bool] = {}
        self.figures: dict[str, float] = {}
        self.stubs: list[str] = []
        self.also: dict[str, str] = {}

    def path(self, *folders: str) -> None:
        """Let modules be found in a folder of the checkouts."""
        place = self.checkouts.joinpath(*folders)
        if not place.is_dir():
            raise SystemExit(f"no checkout {folders[0]}: {place}")
        sys.path.insert(0, str(place))

    def stub(self, *names: str, always: bool = False) -> list[MagicMock]:
        """Put an empty module in the place of one that is not installed."""
        made = []
        for name in names:
            try:
                if always:
                    raise ImportError
                made.append(importlib.import_module(name))
            except ImportError:
                sys.modules[name] = module = MagicMock(name=name, __path__=[], __spec__=None)
                self.stubs.append(name)
                made.append(module)
        return made

    def bare(self, name: str, place: Path) -> None:
        """Make a package without running its ``__init__``, which imports all of its data sets."""
        module = types.ModuleType(name)
        module.__path__ = [str(place)]
        sys.modules[name] = module
        self.stubs.append(f"{name}/__init__.py")

    def names(self) -> list[str]:
        """Samples in order."""
        if "names" in self.truth:
            return [str(name) for name in self.truth["names"]]
        return sorted({key.split("/")[0] for key in self.truth if key.endswith("/depth")})

    def same(self, name: str, got: object, wanted: object, most: float = 0.0) -> None:
        """Compare arrays: bit for bit, or with the largest difference noted."""
        got, wanted = np.asarray(got), np.asarray(wanted)
        if got.shape != wanted.shape:
            self.equal[name] = False
            self.also[name] = f"shape {got.shape}, not {wanted.shape}"
            return
        off = float(np.abs(got.astype(np.float64) - wanted.astype(np.float64)).max()) if got.size else 0.0
        self.equal[name] = self.equal.get(name, True) and off <= most
        if most:
            self.figures[f"{name}: largest difference"] = max(off, self.figures.get(f"{name}: largest difference", 0.0))

    def holds(self, name: str, claim: object) -> None:
        """Note a claim; it stays false once it was."""
        self.equal[name] = self.equal.get(name, True) and bool(claim)

    def result(self) -> dict:
        """What goes into the file."""
        commits = {}
        for name in SUITES[self.target]:
            note, git = self.checkouts / name / "COMMIT", self.checkouts / name / ".git"
            if git.exists():
                commits[name] = subprocess.check_output(
                    ["git", "-C", str(git.parent), "rev-parse", "HEAD"], text=True
                ).strip()
            elif note.is_file():
                commits[name] = note.read_text().strip()
        files = {}
        for module in list(sys.modules.values()):
            file = getattr(module, "__file__", None)
            if isinstance(file, str) and Path(file).is_file():
                real = Path(file).resolve()
                if self.checkouts in real.parents:
                    data = real.read_bytes()
                    blob = hashlib.sha1(b"blob %d\0" % len(data) + data).hexdigest()
                    files[str(real.relative_to(self.checkouts))] = blob[:12]
        versions = {"python": sys.version.split()[0]}
        for name in ("numpy", "torch", "zarr", "h5py", "scipy", "skimage", "cv2", "open3d", "PIL"):
            if name in sys.modules and isinstance(version := getattr(sys.modules[name], "__version__", None), str):
                versions[name] = version
        return {
            "loaded": self.loaded, "equal": self.equal, "figures": self.figures, "notes": self.also,
            "stubbed": sorted(set(self.stubs)), "versions": versions, "commits": commits,
            "files": dict(sorted(files.items())),
        }  # fmt: skip


def main() -> None:
    """Run one target."""
    target, checkouts, export, truth, result, told = sys.argv[1:]
    sys.argv[1:] = []
    run = Run(target, Path(checkouts), Path(export), Path(truth), json.loads(told))
    np.random.seed(0)  # noqa: NPY002  (theirs draw from it)
    from official_images import IMAGES
    from official_policies import POLICIES
    from official_shapes import SHAPES

    (POLICIES | IMAGES | SHAPES)[target](run)
    Path(result).write_text(json.dumps(run.result()))


if __name__ == "__main__":
    main()
