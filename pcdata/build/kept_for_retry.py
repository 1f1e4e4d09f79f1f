"""What stays of a build that quarantined captures, so that these can be tried again without all the others.

``.NAME.kept`` beside ``NAME`` holds the plan of the build, its records, and the signals of each shard. The shards are
in the dataset: those that hold all their captures are taken from there.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterable
from contextlib import suppress
from typing import TYPE_CHECKING

from pcdata.build.building import RECORDS, SHARD, SHARDS, SIGNALS, record_name
from pcdata.build.plan import FILE_NAME as PLAN
from pcdata.build.plan import MOST_BYTES as MOST_PLAN
from pcdata.build.plan import Plan
from pcdata.build.records import MOST_BYTES as MOST_RECORD
from pcdata.build.records import ShardRecord
from pcdata.errors import CacheError, write_fault
from pcdata.files.opening import read_bytes
from pcdata.io.store.shards import shard_folder

if TYPE_CHECKING:
    from pcdata.build.building_folder import BuildingFolder


def keep_for_retry(building: BuildingFolder, records: Iterable[ShardRecord]) -> None:
    """Set aside what :func:`take_over` needs, where captures are quarantined; what was kept before is deleted.

    The plan goes last: without it, the rest counts for nothing.
    """
    kept = building.kept_for_retry
    shutil.rmtree(kept, ignore_errors=True)
    records = [*records]
    if not any(record.quarantined for record in records):
        return
    with suppress(OSError):  # of a full disk: then all is built anew
        kept.mkdir()
        os.rename(building.path / RECORDS, kept / RECORDS)
        for record in records:
            if (signals := building.work_place(record) / SIGNALS).is_dir():
                place = kept / SHARDS / record.folder_name
                place.mkdir(parents=True)
                os.rename(signals, place / SIGNALS)
        os.rename(building.path / PLAN, kept / PLAN)


def records_for_retry(building: BuildingFolder, plan: Plan) -> dict[int, ShardRecord]:
    """Return what a build that tries quarantined captures again begins with: the records by shard, of all captures.

    They are those of the unfinished build, where there is one, else those of the dataset; one that is damaged is left
    out.

    Raises:
        CacheError: there is no build to go on with, or it has other settings.
    """
    if building.num_kept():
        return building.finished(plan)
    path = building.kept_for_retry / PLAN
    if not path.exists():
        raise CacheError(
            f"{building.target}: no captures of it are quarantined, or what its build left "
            f"({building.kept_for_retry.name}) is not beside it; build all of it again: --overwrite"
        )
    different = plan.differences(str(path), read_bytes("build", path, max_bytes=MOST_PLAN, error=CacheError))
    if different:
        raise CacheError(
            f"{building.target}: was built with other settings: this differs in its {', '.join(different)}; only the "
            "same build can try its quarantined captures again, so repeat its settings, or build all of it again: "
            "--overwrite"
        )
    found: dict[int, ShardRecord] = {}
    for shard in range(plan.num_shards):
        with suppress(CacheError):
            path = building.kept_for_retry / record_name(shard)
            text = read_bytes("build", path, max_bytes=MOST_RECORD, error=CacheError)
            found[shard] = ShardRecord.of(str(path), text, plan, shard)
    return found


def take_over(building: BuildingFolder, plan: Plan) -> None:
    """Begin with the shards of the dataset that hold all their captures; an unfinished build goes on as it is.

    Raises:
        CacheError: as for :func:`records_for_retry`; or nothing can be written.
    """
    records = records_for_retry(building, plan)
    if not building.num_kept():
        for record in records.values():
            with suppress(CacheError):
                _take_over(building, record)


def _take_over(building: BuildingFolder, record: ShardRecord) -> None:
    place = shard_folder(building.target, record.shard)
    signals = building.kept_for_retry / SHARDS / record.folder_name / SIGNALS
    if record.quarantined or not record.is_whole(place) or ("digest" in record.signals) > signals.is_dir():
        return
    with building.shard_scratch(record.shard) as scratch:
        try:
            shutil.copytree(place, scratch / SHARD, copy_function=_linked)
            if signals.is_dir():
                shutil.copytree(signals, scratch / SIGNALS, copy_function=_linked)
        except OSError as error:
            raise CacheError(f"{building.target}: cannot be written: {write_fault(error)}") from error
        building.commit(scratch, record)


def _linked(source: str, target: str) -> None:
    """Give a file, which nobody writes again, a second name; copy it where the file system has none."""
    try:
        os.link(source, target)
    except OSError:
        shutil.copyfile(source, target)
