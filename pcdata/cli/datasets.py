"""Commands that show what is there: demo, inspect, doctor."""

from __future__ import annotations

import argparse
from typing import Any

from pcdata.cli.argument_types import positive
from pcdata.cli.options import add_capture_options, open_captures, said_again
from pcdata.cli.progress_bar import ProgressBar


def add_to(commands: Any) -> None:
    """Add the commands to the parser."""
    demo = commands.add_parser("demo", help="run the whole job on an embedded synthetic capture")
    demo.add_argument("out", nargs="?", default="pcdata_demo", metavar="OUT", help="folder (default: pcdata_demo)")
    demo.add_argument("--scenes", type=positive, default=4, metavar="N", help="captures to build from (default: 4)")
    demo.set_defaults(run=_demo)

    inspect = commands.add_parser("inspect", help="say what captures or a dataset hold, what is missing, how to go on")
    inspect.add_argument("path", metavar="PATH", help="captures of any layout, a cloud file, or a dataset")
    add_capture_options(inspect)
    inspect.add_argument("--limit", type=positive, metavar="N", help="only the first N captures")
    inspect.add_argument("--json", metavar="FILE", help="write the same as JSON to FILE, replacing it; - is the output")
    inspect.set_defaults(run=_inspect)

    doctor = commands.add_parser("doctor", help="say what is installed, which backends are live, what to install")
    doctor.set_defaults(run=_doctor)


def _demo(arguments: argparse.Namespace) -> None:
    from pathlib import Path
    from shlex import quote

    from pcdata.cli.demo import run_demo
    from pcdata.report.build_text import build_text

    with ProgressBar("demo") as progress:
        report, batches, picture = run_demo(arguments.out, num_scenes=arguments.scenes, progress=progress)
    print(build_text(report))
    points = sum(int(batch.mask.sum()) for batch in batches)
    print(f"\nloaded back with 2 workers, in batches of up to 4: {points:,} augmented points")
    print(f"dataset  {report.folder}  (python {Path(report.folder, 'load.py')} loads it)")
    print(f"picture  {picture}")
    print(f"look     pcdata report {quote(str(report.folder))}, or pcdata view {quote(str(report.folder))}")


def _inspect(arguments: argparse.Namespace) -> None:
    from pcdata.errors import ConfigError, PcdataError
    from pcdata.io.sources.listing import absolute
    from pcdata.io.store.manifest import FILE_NAME
    from pcdata.report.capture_facts import capture_facts
    from pcdata.report.hand_eye_facts import hand_eye_facts, hand_eye_text
    from pcdata.report.inspection_text import dataset_text, facts_text
    from pcdata.report.unopened_text import unopened_facts, unopened_text

    if (absolute(arguments.path) / FILE_NAME).is_file():
        if arguments.json:
            raise ConfigError(f"inspect: {arguments.path} is a dataset, whose {FILE_NAME} is JSON; leave --json out")
        print(dataset_text(arguments.path))
        return
    words = said_again(arguments, "--json")
    try:
        facts = capture_facts(open_captures(arguments.path, arguments, limit=arguments.limit))
    except ConfigError:
        raise
    except PcdataError as error:  # what can be told without opening it, and then why it is not opened
        told = unopened_facts(arguments.path, arguments.kind, error)
        if told is not None:
            _tell(arguments.json, told, unopened_text(told, words))
        elif arguments.kind is None and (poses := hand_eye_facts(arguments.path)) is not None:
            _tell(arguments.json, poses, hand_eye_text(poses))
            return
        raise
    _tell(arguments.json, facts, facts_text(facts, words))


def _tell(file: str | None, facts: dict[str, Any], text: str) -> None:

    from pcdata.files.opening import replacing
    from pcdata.files.strict_json import json_text

    document = json_text(facts, indent=1)
    if file == "-":
        print(document)
        return
    if file is not None:
        with replacing("inspect --json", file) as temporary:
            temporary.write_text(document + "\n", encoding="utf-8")
    print(text)


def _doctor(arguments: argparse.Namespace) -> None:
    from pcdata.report.health_text import health_text

    print(health_text())
