"""Read datasets that were damaged or forged: each must be refused with a typed error, or read as what it is.

    python benchmarks/hostile_datasets.py --out benchmarks/results/hostile_datasets.json
    python benchmarks/hostile_datasets.py --mutants 3000 --seed 1

Every mutant is a small dataset one file of which was changed: bits flipped, cut short, bytes put in or taken out,
numbers set to extremes. Half are left so, as a disk or a cable would; the other half get hashes, digests and checksums
that fit again, as an attacker would make them, so that what is checked behind those is reached. Then all of it is read:
opened, every sample alone and all as one batch, the signals, and ``pcdata verify``.

A mutant fails where another error than pcdata's comes out, where a file outside the dataset's folder is opened, where
anything is unpickled or started, or where the process needs more than 1 GB besides, takes a minute, or dies.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import random
import resource
import shutil
import signal
import struct
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import torch

import pcdata
from pcdata.build import build_dataset, config_from_yaml, verify_dataset
from pcdata.errors import PcdataError
from pcdata.io.sources.combine import SubsetSource
from pcdata.io.store.manifest import checksum_of
from pcdata.io.store.sample_keys import key_of
from pcdata.io.store.stores import STORES
from pcdata.synthetic import TeleopSource

CONFIG = "cloud: [ToFrame: {{frame: base}}, FarthestPointSample: {{num_points: 16}}]\ndepth: [Deproject]\n"
MORE_MEMORY = 1 << 30  # bytes
SECONDS = 60  # that one mutant may take
EXTREMES = (0, 1, -1, 2**31 - 1, -(2**31), 2**32, 2**53, 2**62, 2**63 - 1, -(2**63))


def seeds(folder: Path) -> dict[str, Path]:
    """Build one small dataset of several shards in every format."""
    source = TeleopSource(num_episodes=1, num_views=1, size=(8, 10))
    source = SubsetSource(source, source.ids[:6])
    for form in STORES:
        text = f"{CONFIG.format()}output: {{format: {form}, shard_size: 3}}\n"
        build_dataset(config_from_yaml(text), source, folder / form)
    return {form: folder / form for form in STORES}


def mutated(content: bytes, draw: random.Random) -> bytes:
    """Change some bytes."""
    data, kind = bytearray(content), draw.randrange(7)
    place = draw.randrange(len(data)) if data else 0
    if kind == 0:
        for _ in range(draw.choice([1, 1, 1, 3, 16])):
            data[draw.randrange(len(data))] ^= 1 << draw.randrange(8)
    elif kind == 1:
        del data[place:]
    elif kind == 2:
        data[place:place] = draw.randbytes(draw.choice([1, 8, 100]))
    elif kind == 3:
        del data[place : place + draw.choice([1, 8, 100])]
    elif kind == 4:  # a number where numbers lie
        place -= place % 8
        data[place : place + 8] = struct.pack("<q", draw.choice(EXTREMES))[: len(data) - place]
    elif kind == 5:
        other, size = draw.randrange(len(data)), draw.choice([1, 8, 64])
        data[place : place + size] = data[other : other + size]
    else:  # a number in a text
        text = content.decode("latin-1")
        digits = [at for at, letter in enumerate(text) if letter.isdigit()]
        if digits:
            at = draw.choice(digits)
            data[at : at + 1] = draw.choice([b"-1", b"9", b"99999999999", b"1e9", b"null", b'"x"', b"[]"])
    return bytes(data)


def sealed_again(folder: Path, form: str) -> None:
    """Let all hashes of a dataset fit what is there, as far as it can still be read."""
    for path in folder.rglob("*.packed"):
        content = bytearray(path.read_bytes())
        begin, length, _, magic = struct.unpack("<QQ32s16s", content[-64:])
        if begin < len(content) - 64:
            digest = hashlib.sha256(content[begin:-64]).digest()
            content[-64:] = struct.pack("<QQ32s16s", begin, length, digest, magic)
            path.write_bytes(content)
    digests_again(folder, form)
    hashes = []
    for shard in sorted((folder / "shards").iterdir()):
        table = shard / "files.tsv"
        lines = []
        for line in table.read_bytes().split(b"\n")[:-1]:
            _, _, name, *_ = [*line.split(b"\t"), b"", b"", b""]
            path = Path(os.fsdecode(bytes(shard) + b"/" + name)) if b"\0" not in name else table
            if path.is_file() and folder in path.resolve().parents:
                content = path.read_bytes()
                line = b"\t".join([hashlib.sha256(content).hexdigest().encode(), b"%d" % len(content), name])
            lines.append(line + b"\n")
        table.write_bytes(b"".join(lines))
        hashes.append(hashlib.sha256(table.read_bytes()).digest())
    tables = folder / "index" / "shard_tables.npy"
    head = tables.read_bytes()[:128]
    if len(tables.read_bytes()) == 128 + 32 * len(hashes):
        tables.write_bytes(head + b"".join(hashes))
    text = (folder / "dataset.json").read_text("utf-8")
    content = json.loads(text)
    for name, told in content["index"].items():
        path = folder / "index" / name
        if path.is_file():
            told.update(bytes=path.stat().st_size, sha256=hashlib.sha256(path.read_bytes()).hexdigest())
    content.pop("checksum", None)
    (folder / "dataset.json").write_text(json.dumps({**content, "checksum": checksum_of(content)}))


def digests_again(folder: Path, form: str) -> None:
    """Let the digests of the index fit the records that can be read."""
    path = folder / "index" / "digests.npy"
    shards, ends, digests = (np.load(folder / "index" / f"{name}.npy") for name in ("shards", "id_ends", "digests"))
    letters = (folder / "index" / "ids.npy").read_bytes()[128:]
    for number in range(min(len(shards), len(ends), len(digests), 100)):
        store = STORES[form](folder / "shards" / f"{shards[number]:05d}")
        try:
            key = key_of(letters[ends[number - 1] if number else 0 : ends[number]].decode())
            digests[number] = np.frombuffer(bytes.fromhex(store.read(key).digest()), np.uint8)
        except (PcdataError, ValueError, TypeError):
            continue
        finally:
            store.close()
    np.save(path, digests)


def read_all(folder: Path) -> None:
    """Read everything that a dataset has; a typed error in one part does not keep the others from being read."""
    dataset = pcdata.CachedCloudDataset(folder, seed=0)
    list(dataset.ids)
    list(dataset.manifest.samples)
    for read in (*(lambda n=n: dataset[n] for n in range(len(dataset))), dataset.signal_table):
        with_typed_errors(read)
    with_typed_errors(lambda: list(dataset.__getitems__([*range(len(dataset))])))
    with_typed_errors(lambda: dataset.ids.place_of(dataset.ids[0]))


def with_typed_errors(read: Any) -> str | None:
    """Return the type of pcdata's error that comes out, or None."""
    try:
        read()
    except PcdataError as error:
        if len(str(error)) > 10_000:
            raise AssertionError("its message is no message") from error
        return type(error).__name__
    return None


