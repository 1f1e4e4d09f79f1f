"""What is asked of a build beside its configuration, captures and place: one list of options, checked in one place."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from pcdata.build.building_folder import BuildingFolder
from pcdata.build.building_url import BuildingUrl
from pcdata.build.config import BuildConfig
from pcdata.build.plan import Plan
from pcdata.build.tally import most_bad
from pcdata.errors import ConfigError, DTypeError
from pcdata.files.urls import is_in_process, is_url, path_of
from pcdata.io.sources.capture_source import CaptureSource, check_apart, checked_ids, episodes_of
from pcdata.structures import PointCloud

Engine = Literal["pool", "ray"]
ENGINES: tuple[Engine, ...] = ("pool", "ray")
_WHERE = "build_dataset"


@dataclass(frozen=True, kw_only=True)
class BuildRequest:
    """The options of :func:`pcdata.build_dataset`, which says what each does.

    Raises:
        ConfigError: they do not fit together.
    """

    overwrite: bool = False
    restart: bool = False
    workers: int = 0
    timeout: float | None = None
    max_bad: int | str | None = None
    engine: Engine = "pool"
    part: tuple[int, int] | None = None
    finalize: bool = False
    strict: bool = False
    hash_captures: bool = False
    retry_quarantined: bool = False

    def __post_init__(self) -> None:
        if self.engine not in ENGINES:
            raise ConfigError(f"{_WHERE}: engine must be one of {', '.join(ENGINES)}, got {self.engine!r:.60}")
        if isinstance(self.workers, bool) or not isinstance(self.workers, int) or self.workers < 0:
            raise ConfigError(f"{_WHERE}: workers must be a whole number from 0, got {self.workers!r:.60}")
        if self.timeout is not None:
            self._check_timeout(self.timeout)
        if self.part is not None:
            self._check_part(self.part)
        if self.retry_quarantined and (self.restart or self.finalize or self.part is not None):
            raise ConfigError(
                f"{_WHERE}: retry_quarantined goes on with a whole build: without restart, finalize, part"
            )

    @property
    def replaces(self) -> bool:
        """Whether a dataset that is there may be replaced."""
        return self.overwrite or self.retry_quarantined

    @property
    def what(self) -> str:
        """How this work is told from that of other processes on the same build."""
        return "finalize" if self.finalize else "all" if self.part is None else f"part-{self.part[0]}-of-{self.part[1]}"

    def shards(self, plan: Plan) -> range:
        """Return the shards that are to be done."""
        return range(plan.num_shards) if self.part is None else range(self.part[0], plan.num_shards, self.part[1])

    def building(self, config: BuildConfig, source: CaptureSource, folder: str | Path) -> BuildingFolder | BuildingUrl:
        """Return where the unfinished build is that is asked for; nothing is written.

        Raises:
            ConfigError: the options do not fit this source or this place, the pipeline has nothing to store, or the
                folder is among the captures.
        """
        _check_content(config, source)
        if self.max_bad is not None:
            most_bad(self.max_bad, len(source.ids))
        building = _building_at(folder)
        if isinstance(building, BuildingFolder):
            check_apart(_WHERE, building.target, source)
            return building
        if is_in_process(folder) and (self.workers or self.engine != "pool"):
            raise ConfigError(f"{_WHERE}: {folder} is in the memory of this process: build it with workers=0")
        if self.retry_quarantined:
            raise ConfigError(
                f"{_WHERE}: {folder}: retry_quarantined takes a folder of this machine; build it again: --overwrite"
            )
        return building

    def _check_timeout(self, given: float) -> None:
        if isinstance(given, bool) or not isinstance(given, (int, float)) or not 0 < given < float("inf"):
            raise ConfigError(f"{_WHERE}: timeout must be seconds above 0, got {given!r:.60}")
        if self.engine == "pool" and not self.workers and not self.finalize:
            raise ConfigError(f"{_WHERE}: timeout needs a process that can be ended: workers=1 or more")

    def _check_part(self, part: tuple[int, int]) -> None:
        whole = isinstance(part, tuple) and len(part) == 2 and all(type(number) is int for number in part)
        if not whole or not 0 <= part[0] < part[1]:
            raise ConfigError(f"{_WHERE}: part must be (k, n) with 0 <= k < n, got {part!r:.60}")
        if self.finalize:
            raise ConfigError(f"{_WHERE}: finalize takes no part: it puts the whole dataset into place")


def _building_at(folder: str | Path) -> BuildingFolder | BuildingUrl:
    """Return where the unfinished build of a dataset is: in a folder, or at any URL that fsspec opens.

    Raises:
        ConfigError: there is no such kind of URL.
        MissingExtraError: what opens it is not installed.
    """
    if folder == "":
        raise ConfigError(f"{_WHERE}: the folder is an empty text; name one")
    if isinstance(folder, str) and ":" in folder:
        if is_url(folder):
            return BuildingUrl(folder)
        folder = path_of(folder)
    # Resolved: "." has no name to write beside, and a link must lead to the new dataset afterwards.
    return BuildingFolder(Path(os.path.realpath(Path(folder).expanduser())))


def _check_content(config: BuildConfig, source: CaptureSource) -> None:
    if not isinstance(config, BuildConfig):
        raise DTypeError(
            f"{_WHERE}: config must be a BuildConfig, not {type(config).__name__}; pcdata.load_config(path) reads one"
        )
    checked_ids(_WHERE, source)
    if config.loader.windows is not None and not episodes_of(source):
        raise ConfigError(
            f"{_WHERE}: loader.windows: {source!r} has no episodes to cut windows from; say in episodes.json "
            "beside the captures which follow each other (pcdata.write_episodes), or leave windows out"
        )
    stored, on_the_fly = config.pipeline.split()
    if on_the_fly.takes is not PointCloud:
        raise ConfigError(
            f"{_WHERE}: {type(on_the_fly.steps[0]).__name__} in the section depth is random, so no cloud is the "
            "same in every epoch and none can be stored; leave it out here, or load captures on the fly with "
            "CloudDataset"
        )
    if stored.gives is not PointCloud:
        raise ConfigError(f"{_WHERE}: the pipeline gives images, not clouds to store; put Deproject last")
