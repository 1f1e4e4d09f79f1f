"""``pcdata build``: a dataset from captures, resumed where it was stopped."""

from __future__ import annotations

import argparse
import os
import sys
from typing import TYPE_CHECKING, Any

from pcdata.cli.argument_types import count, positive
from pcdata.cli.choices import add_model_options, given_preset
from pcdata.cli.known_names import FORMATS
from pcdata.cli.options import add_capture_options, given_options, skip_list
from pcdata.cli.progress_bar import ProgressBar

if TYPE_CHECKING:
    from pcdata.build import BuildConfig

_SHOWN = 20  # of what lies beside the captures and is not read
QUARANTINED = 3  # exit code: the dataset is there, but some captures are not in it
_INDEX = ("SLURM_ARRAY_TASK_ID", "JOB_COMPLETION_INDEX")  # of Slurm's array jobs, and of Kubernetes' indexed ones


def add_to(commands: Any) -> None:
    """Add the command to the parser."""
    build = commands.add_parser(
        "build",
        help="build a dataset from captures",
        description="Build a dataset from captures. A build that was stopped goes on where it was. Exit code: 0 done, "
        "1 the data or a file is at fault, 2 the request is, 3 done but for captures that were quarantined.",
    )
    build.add_argument(
        "config",
        nargs="?",
        metavar="CONFIG",
        help="YAML file, see configs/; or a dataset, to build it again (default: none, with --model)",
    )
    add_model_options(
        build,
        required=False,
        help="build what a model takes, instead of the steps of CONFIG",
        also=", or a setting of CONFIG, SECTION.STEP.FIELD=VALUE, such as cloud.FarthestPointSample.num_points=2048",
    )
    build.add_argument(
        "--source",
        metavar="PATH",
        help="folder of captures, or of several cameras' folders, or one cloud file (default: that of CONFIG)",
    )
    build.add_argument("--out", metavar="DIR", help="folder of the new dataset, or a URL such as s3://bucket/set")
    build.add_argument(
        "--format",
        metavar="FORMAT",
        help=f"of the stored clouds: {', '.join(FORMATS)} (default: that of CONFIG, or hdf5)",
    )
    add_capture_options(build, can_skip_refused=False)
    build.add_argument("--limit", type=positive, metavar="N", help="only the first N captures")
    build.add_argument("--overwrite", action="store_true", help="replace the dataset that is in DIR")
    build.add_argument(
        "--restart",
        action="store_true",
        help="delete an unfinished build of DIR and begin anew",
    )
    build.add_argument(
        "--retry-quarantined",
        action="store_true",
        help="try the captures again that are quarantined in DIR; their shards are built anew, the rest is kept",
    )
    _add_ways(build)
    build.add_argument(
        "--dry-run", action="store_true", help="say what would be built, how large, and what is finished; write nothing"
    )
    build.add_argument(
        "--print-config", action="store_true", help="print the configuration with everything resolved; build nothing"
    )
    build.set_defaults(run=_build, out_may_be_url=True)


def _add_ways(build: argparse.ArgumentParser) -> None:
    """Add what says who does the work, and when to stop."""
    ways = build.add_argument_group("who works, and when to stop")
    ways.add_argument(
        "--workers",
        type=count,
        metavar="N",
        help="processes of one thread each; 0 = none but this one (default: one per core, if there are several shards)",
    )
    ways.add_argument(
        "--timeout", type=float, metavar="S", help="seconds that one capture may take before its worker is ended"
    )
    ways.add_argument(
        "--max-bad",
        metavar="N",
        help="stop when more captures than N, or than a share such as 1%%, are quarantined; within it the exit code is "
        "0 (default: go on, and exit with 3)",
    )
    ways.add_argument(
        "--strict",
        action="store_true",
        help="fail where a step drops more than is usual or a capture is an outlier of the rest (default: say so)",
    )
    ways.add_argument(
        "--hash-captures",
        action="store_true",
        help="tell captures that changed by the content of all their files (default: large ones by size and time)",
    )
    ways.add_argument(
        "--engine", default="pool", metavar="NAME", help="pool: processes of this machine; ray: a cluster"
    )
    ways.add_argument("--num-shards", type=positive, metavar="N", help="of jobs that share the work: how many they are")
    ways.add_argument(
        "--shard-index",
        type=count,
        metavar="K",
        help=f"which of them this is, from 0 (default: {' or '.join(_INDEX)} of the environment)",
    )
    ways.add_argument(
        "--finalize", action="store_true", help="only put a dataset into place, once every shard is finished"
    )