def watch(allowed: Path, found: list[str]) -> None:
    """Note whatever a dataset must not make a process do."""
    own = (str(allowed), str(Path(pcdata.__file__).parents[1]), sys.prefix, sys.base_prefix, "/proc", "/dev", "/sys")

    def hook(event: str, values: tuple[Any, ...]) -> None:
        is_module = event == "exec" and getattr(values[0], "co_filename", "").startswith(own)  # an import
        if event in ("pickle.find_class", "os.system", "subprocess.Popen", "os.exec", "exec") and not is_module:
            found.append(f"{event} {values!r:.200}")
        elif event == "open" and isinstance(values[0], (str, bytes, os.PathLike)):
            path = os.path.realpath(os.fsdecode(values[0]))
            if not path.startswith(own):
                found.append(f"open {path}")

    sys.addaudithook(hook)


def run(form: str, seed: Path, work: Path, numbers: range, base: int) -> dict[str, Any]:
    """Read some mutants of one dataset in this process."""
    outcomes: Counter[str] = Counter()
    bad: list[dict[str, Any]] = []
    seen: list[str] = []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        read_all(seed)
        verify_dataset(seed)
        size = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (size + MORE_MEMORY, size + MORE_MEMORY))
        watch(work, seen)
        files = sorted(path.relative_to(seed).as_posix() for path in seed.rglob("*") if path.is_file())
        files = [name for name in files if name not in ("load.py", "pipeline.yaml")]
        for number in numbers:
            draw = random.Random(f"{base} {form} {number}")
            name, forged = draw.choice(files), draw.random() < 0.5
            shutil.rmtree(work, ignore_errors=True)
            shutil.copytree(seed, work)
            before = (work / name).read_bytes()
            (work / name).write_bytes(mutated(before, draw))
            if forged:
                try:
                    sealed_again(work, form)
                except Exception:  # what is damaged so much cannot be sealed
                    forged = False
            seen.clear()
            signal.alarm(SECONDS)
            try:
                told = with_typed_errors(lambda: read_all(work)) or "opened"
                faults: list[Any] = []
                failed = with_typed_errors(lambda: faults.extend(verify_dataset(work).faults))  # noqa: B023
                told += f", verify: {failed or ('faults' if faults else 'none')}"
                if not (forged or faults or failed or _same((work / name).read_bytes(), before)):
                    raise AssertionError("damage that nobody forged was not found")
                if seen:
                    raise AssertionError(f"it did what no dataset may: {seen[0]}")
            except BaseException as error:
                what = f"{type(error).__name__}: {error!s:.300}"
                bad.append({"mutant": number, "file": name, "forged": forged, "error": what})
                bad[-1]["where"] = traceback.format_exc()[-1500:]
                told = "BAD"
            finally:
                signal.alarm(0)
            kind = Path(name).suffix if Path(name).parent.name == "clouds" else Path(name).name
            outcomes[f"{kind} {'forged' if forged else 'damaged'}: {told}"] += 1
    return {"outcomes": dict(outcomes), "bad": bad}


