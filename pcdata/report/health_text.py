"""What is installed, which backends are live, and what to install."""

from __future__ import annotations

import os
import platform
import textwrap
from collections.abc import Iterator, Sequence

import torch

import pcdata
import pcdata.functional
from pcdata import extras
from pcdata.contracts import dispatch
from pcdata.files.sample_names import counted
from pcdata.report.plain_table import text_table

_WIDTH = 120  # columns of a line


def health_text() -> str:
    """Return the report of ``pcdata doctor``."""
    cuda = "none" if not torch.cuda.is_available() else torch.cuda.get_device_name(0)
    threads = counted(torch.get_num_threads(), "thread")
    machine = [
        ["pcdata", pcdata.__version__],
        ["Python", f"{platform.python_version()} on {platform.system()} {platform.machine()}"],
        ["torch", f"{torch.__version__}, {threads}, {counted(os.cpu_count() or 1, 'core')}"],
        ["CUDA device", cuda],
    ]
    backends = []
    for name in dispatch.backends():
        reason = dispatch.why_unavailable(name)
        operations = [op for op, entry in sorted(dispatch.OPERATIONS.items()) if entry.serves(name)]
        serves = "every operation, on any device" if name == dispatch.REFERENCE else ", ".join(operations)
        backends.append([name, "live" if reason is None else "absent", serves if reason is None else reason])
    optional = []
    for extra in extras.EXTRAS.values():
        problem = extras.why_missing(extra.module)
        optional.append([extra.module, "installed" if problem is None else "absent", problem or extra.purpose])
    return "\n\n".join(
        [
            text_table(["machine", ""], machine),
            text_table(["backend", "state", "serves, or what to do"], list(_wrapped(backends))),
            text_table(["optional", "state", "for, or what to do"], list(_wrapped(optional))),
        ]
    )


def _wrapped(rows: Sequence[Sequence[str]]) -> Iterator[list[str]]:
    """Yield rows whose last cell goes on in rows of its own where it is long; a command stays on one line."""
    room = _WIDTH - sum(2 + max(map(len, column)) for column in zip(*(row[:-1] for row in rows)))
    for *others, text in rows:
        words, command, rest = text.partition("pip install")
        lines = textwrap.wrap(words, room, break_on_hyphens=False)
        if command:
            whole = f"{lines[-1]} {command}{rest}"
            lines[-1:] = [whole] if len(whole) <= room else [lines[-1], command + rest]
        yield [*others, lines[0]]
        yield from ([*["" for _ in others], line] for line in lines[1:])
