"""Shards done one after another in this process: nothing is started, and nothing protects from what ends a process."""

from __future__ import annotations

from collections.abc import Iterable

from pcdata.build.shard_work import Job
from pcdata.build.tally import Tally


class _Watch:
    """Tells a tally of the captures of one shard."""

    def __init__(self, tally: Tally, shard: int) -> None:
        self.tally, self.shard = tally, shard

    def begins(self, sample_id: str) -> None:
        """Nothing to tell."""

    def ends(self, sample_id: str, error: str | None) -> None:
        self.tally.captured(self.shard, sample_id, error)


def work_here(job: Job, shards: Iterable[int], tally: Tally) -> None:
    """Do the shards.

    Raises:
        PcdataError: the build must stop; what is committed stays.
    """
    for shard in shards:
        if job.folder.record(job.plan, shard) is not None:  # by another process, meanwhile
            continue
        tally.committed(job.do(shard, {}, _Watch(tally, shard)))
