"""Files are read through pcdata.files.opening alone: nothing else opens a path."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

import pcdata

ROOT = Path(pcdata.__file__).parent
MODULES = sorted(path.relative_to(ROOT).as_posix() for path in ROOT.rglob("*.py"))

# Methods and functions that open a path for reading, whatever they are called on.
OPENS = {
    "open", "read_bytes", "read_text", "load", "loadtxt", "genfromtxt", "fromfile", "memmap", "open_memmap", "loadmat",
    "imread", "File", "ZipFile", "Reader", "connect",
}  # fmt: skip
# What looks like it and is none: the call, and why.
ALLOWED = {
    "files/opening.py": {"os.open": "the door"},
    "datasets/batch_transport.py": {"os.open": "memory of a worker, which says its own name in it"},
    "cli/demo.py": {"(files('pcdata') / 'demo.yaml').read_text": "a file of the package"},
    "report/html/page.py": {"(files('pcdata.report.html') / 'web' / name).read_text": "a file of the package"},
    "cli/view.py": {"webbrowser.open": "an address, which a browser opens"},
    "report/figures/panels.py": {"Image.open": "of bytes that it has made"},
    "sensors/known_sensors.py": {
        "files('pcdata.sensors').joinpath('profiles.yaml').read_text": "a file of the package"
    },
    "io/images/reading.py": {"Image.open": "of bytes"},
    "io/images/writing.py": {"Image.open": "of bytes that it has made"},
    "io/images/exr.py": {"library.File": "after the door, when its structure was checked"},
    "io/sources/matroska.py": {"av.open": "of a stream that the door has opened"},
    "io/images/video.py": {"av.open": "of a stream that the door has opened"},
    "io/messages/sqlite_file.py": {"sqlite3.connect": "after the door, to read alone"},
    "io/arrays/hdf5_arrays.py": {"h5py.File": "after the door", "h5o.open": "within a file that is open"},
    "io/store/hdf5_store.py": {"h5py.File": "to write"},
    "files/inputs.py": {"open": "what the door has opened, once more: has it changed?"},
    "files/locks.py": {"os.open": "to lock it"},
    "files/part_files.py": {"os.open": "to write"},
    "files/pipes.py": {"os.open": "a pipe that it has made"},
    "files/scratch.py": {"Path(f'/proc/{pid}/stat').read_bytes": "of the system, not of a user"},
    "files/syncing.py": {"os.open": "to force it to disk"},
    "kernels/core/write_signatures.py": {"HEADER.read_text": "a source of the package, by who builds it"},
    "cli/build.py": {"config.source.open": "a capture, not a file"},
}


def reads(module: str) -> set[str]:
    """Calls that open a path and do not say that they write."""
    found = set()
    for node in ast.walk(ast.parse((ROOT / module).read_text(encoding="utf-8"))):
        if not isinstance(node, ast.Call):
            continue
        called = ast.unparse(node.func)
        name = called.rsplit(".", 1)[-1]
        if name not in OPENS or (name == "load" and not called.startswith(("np.", "numpy.", "torch."))):
            continue
        if name in ("read_bytes", "read_text") and "." not in called:
            continue  # those of pcdata.files.opening
        modes = [argument.value for argument in node.args if isinstance(argument, ast.Constant)]
        if any(isinstance(mode, str) and mode[:1] in ("w", "x", "a", "r") and "r" not in mode[:1] for mode in modes):
            continue
        found.add(called)
    return found


@pytest.mark.parametrize("module", MODULES)
def test_no_module_opens_a_file_by_itself(module):
    others = reads(module) - set(ALLOWED.get(module, ()))
    assert not others, f"{module}: open files through pcdata.files.opening, not with {sorted(others)}"


def test_what_is_allowed_is_there():
    for module, calls in ALLOWED.items():
        assert set(calls) <= reads(module)
