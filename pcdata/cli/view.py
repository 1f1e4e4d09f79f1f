"""The command that shows captures in a browser, or in Rerun: view."""

from __future__ import annotations

import argparse
import os
import signal
import sys
from pathlib import Path
from typing import Any

from pcdata.cli import signals
from pcdata.cli.argument_types import port, positive
from pcdata.cli.options import add_capture_options, open_captures
from pcdata.cli.progress_bar import ProgressBar
from pcdata.cli.report import is_dataset


def add_to(commands: Any) -> None:
    """Add the command to the parser."""
    view = commands.add_parser("view", help="look at captures or a dataset in a browser, each read when it is chosen")
    view.add_argument("path", metavar="PATH", help="folder of captures, a recording, one cloud file, a dataset, a page")
    add_capture_options(view)
    view.add_argument("--limit", type=positive, metavar="N", help="only the first N captures")
    view.add_argument("--config", metavar="FILE.yaml", help="show the cloud after each step of this pipeline")
    view.add_argument(
        "--port", type=port, metavar="N", default=0, help="of the address on 127.0.0.1 (default: a free one)"
    )
    view.add_argument("--no-open", action="store_true", help="print the address and open no browser")
    view.add_argument("--rerun", action="store_true", help="show all captures in Rerun instead (extra rerun)")
    view.add_argument("--out", metavar="FILE.rrd", help="with --rerun: write a recording that Rerun opens later")
    view.set_defaults(run=_view)


def _view(arguments: argparse.Namespace) -> int:
    from pcdata.build import load_config
    from pcdata.datasets.stored_clouds import StoredClouds
    from pcdata.report.html.gathering import title_of
    from pcdata.report.serving.samples import Samples
    from pcdata.report.serving.server import ViewServer

    _check(arguments)
    path = Path(arguments.path)
    if path.suffix.lower() in (".html", ".htm") and path.is_file():
        address = path.resolve().as_uri()
        print(f"page     {address}")
        _open(arguments, address)
        return 0
    if is_dataset(arguments):
        source: Any = StoredClouds(path)
    else:
        source = open_captures(arguments.path, arguments, limit=arguments.limit)
    pipeline = None if arguments.config is None else load_config(arguments.config).pipeline
    if arguments.rerun:
        return _rerun(arguments, source, pipeline)
    with ViewServer(Samples(source, pipeline), title=title_of(source), port=arguments.port) as server:
        print(f"showing  {source}")
        print(f"address  {server.address}")
        print("Ctrl-C ends it; who works on another machine forwards the port: ", end="")
        print(f"ssh -L {server.server_port}:127.0.0.1:{server.server_port} HOST", flush=True)
        _open(arguments, server.opening_address)
        try:
            server.serve_forever(poll_interval=0.2)
        except KeyboardInterrupt:
            if signals.current.first not in (None, signal.SIGINT):
                raise  # ended by somebody else: the exit code says so
            print("ended")
    return 0


def _check(arguments: argparse.Namespace) -> None:
    from pcdata import extras
    from pcdata.errors import ConfigError

    if arguments.out and not arguments.rerun:
        raise ConfigError("--out: is of --rerun; pcdata report --out writes a page")
    if not arguments.rerun:
        return
    if arguments.port or arguments.no_open:
        raise ConfigError("--rerun: has neither --port nor --no-open; --out FILE.rrd opens no window")
    extras.require("rerun")
    if not arguments.out and not _has_display():
        raise ConfigError("--rerun: there is no display; write a recording with --out FILE.rrd, and open it elsewhere")


def _rerun(arguments: argparse.Namespace, source: Any, pipeline: Any) -> int:
    from pcdata import extras
    from pcdata.report.rerun_log import log_to_rerun, save_rerun

    with ProgressBar("view") as progress:
        if arguments.out:
            logged = save_rerun(arguments.out, source, pipeline=pipeline, progress=progress)
        else:
            stream = extras.require("rerun").RecordingStream("pcdata")
            stream.spawn()
            logged = log_to_rerun(stream, source, pipeline=pipeline, progress=progress)
            stream.disconnect()
    print(f"logged   {logged} of {len(source.ids)} captures" + (f" to {arguments.out}" if arguments.out else ""))
    return int(logged == 0)


def _has_display() -> bool:
    return not sys.platform.startswith("linux") or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def _open(arguments: argparse.Namespace, address: str) -> None:
    """Open a browser beside this command; none where it would take over the terminal."""
    import webbrowser

    if arguments.no_open:
        return
    if not _has_display():
        print("no browser is opened: there is no display", file=sys.stderr)
        return
    if not webbrowser.open(address):
        print("no browser was found: open the address by hand", file=sys.stderr)
