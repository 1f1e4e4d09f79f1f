"""The processes that read mutants, apart from the one that counts them: what they do to themselves is seen there.

One process imports pcdata once and forks a child for every task, which takes a second less than a new interpreter. It
reads tasks as lines of JSON and writes lines of JSON: those of the children, and how each ended.
"""

from __future__ import annotations

import gc
import hashlib
import importlib
import json
import os
import random
import resource
import selectors
import shutil
import subprocess
import sys
import tempfile
import time
import traceback
import warnings
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent))

from mutant_edits import mutant

ADDRESSES = 4 << 30  # bytes that a reader may map beyond what it has when it starts: the machine is not to swap
# docs/security.md states these bounds on the memory that reading one file takes.
TIMES_FILE = 400
FLOOR_PLAIN = 64 << 20  # bytes, however small the file is
FLOOR_PACKED = 1 << 30  # the same, of a format that unpacks
# So that freed memory goes back at once, and the peak of one mutant is not hidden by what the one before has left.
_ENVIRONMENT = {"OMP_NUM_THREADS": "1", "MALLOC_MMAP_THRESHOLD_": "131072", "MALLOC_TRIM_THRESHOLD_": "131072"}


def digest(value: object) -> str:
    """Return a name for what was read, the same for equal values."""
    total = hashlib.sha256()
    _add(total, value)
    return total.hexdigest()


def _add(total: Any, value: object) -> None:
    import numpy as np
    import torch

    if isinstance(value, torch.Tensor):
        value = value.detach().cpu().numpy()
    if isinstance(value, np.ndarray):
        total.update(f"{value.dtype}{value.shape}".encode())
        total.update(memoryview(np.ascontiguousarray(value).reshape(-1)).cast("B") if value.size else b"")
    elif isinstance(value, dict):
        for key in sorted(value, key=str):
            _add(total, key)
            _add(total, value[key])
    elif isinstance(value, (list, tuple)):
        for item in value:
            _add(total, item)
    elif hasattr(value, "__dict__") and type(value).__module__.startswith("pcdata"):
        _add(total, {name: item for name, item in vars(value).items() if name not in ("path", "_ids", "provenance")})
    else:
        total.update(repr(value).encode("utf-8", "surrogatepass"))


class Form:
    """One seed of one reader: a folder, and which files of it are damaged, one at a time."""

    def __init__(self, reader: str, folder: Path) -> None:
        from mutant_readers import PACKED, READERS

        self.reader, self.folder = reader, folder
        pattern, self.read = READERS[reader]
        self.files = {path: path.read_bytes() for path in sorted(folder.glob(pattern)) if path.is_file()}
        self.floor = FLOOR_PACKED if reader in PACKED else FLOOR_PLAIN


def forms(reader: str, seeds: list[Path]) -> list[Path]:
    """Return the folders of one reader's seeds."""
    return [form for folder in seeds if (folder / reader).is_dir() for form in sorted((folder / reader).iterdir())]


def work(reader: str, seeds: list[str], first: int, last: int, seed: int, floor: int | None) -> None:
    """Read mutants one after another and write a line of JSON for each; the parent watches."""
    warnings.simplefilter("ignore")
    with tempfile.TemporaryDirectory() as scratch:
        tempfile.tempdir = scratch  # this process ends without what readers delete at their end
        copies = []
        for index, folder in enumerate(forms(reader, [Path(path) for path in seeds])):
            shutil.copytree(folder, Path(scratch) / str(index))
            copies.append(Form(reader, Path(scratch) / str(index)))
        truths = [digest(copy.read(copy.folder)) for copy in copies]  # also loads what is loaded lazily
        most = _memory("VmSize") + ADDRESSES
        resource.setrlimit(resource.RLIMIT_AS, (most, most))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        if [digest(copy.read(copy.folder)) for copy in copies] != truths:
            raise RuntimeError("a seed is read differently under the limit on memory")
        _tell(ready=True)
        for number in range(first, last):
            generator = random.Random(f"{seed}:{reader}:{number}")
            which = generator.randrange(len(copies))
            form = copies[which]
            target, data = generator.choice([*form.files.items()])
            target.unlink()  # a file that is still mapped stays as it is
            target.write_bytes(mutant(data, generator))
            _tell(number=number, **_read(form, truths[which], form.floor if floor is None else floor))
            target.unlink()
            target.write_bytes(data)


