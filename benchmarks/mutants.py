"""Damage valid files at random and see what every reader makes of them.

    python benchmarks/mutants.py --mutants 3000 --json benchmarks/results/mutants.json
    python benchmarks/mutants.py --readers depth_png meta_mat --mutants 60 --seeds FOLDER

Each mutant is read in a child process with a limit on its memory, and none may take longer than ten seconds. Outcomes:
a typed error; accepted with the value of the seed; accepted with another value, which a format without a checksum
cannot tell from an edit (counted); a foreign exception, a crash, a hang, memory exhausted. Those four are faults,
listed with the number that makes one again (``--only READER:NUMBER``). The same seed gives the same mutants.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import random
import re
import resource
import selectors
import shutil
import subprocess
import sys
import tempfile
import time
import traceback
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

TIMEOUT = 10.0  # seconds for one mutant
MEMORY = 2 << 30  # bytes that a reader may take beyond what it has when it starts
FAULTS = ("foreign exception", "crash", "hang", "memory")
NUMBERS = [
    0,
    1,
    2,
    127,
    128,
    255,
    256,
    32767,
    65535,
    65536,
    (1 << 31) - 1,
    1 << 31,
    (1 << 32) - 1,
    1 << 40,
    (1 << 63) - 1,
]
WORDS = [
    "-1", "0", "1e999", "nan", ".nan", "-inf", "9" * 5000, "''", "null", "true", "[]", "{}", "{a: " * 40, "[" * 3000,
    "&a", "*a", "!!int ''", "!!python/name:os.system", "\x00", "\x1b[2J", "../../etc/passwd", "é", "\ud7ff", "- ", ": ",
    "1,2,3", '"', "0x", "1_000", "2026-13-45", "1:2:3", "%s", "<<",
]  # fmt: skip


def mutant(data: bytes, number: random.Random) -> bytes:
    """Return damaged bytes: one to three edits, of bits, bytes, spans, number fields or words."""
    content = bytearray(data)
    text = not any(byte < 9 for byte in content[:512])
    for _ in range(number.choice((1, 1, 1, 2, 3))):
        if not content:
            break
        at = number.randrange(len(content))
        if number.random() < 0.5:  # heads hold what readers trust
            at = number.randrange(min(len(content), 512))
        edit = number.choice(("word", "word", "line", *_BYTES) if text else _BYTES)
        if edit == "bit":
            content[at] ^= 1 << number.randrange(8)
        elif edit == "byte":
            content[at] = number.choice((0, 255, number.randrange(256)))
        elif edit == "cut":
            del content[at:]
        elif edit == "extend":
            content += number.randbytes(number.randrange(1, 64))
        elif edit == "remove":
            del content[at : at + number.choice((1, 2, 4, 8, number.randrange(1, 200)))]
        elif edit == "double":
            span = content[at : at + number.choice((1, 4, 16, number.randrange(1, 500)))]
            content[at:at] = span
        elif edit == "move":
            span = content[at : at + number.randrange(1, 200)]
            to = number.randrange(len(content))
            content[to : to + len(span)] = span
        elif edit == "number":
            size = number.choice((1, 2, 4, 8))
            value = number.choice(NUMBERS) % (1 << 8 * size)
            content[at : at + size] = value.to_bytes(size, number.choice(("little", "big")))
        elif edit == "word":
            words = list(_WORD.finditer(content))
            if words:
                word = number.choice(words)
                content[word.start() : word.end()] = number.choice(WORDS).encode("utf-8", "surrogatepass")
        else:
            lines = content.split(b"\n")
            a, b = number.randrange(len(lines)), number.randrange(len(lines))
            change = number.choice(("swap", "double", "drop"))
            if change == "swap":
                lines[a], lines[b] = lines[b], lines[a]
            elif change == "double":
                lines.insert(a, lines[b])
            else:
                del lines[a]
            content = bytearray(b"\n".join(lines))
    return bytes(content)


_WORD = re.compile(rb"[^\s,:\[\]{}]+")
_BYTES = ("bit", "bit", "byte", "byte", "cut", "extend", "remove", "double", "move", "number", "number")


def digest(value: object) -> str:
    """Return a name for what was read, the same for equal values."""
    total = hashlib.sha256()
    _add(total, value)
    return total.hexdigest()


def _add(total: object, value: object) -> None:
    import numpy as np
    import torch

    if isinstance(value, torch.Tensor):
        value = value.detach().cpu().numpy()
    if isinstance(value, np.ndarray):
        total.update(f"{value.dtype}{value.shape}".encode() + np.ascontiguousarray(value).tobytes())
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
    """One seed of one reader: a folder, and which file of it is damaged."""

    def __init__(self, reader: str, folder: Path) -> None:
        from mutant_readers import READERS

        self.reader, self.folder = reader, folder
        pattern, self.read = READERS[reader]
        self.target = next(path for path in sorted(folder.glob(pattern)) if path.is_file())
        self.data = self.target.read_bytes()


def forms(reader: str, seeds: list[Path]) -> list[Path]:
    """Return the folders of one reader's seeds."""
    return [form for folder in seeds if (folder / reader).is_dir() for form in sorted((folder / reader).iterdir())]


