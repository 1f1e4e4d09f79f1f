"""The command line: a thin layer that parses, calls and prints."""

from __future__ import annotations

import argparse
import os
import signal
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from types import FrameType
from typing import Any, ClassVar

from pcdata import __version__
from pcdata.errors import ConfigError, PcdataError


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return the exit code: 0 done, 1 the data or a file is at fault, 2 the request is."""
    arguments = _parser().parse_args(argv)
    try:
        with _signals_interrupt():
            arguments.run(arguments)
            sys.stdout.flush()
    except KeyboardInterrupt:
        print("interrupted; nothing half-written was left behind", file=sys.stderr)
        return 130
    except PcdataError as error:
        if arguments.debug:
            raise
        print(f"pcdata: {error}", file=sys.stderr)
        for note in getattr(error, "__notes__", ()):
            print(f"  {note}", file=sys.stderr)
        return 2 if isinstance(error, ConfigError) else 1
    except BrokenPipeError:  # "pcdata inspect ... | head" has read enough
        sys.stdout = open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115  # for the flush at exit
        return 0
    except OSError as error:
        if arguments.debug:
            raise
        print(f"pcdata: {error}", file=sys.stderr)
        return 1
    return 0


@contextmanager
def _signals_interrupt() -> Iterator[None]:
    """Let a polite kill clean up like Ctrl-C; Python allows that in the main thread only."""
    _Progress.interrupted = False
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    # One that is ignored (nohup, a job in the background) stays so.
    numbers = [n for n in (signal.SIGINT, signal.SIGTERM) if signal.getsignal(n) is not signal.SIG_IGN]
    previous = {number: signal.signal(number, _interrupt) for number in numbers}
    try:
        yield
    finally:
        for number, handler in previous.items():
            signal.signal(number, signal.SIG_DFL if handler is None else handler)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="pcdata", description="From raw depth frames to training-ready point clouds.")
    parser.add_argument("--version", action="version", version=f"pcdata {__version__}")
    parser.add_argument("--debug", action="store_true", help="show the traceback of an error")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    demo = commands.add_parser("demo", help="run the whole job on an embedded synthetic capture")
    demo.add_argument("out", nargs="?", default="pcdata_demo", metavar="OUT", help="folder (default: pcdata_demo)")
    demo.add_argument("--scenes", type=_positive, default=4, metavar="N", help="captures to build from (default: 4)")
    demo.set_defaults(run=_demo)

    build = commands.add_parser("build", help="build a dataset from captures")
    build.add_argument("config", metavar="CONFIG", help="YAML file; see configs/ for examples")
    build.add_argument("--source", required=True, metavar="PATH", help="folder of captures, or one cloud file")
    build.add_argument("--out", required=True, metavar="DIR", help="folder of the new dataset")
    build.add_argument("--kind", metavar="LAYOUT", help="capture layout, where it cannot be told from the files")
    build.add_argument("--metres-per-unit", type=float, metavar="M", help="length of one stored depth unit")
    build.add_argument("--limit", type=_positive, metavar="N", help="only the first N captures")
    build.add_argument("--overwrite", action="store_true", help="replace the dataset that is in DIR")
    build.set_defaults(run=_build)

    inspect = commands.add_parser("inspect", help="say what a dataset, a capture folder or a cloud file holds")
    inspect.add_argument("path", metavar="PATH")
    inspect.add_argument("--kind", metavar="LAYOUT", help="capture layout, where it cannot be told from the files")
    inspect.add_argument("--metres-per-unit", type=float, metavar="M", help="length of one stored depth unit")
    inspect.set_defaults(run=_inspect)

    doctor = commands.add_parser("doctor", help="say what is installed, which backends are live, what to install")
    doctor.set_defaults(run=_doctor)
    for command in (demo, build, inspect, doctor):  # also after the command, where one adds it to a line that failed
        command.add_argument("--debug", action="store_true", default=argparse.SUPPRESS, help=argparse.SUPPRESS)
    return parser


def _positive(text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"must be a whole number of at least 1, got {text!r}")
    return int(text)


def _interrupt(number: int, frame: FrameType | None) -> None:
    _Progress.interrupted = True
    raise KeyboardInterrupt


def _demo(arguments: argparse.Namespace) -> None:
    from pcdata.demo import run_demo

    with _Progress("demo") as progress:
        result = run_demo(arguments.out, num_scenes=arguments.scenes, progress=progress)
    print(_build_table(result.report))
    points = sum(int(batch.mask.sum()) for batch in result.batches)
    print(f"\nloaded back with 2 workers: {len(result.batches)} batches, {points:,} augmented points")
    print(f"dataset  {result.report.folder}  (python {result.report.folder / 'load.py'} loads it)")
    print(f"picture  {result.picture}")


def _build(arguments: argparse.Namespace) -> None:
    from pcdata.build import build_dataset, load_config

    config = load_config(arguments.config)
    source = _open(arguments, limit=arguments.limit)
    with _Progress("build") as progress:
        report = build_dataset(config, source, arguments.out, overwrite=arguments.overwrite, progress=progress)
    print(_build_table(report))
    print(f"\ndataset  {report.folder}  (python {report.folder / 'load.py'} loads it)")


def _inspect(arguments: argparse.Namespace) -> None:
    from pcdata.io.manifest import FILE_NAME
    from pcdata.io.source import absolute
    from pcdata.report.inspection import capture_text, dataset_text

    if (absolute(arguments.path) / FILE_NAME).is_file():
        print(dataset_text(arguments.path))
    else:
        print(capture_text(_open(arguments)))


def _doctor(arguments: argparse.Namespace) -> None:
    from pcdata.report.health import health_text

    print(health_text())


def _open(arguments: argparse.Namespace, limit: int | None = None) -> Any:
    from pcdata.io import open_source

    options = {} if arguments.metres_per_unit is None else {"metres_per_unit": arguments.metres_per_unit}
    path = arguments.source if "source" in arguments else arguments.path
    return open_source(path, kind=arguments.kind, limit=limit, **options)


def _build_table(report: Any) -> str:
    from pcdata.report.inspection import build_text

    return build_text(report)


class _Progress:
    """A bar on a terminal, plain lines elsewhere; also the place where a lost Ctrl-C is heard."""

    interrupted: ClassVar[bool] = False

    def __init__(self, what: str) -> None:
        self.what = what
        self.bar: Any = None
        self.started = time.perf_counter()

    def __enter__(self) -> _Progress:
        return self

    def __exit__(self, *_: object) -> None:
        if self.bar is not None:
            self.bar.close()

    def __call__(self, done: int, total: int, sample_id: str) -> None:
        if self.interrupted:  # it was raised inside a destructor or a callback, where Python drops exceptions
            raise KeyboardInterrupt
        if not sys.stderr.isatty():
            print(f"{self.what} {done}/{total} {sample_id} {time.perf_counter() - self.started:.1f} s", file=sys.stderr)
            return
        if self.bar is None:
            from tqdm import tqdm

            self.bar = tqdm(total=total, desc=self.what, unit="sample", file=sys.stderr)
        self.bar.set_postfix_str(sample_id)
        self.bar.update(done - self.bar.n)