def _read(form: Form, truth: str, floor: int) -> dict[str, object]:
    """Read the files as they are now, and say what came of it."""
    from pcdata.errors import PcdataError

    size = sum(path.stat().st_size for path in form.folder.rglob("*") if path.is_file())

    outcome, what = "", ""
    Path("/proc/self/clear_refs").write_text("5")  # begins the peak again
    before, began = _memory("VmRSS"), time.monotonic()
    try:
        outcome = "equal" if digest(form.read(form.folder)) == truth else "different"
    except PcdataError as error:
        outcome = "memory" if isinstance(error.__cause__, MemoryError) else "typed"
        if len(str(error)) > 20_000:
            outcome, what = "foreign exception", f"a message of {len(str(error))} characters"
    except MemoryError as error:
        outcome, what = "memory", _where(error)
    except Exception as error:
        outcome, what = "foreign exception", _where(error)
    seconds, peak = time.monotonic() - began, _memory("VmHWM") - before
    if peak > max(floor, TIMES_FILE * size):
        outcome, what = "memory", f"{peak >> 20} MiB for {size} bytes of files"
        gc.collect()
    return {"outcome": outcome, "what": what, "seconds": seconds, "peak": peak}


def _memory(name: str) -> int:
    """Return a number of bytes that the system keeps about this process."""
    with open("/proc/self/status", encoding="ascii") as status:
        return next(int(line.split()[1]) * 1024 for line in status if line.startswith(f"{name}:"))


def _where(error: BaseException) -> str:
    places = [frame for frame in traceback.extract_tb(error.__traceback__) if "/pcdata/" in frame.filename]
    place = f"{Path(places[-1].filename).name}:{places[-1].lineno}" if places else "?"
    return f"{type(error).__name__} at {place}: {str(error)[:150]}"


def _tell(**line: object) -> None:
    os.write(1, (json.dumps(line) + "\n").encode())  # at once, and less than a pipe takes in one piece


def serve(modules: list[str]) -> None:
    """Fork a child for every task on standard input."""
    import pcdata  # noqa: F401

    for name in ("h5py", "PIL.Image", "pcdata.build", "pcdata.calibration", "mutant_readers", *modules):
        importlib.import_module(name)
    gc.freeze()
    for line in sys.stdin:
        child = os.fork()
        if not child:
            os.dup2(os.open(os.devnull, os.O_WRONLY), 2)  # what libtiff and others in C say
            try:
                _tell(child=os.getpid())
                work(**json.loads(line))
            except BaseException:
                _tell(broken=traceback.format_exc()[-2000:])
                os._exit(1)
            os._exit(0)
        _tell(ended=os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))


class Server:
    """The process that forks, as the one that counts sees it.

    Args:
        modules: more to import there, as names; a test adds readers with it.
        paths: where those are found.
    """

    def __init__(self, modules: list[str] | None = None, paths: list[Path] | None = None) -> None:
        path = os.pathsep.join([*map(str, paths or []), os.environ.get("PYTHONPATH", "")])
        self._process = subprocess.Popen(
            [sys.executable, __file__, *(modules or [])],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env={**os.environ, **_ENVIRONMENT, "PYTHONPATH": path.rstrip(os.pathsep)},
        )
        self._pending = b""
        self._child = 0
        self._selector = selectors.DefaultSelector()
        self._selector.register(self._process.stdout, selectors.EVENT_READ)

    def __enter__(self) -> Server:
        return self

    def __exit__(self, *_: object) -> None:
        self._process.stdin.close()
        self._process.kill()
        self._process.wait()
        self._process.stdout.close()

    def start(self, **task: object) -> None:
        """Begin a task: the arguments of :func:`work`."""
        self._process.stdin.write((json.dumps(task) + "\n").encode())
        self._process.stdin.flush()
        if "child" not in (told := self.next(300)):
            raise RuntimeError(f"the process that reads mutants does not start: {told}")
        self._child = told["child"]
        if "ready" not in (told := self.next(300)):
            raise RuntimeError(f"{task['reader']}: its seed cannot be read: {told.get('broken', told)}")

    def next(self, seconds: float) -> dict[str, Any]:
        """Return the next line, or an empty one where none comes in time."""
        end = time.monotonic() + seconds
        while b"\n" not in self._pending:
            if not self._selector.select(max(0.0, end - time.monotonic())):
                return {}
            read = os.read(self._process.stdout.fileno(), 1 << 16)
            if not read:
                raise RuntimeError("the process that reads mutants has ended")
            self._pending += read
        line, self._pending = self._pending.split(b"\n", 1)
        told: dict[str, Any] = json.loads(line)
        return told

    def stop(self) -> None:
        """End the child that reads."""
        os.kill(self._child, 9)
        while "ended" not in self.next(60):
            pass


if __name__ == "__main__":
    serve(sys.argv[1:])
