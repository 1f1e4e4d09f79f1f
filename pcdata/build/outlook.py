"""What a build would do: nothing is loaded and nothing written."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pcdata.build.building import Building
from pcdata.build.building_folder import BuildingFolder
from pcdata.build.config import BuildConfig
from pcdata.build.kept_for_retry import records_for_retry
from pcdata.build.plan import plan_of
from pcdata.build.request import BuildRequest
from pcdata.build.source_state import captures_digest, files_of
from pcdata.errors import CacheError
from pcdata.io.sources.capture_source import CaptureSource


@dataclass(frozen=True)
class Outlook:
    """What is to be done, and what is finished of it."""

    num_samples: int
    num_shards: int
    shard_size: int
    identity: str
    bytes_to_read: int | None  # of the files of all captures; None = they have none
    num_finished: int = 0  # shards
    num_to_do: int = 0  # shards, of this job where it is one of several
    bytes_finished: int = 0
    quarantined: dict[str, str] = field(default_factory=dict)  # so far; all of them are tried again where that is asked
    replaces: bool = False  # a dataset is there, which the new one takes the place of
    hindrances: list[str] = field(default_factory=list)  # why it would not begin


def outlook(config: BuildConfig, source: CaptureSource, folder: str | Path, **options: Any) -> Outlook:
    """Return what :func:`build_dataset` would do with the same arguments; ``options`` are those of ``BuildRequest``.

    Raises:
        CaptureError: the source has no captures, or two of one id.
        ConfigError: the arguments do not fit together.
    """
    asked = BuildRequest(**options)
    building = asked.building(config, source, folder)
    plan = plan_of(config, source, hash_captures=asked.hash_captures)
    replaces, hindrances = _target(building, asked.replaces)
    try:
        different = building.differences(plan)
    except CacheError as error:
        different = [str(error)]
    if different and not asked.restart:
        hindrances.append(
            f"an unfinished build, which differs in its {', '.join(different)}; --restart deletes it and begins anew"
        )
    records = building.finished(plan) if different == [] and not asked.restart else {}
    if asked.retry_quarantined and isinstance(building, BuildingFolder) and not different:
        try:
            records = records_for_retry(building, plan)
        except CacheError as error:
            hindrances.append(str(error))
    known = [
        record
        for shard, record in records.items()
        if captures_digest(source, plan.ids_of(shard), asked.hash_captures) == record.captures
        and not record.is_doubtful
    ]
    done = [record for record in known if not (asked.retry_quarantined and record.quarantined)]
    told = records.values() if asked.retry_quarantined else known  # mended captures are others than those quarantined
    shards = asked.shards(plan)
    if asked.finalize and len(done) < plan.num_shards:
        hindrances.append(
            f"{plan.num_shards - len(done)} of {plan.num_shards} shards are not finished; build them first"
        )
    files = files_of(source, plan.ids)
    return Outlook(
        num_samples=len(plan.ids),
        num_shards=plan.num_shards,
        shard_size=plan.shard_size,
        identity=plan.identity,
        bytes_to_read=sum(path.stat().st_size for path in files if path.is_file()) if files else None,
        num_finished=len(done),
        num_to_do=len({*shards} - {record.shard for record in done}),
        bytes_finished=sum(sum(record.files.values()) for record in done),
        quarantined={name: why for record in told for name, why in record.quarantined.items()},
        replaces=replaces,
        hindrances=hindrances,
    )


def _target(building: Building, overwrite: bool) -> tuple[bool, list[str]]:
    """Return whether a dataset is there that would be replaced, and what is in the way of that."""
    try:
        building.check_target(overwrite=True)
    except CacheError as error:
        return False, [str(error)]
    try:
        building.check_target(overwrite=False)
    except CacheError:
        return overwrite, [] if overwrite else ["a dataset is there; --overwrite replaces it"]
    return False, []