def _build(arguments: argparse.Namespace) -> int:
    from pathlib import Path

    from pcdata.build import build_dataset, plan_of
    from pcdata.errors import ConfigError
    from pcdata.files.urls import is_in_process
    from pcdata.io.sources.capture_source import unread_of
    from pcdata.io.store.url_dataset import is_read_at_urls
    from pcdata.report.build_text import build_text, notes_of, plan_text
    from pcdata.validation.first_look import judge_of_all

    config = _config(arguments)
    if arguments.print_config:
        print(config.to_yaml(), end="")
        return 0
    if arguments.out is None:
        raise ConfigError("build: needs --out DIR, the folder of the new dataset")
    source = config.source.open()
    part = _part(arguments)
    asked = {
        "overwrite": arguments.overwrite,
        "restart": arguments.restart,
        "timeout": arguments.timeout,
        "max_bad": arguments.max_bad,
        "engine": arguments.engine,
        "part": part,
        "finalize": arguments.finalize,
        "hash_captures": arguments.hash_captures,
        "retry_quarantined": arguments.retry_quarantined,
        "workers": _workers(arguments, 1 if is_in_process(arguments.out) else plan_of(config, source).num_shards),
    }
    for line in unread_of(source)[:_SHOWN]:
        print(f"not read: {line}", file=sys.stderr)
    if arguments.dry_run:
        print(plan_text(config, source, arguments.out, **asked))
        return 0
    with ProgressBar("build") as progress:
        report = build_dataset(
            config, source, arguments.out, strict=arguments.strict, progress=progress, note=progress.note, **asked
        )
    print(build_text(report))
    if report.is_complete:
        loads = f"  (python {report.folder / 'load.py'} loads it)" if isinstance(report.folder, Path) else ""
        print(f"\ndataset  {report.folder}{loads}")
        if not isinstance(report.folder, Path) and not is_read_at_urls(config.output.format):
            print(f"         {config.output.format} is read from a copy on the disk; webdataset also where it is")
        look = [f"{report.look} {judge_of_all(source, arguments.source or '')}"] if report.look else []
        for note in [*notes_of(config, report), *look]:
            print(f"note     {note}")
        if report.quarantined and isinstance(report.folder, Path):
            print("         once the cause is mended, the same command with --retry-quarantined tries those again")
    return QUARANTINED if report.quarantined and arguments.max_bad is None else 0


def _config(arguments: argparse.Namespace) -> BuildConfig:
    """Return the configuration with all that the command line says."""
    from dataclasses import replace

    from pcdata.build import config_from_yaml, load_config
    from pcdata.errors import ConfigError

    if arguments.config is None and arguments.model is None:
        raise ConfigError("build: nothing says what to build; give a CONFIG, or --model NAME")
    # A path has a dot, as in cloud.CropWorkspace.bounds; the choices of a model have none.
    settings = [(name, value) for name, value in arguments.set if "." in name]
    choices = [(name, value) for name, value in arguments.set if "." not in name]
    if choices and arguments.model is None:
        raise ConfigError(
            f"build: --set {choices[0][0]} makes a choice for a model; give --model NAME, or say which setting of the "
            "configuration it is: --set SECTION.STEP.FIELD=VALUE, such as output.format=npz"
        )
    if arguments.config is None:
        config = config_from_yaml("output: {}", name="build", settings=settings)
    else:
        config = load_config(arguments.config, settings=settings)
    if arguments.model is not None:
        config = config.for_model(given_preset(arguments.model, choices))
    if arguments.format is not None:
        config = config.stored_as(arguments.format)
    source = config.source.with_arguments(
        arguments.source,
        kind=arguments.kind,
        only=arguments.only or (),
        limit=arguments.limit,
        skip=skip_list(arguments),
        **given_options(arguments),
    )
    return replace(config, source=source)


def _part(arguments: argparse.Namespace) -> tuple[int, int] | None:
    from pcdata.errors import ConfigError

    if arguments.num_shards is None:
        if arguments.shard_index is not None:
            raise ConfigError("build: --shard-index needs --num-shards: of how many jobs this is one")
        return None
    index = arguments.shard_index
    if index is None:
        told = next((text for name in _INDEX if (text := os.environ.get(name, ""))), "")
        if not told.isdecimal():
            raise ConfigError(f"build: --num-shards needs --shard-index, or {' or '.join(_INDEX)} in the environment")
        index = int(told)
    if index >= arguments.num_shards:
        raise ConfigError(
            f"build: --shard-index must be below --num-shards {arguments.num_shards}, got {index}; the first is 0"
        )
    return index, arguments.num_shards


def _workers(arguments: argparse.Namespace, num_shards: int) -> int:
    """Return how many processes to start: where one job is all there is, none, unless something must be ended."""
    if arguments.workers is not None or arguments.engine != "pool":
        return arguments.workers or 0
    cores = len(os.sched_getaffinity(0)) if sys.platform == "linux" else os.cpu_count() or 1
    least = 0 if arguments.timeout is None else 1
    return max(least, min(cores, num_shards)) if num_shards > 1 else least
