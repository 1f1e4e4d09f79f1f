"""What a build would do: nothing is loaded and nothing written."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from pcdata.build.builder import building_at
from pcdata.build.config import BuildConfig
from pcdata.build.plan import plan_of
from pcdata.build.source_state import captures_digest, files_of
from pcdata.errors import CacheError
from pcdata.io.sources.capture_source import CaptureSource, checked_ids


@dataclass(frozen=True)
class Outlook:
    """What is to be done, and what is finished of it."""

    num_samples: int
    num_shards: int
    shard_size: int
    identity: str
    bytes_to_read: int | None  # of the files of all captures; None = they have none
    num_finished: int = 0  # shards
    bytes_finished: int = 0
    quarantined: dict[str, str] = field(default_factory=dict)
    hindrances: list[str] = field(default_factory=list)  # why it would not begin


def outlook(config: BuildConfig, source: CaptureSource, folder: str | Path, *, hash_captures: bool = False) -> Outlook:
    """Return what ``build_dataset`` would do with these arguments.

    Raises:
        CaptureError: the source has no captures, or two of one id.
    """
    checked_ids("build", source)
    plan, building = plan_of(config, source, hash_captures=hash_captures), building_at(folder)
    hindrances = []
    try:
        building.check_target(overwrite=True)
        try:
            building.check_target(overwrite=False)
        except CacheError:
            hindrances.append("a dataset is there; --overwrite replaces it")
    except CacheError as error:
        hindrances.append(str(error))
    try:
        different = building.differences(plan)
    except CacheError as error:
        different = [str(error)]
    if different:
        hindrances.append(
            f"an unfinished build, which differs in its {', '.join(different)}; --restart deletes it and begins anew"
        )
    records = building.finished(plan) if different == [] else {}
    done = [
        record
        for shard, record in records.items()
        if captures_digest(source, plan.ids_of(shard), hash_captures) == record.captures
    ]
    files = files_of(source, plan.ids)
    return Outlook(
        num_samples=len(plan.ids),
        num_shards=plan.num_shards,
        shard_size=plan.shard_size,
        identity=plan.identity,
        bytes_to_read=sum(path.stat().st_size for path in files if path.is_file()) if files else None,
        num_finished=len(done),
        bytes_finished=sum(sum(record.files.values()) for record in done),
        quarantined={name: why for record in done for name, why in record.quarantined.items()},
        hindrances=hindrances,
    )