def work(reader: str, seeds: list[Path], first: int, last: int, seed: int) -> None:
    """Read mutants one after another and write a line of JSON for each; the parent watches."""
    import warnings

    import pcdata  # noqa: F401
    from pcdata.errors import PcdataError

    warnings.simplefilter("ignore")
    with tempfile.TemporaryDirectory() as scratch:
        copies = []
        for index, folder in enumerate(forms(reader, seeds)):
            shutil.copytree(folder, Path(scratch) / str(index))
            copies.append(Form(reader, Path(scratch) / str(index)))
        truths = [digest(copy.read(copy.folder)) for copy in copies]  # also loads what is loaded lazily
        with open("/proc/self/statm") as status:
            used = int(status.read().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (used + MEMORY, used + MEMORY))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        if [digest(copy.read(copy.folder)) for copy in copies] != truths:
            raise RuntimeError("a seed is read differently under the limit on memory")
        start = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        print(json.dumps({"ready": True}), flush=True)
        for number in range(first, last):
            generator = random.Random(f"{seed}:{reader}:{number}")
            which = generator.randrange(len(copies))
            form = copies[which]
            content = mutant(form.data, generator)
            form.target.unlink(missing_ok=True)
            form.target.write_bytes(content)
            began, outcome, what = time.monotonic(), "", ""
            try:
                outcome = "equal" if digest(form.read(form.folder)) == truths[which] else "different"
            except PcdataError as error:
                outcome = "memory" if isinstance(error.__cause__, MemoryError) else "typed"
                if len(str(error)) > 20_000:
                    outcome, what = "foreign exception", f"a message of {len(str(error))} characters"
            except MemoryError as error:
                outcome, what = "memory", _where(error)
            except Exception as error:
                outcome, what = "foreign exception", _where(error)
            peak = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - start) * 1024
            line = {
                "number": number,
                "outcome": outcome,
                "what": what,
                "seconds": time.monotonic() - began,
                "peak": peak,
            }
            print(json.dumps({**line, "same_bytes": content == form.data, "size": len(content)}), flush=True)


def _where(error: BaseException) -> str:
    places = [frame for frame in traceback.extract_tb(error.__traceback__) if "/pcdata/" in frame.filename]
    place = f"{Path(places[-1].filename).name}:{places[-1].lineno}" if places else "?"
    return f"{type(error).__name__} at {place}: {str(error)[:150]}"


