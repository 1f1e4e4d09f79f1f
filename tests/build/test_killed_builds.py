"""A build that is killed or interrupted at any of its steps leaves the old dataset or the new one, and no litter.

benchmarks/interrupted_builds.py does the same to every command, at random moments.
"""

from __future__ import annotations

import json

import pytest

from tests.warm import run_python

# Kills or interrupts a build before every so-manieth file that it opens, makes, renames, lists or removes: Python tells
# of each. One process forks for all of them, since to load torch takes longer than everything else.
CHILD = """
import json, os, signal, sys, time
from contextlib import suppress
from pathlib import Path
import torch
torch.set_num_threads(1)
from pcdata.build import build_dataset, config_from_yaml
from pcdata.cli import main, signals
from tests.build.test_builder import Clouds, cloud, tree

CHANGES = {"open", "os.mkdir", "os.rename", "os.remove", "os.rmdir", "os.listdir", "os.scandir", "shutil.rmtree"}
place = Path(sys.argv[1])

def build(samples, **how):
    config = config_from_yaml("cloud: [Center]\\noutput: {format: %s}" % form)
    return build_dataset(config, Clouds({name: cloud(n) for n, name in enumerate(samples, 20)}), place / "out",
                         overwrite=True, **how)

def strike(number, step):
    here, seen = os.getpid(), 0
    wait, begin = os.pipe()
    if not os.fork():  # sends bursts from outside
        os.close(begin)
        with suppress(ProcessLookupError):
            for _ in range(5 if os.read(wait, 1) else 0):
                os.kill(here, number)
                time.sleep(0.02)
        os._exit(0)
    def hook(event, arguments):
        nonlocal seen
        if event in CHANGES and os.getpid() == here and str(place) in str(arguments):
            seen += 1
            if seen == step:
                if number == signal.SIGKILL:
                    os.kill(here, number)
                else:
                    os.write(begin, b"!")
    sys.addaudithook(hook)

known = None
for number, form, step in json.loads(sys.argv[2]):
    if form != known:
        known = form
        build("new"), (new := tree(place / "out"))
        build("old"), (old := tree(place / "out"))
    pid = os.fork()
    if not pid:
        with signals.signals_interrupt(until_exit=False) as heard:
            try:
                strike(number, step)
                build("new")
            except KeyboardInterrupt:
                os._exit(heard.code)
        os._exit(0)
    code = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
    left = tree(place / "out")
    names = sorted(os.listdir(place))
    notes = build("old", restart=True).notes  # what had been finished of the other is in the way
    after = sorted(os.listdir(place)), tree(place / "out") == old
    which = "old" if left == old else "new" if left == new else "neither"
    print(json.dumps([[number, form, step], code, which, names, after, notes]))
"""


def struck(tmp_path, strikes: list[tuple[int, str, int]]) -> list[list]:
    """What each signal, sent in a build of this format before this step, left; and what the next build made of it."""
    done = run_python(CHILD, str(tmp_path), json.dumps(strikes))
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr
    rows = [json.loads(line) for line in done.stdout.splitlines()]
    assert [row[0] for row in rows] == [[*strike] for strike in strikes]
    return rows


@pytest.mark.slow
def test_a_build_killed_before_any_step_leaves_the_old_or_the_new(tmp_path):
    steps = {"npz": [*range(1, 130, 5), 300], "hdf5": [*range(2, 130, 13), 300], "pt": [*range(3, 130, 13), 300]}
    rows = struck(tmp_path, [(9, form, step) for form, some in steps.items() for step in some])
    assert all(row[4] == [["out"], True] for row in rows)
    told = [bool(row[5]) for row in rows if row[3] != ["out"]]  # unless it was an empty folder
    assert sum(told) > len(told) / 2
    for form in steps:
        assert {row[2] for row in rows if row[0][1] == form} == {"old", "new"}
        assert {row[1] for row in rows if row[0][1] == form} == {-9, 0}  # the last steps come after all of them


@pytest.mark.slow
def test_a_burst_of_signals_before_any_step_leaves_nothing_hidden_but_finished_shards(tmp_path):
    first = {2: 1, 15: 4, 1: 7}
    rows = struck(
        tmp_path, [(number, "npz", step) for number in first for step in [*range(first[number], 130, 17), 300]]
    )
    # A build that has finished a shard keeps it, to go on.
    assert all({*row[3]} <= {"out", ".out.building"} and row[4] == [["out"], True] for row in rows)
    for number in first:
        assert {row[2] for row in rows if row[0][0] == number} == {"old", "new"}
        assert {row[1] for row in rows if row[0][0] == number} == {128 + number, 0}