def _same(one: bytes, other: bytes) -> bool:
    """Say whether two files are the same, or the same JSON but for the spaces between."""
    try:
        return one == other or json.loads(one) == json.loads(other)
    except ValueError:
        return False


def main() -> None:
    """Make and read the mutants, a part of them in each child process."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--mutants", type=int, default=4000)
    parser.add_argument("--formats", nargs="+", metavar="FORMAT", help="only these")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--part", nargs=4, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.part:
        form, root, first, stop = arguments.part
        work = Path(root) / "work" / form
        found = run(form, Path(root) / form, work, range(int(first), int(stop)), arguments.seed)
        print(json.dumps(found))
        return
    import subprocess

    started, outcomes, bad = time.perf_counter(), Counter[str](), []
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder).resolve()
        forms = [form for form in seeds(root) if form in (arguments.formats or STORES)]
        each = -(-arguments.mutants // len(forms))
        for form in forms:
            for first in range(0, each, 250):
                part = ["--part", form, str(root), str(first), str(min(first + 250, each))]
                done = subprocess.run(
                    [sys.executable, __file__, "--seed", str(arguments.seed), *part], capture_output=True, text=True
                )
                try:
                    found = json.loads(done.stdout.splitlines()[-1])
                except (IndexError, ValueError):
                    bad.append({"part": part[1:], "exit": done.returncode, "error": done.stderr[-2000:]})
                    continue
                outcomes.update({f"{form} {what}": count for what, count in found["outcomes"].items()})
                bad += [{"format": form, **one} for one in found["bad"]]
    result = {
        "mutants": sum(outcomes.values()),
        "bad": bad,
        "seconds": round(time.perf_counter() - started),
        "torch": torch.__version__,
        "outcomes": dict(sorted(outcomes.items())),
    }
    print(json.dumps({**result, "outcomes": len(outcomes)}, indent=1))
    if arguments.out:
        arguments.out.write_text(json.dumps(result, indent=1) + "\n")
    sys.exit(bool(bad))


if __name__ == "__main__":
    main()