def batch(reader: str, seeds: list[Path], mutants: int, seed: int, first: int = 0) -> dict[str, object]:
    """Read so many mutants of one reader and count the outcomes."""
    counts: dict[str, int] = {}
    faults: list[dict[str, object]] = []
    slowest, peak, started, last = 0.0, 0, time.monotonic(), first + mutants
    number = first
    while number < last:
        command = [sys.executable, __file__, "--worker", reader, str(number), str(last), str(seed), *map(str, seeds)]
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as child:
            lines = _Lines(child)
            if (line := lines.next(300)) is None:
                child.kill()
                raise RuntimeError(f"{reader}: its seed cannot be read: {child.stderr.read()[-2000:]}")
            while number < last:
                line = lines.next(TIMEOUT + 2)
                if line is None:
                    hangs = child.poll() is None
                    child.kill()
                    child.wait()
                    outcome = "hang" if hangs else "crash"
                    faults.append({"number": number, "outcome": outcome, "what": f"exit {child.returncode}"})
                    counts[outcome] = counts.get(outcome, 0) + 1
                    number += 1
                    break
                told = json.loads(line)
                number = told["number"] + 1
                outcome = "hang" if told["seconds"] > TIMEOUT else told["outcome"]
                counts[outcome] = counts.get(outcome, 0) + 1
                slowest, peak = max(slowest, told["seconds"]), max(peak, told["peak"])
                if outcome in FAULTS:
                    faults.append({"number": told["number"], "outcome": outcome, "what": told["what"]})
    return {
        "mutants": mutants,
        "outcomes": dict(sorted(counts.items())),
        "slowest_seconds": round(slowest, 3),
        "peak_megabytes": round(peak / 2**20, 1),
        "seconds": round(time.monotonic() - started, 1),
        "faults": faults[:20],
    }


class _Lines:
    """Lines that a child writes, with a limit on the wait."""

    def __init__(self, child: subprocess.Popen[str]) -> None:
        self.child = child
        self.pending = b""
        self.selector = selectors.DefaultSelector()
        self.selector.register(child.stdout, selectors.EVENT_READ)

    def next(self, seconds: float) -> str | None:
        end = time.monotonic() + seconds
        while b"\n" not in self.pending:
            if not self.selector.select(max(0.0, end - time.monotonic())):
                return None
            read = os.read(self.child.stdout.fileno(), 1 << 16)
            if not read:
                self.child.wait()
                return None
            self.pending += read
        line, self.pending = self.pending.split(b"\n", 1)
        return line.decode()


def main(argv: list[str] | None = None) -> int:
    arguments = sys.argv[1:] if argv is None else argv
    if arguments[:1] == ["--worker"]:
        reader, first, last, seed, *seeds = arguments[1:]
        work(reader, [Path(path) for path in seeds], int(first), int(last), int(seed))
        return 0
    from mutant_readers import READERS, write_seeds

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--mutants", type=int, default=3000, help="of each reader")
    parser.add_argument("--readers", nargs="+", choices=sorted(READERS), default=sorted(READERS))
    parser.add_argument("--seeds", type=Path, help="a folder of more seeds: READER/NAME/files")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", help="READER:NUMBER: one mutant, again")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args(arguments)
    first = 0
    if options.only:
        reader, number = options.only.split(":")
        options.readers, options.mutants, first = [reader], 1, int(number)
    found: dict[str, object] = {}
    with tempfile.TemporaryDirectory() as own:
        write_seeds(Path(own))
        seeds = [Path(own), *([options.seeds.resolve()] if options.seeds else [])]
        for reader in options.readers:
            if not forms(reader, seeds):
                found[reader] = {"mutants": 0, "why": "no seed: an extra is not installed"}
                continue
            found[reader] = batch(reader, seeds, options.mutants, options.seed, first)
            print(reader, json.dumps(found[reader]), flush=True)
            if options.json:
                text = json.dumps({"seed": options.seed, "readers": found}, indent=1) + "\n"
                options.json.write_text(text, encoding="utf-8")
    wrong = sum(found[r].get("outcomes", {}).get(fault, 0) for r in found for fault in FAULTS)
    print(f"{len(found)} readers, {wrong} faults")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
