"""What a finished shard says of itself: the record whose file is the commit."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from pcdata.build.plan import Plan
from pcdata.build.source_state import digest_of
from pcdata.errors import CacheError
from pcdata.files.strict_json import json_object
from pcdata.io.store.shards import TABLE, hash_of

SCHEMA = "pcdata.shard/1"
MOST_BYTES = 1 << 30
_NOT_BYTES = ("seconds",)  # of a record: differs from run to run


@dataclass(frozen=True)
class BuiltSample:
    """What happened to one capture."""

    id: str
    entered_at: str  # "depth", or "cloud" where the capture was one already
    counts: list[tuple[str, int]]  # step name -> points after it, over all clouds of the sample
    seconds: float
    num_points: int = 0  # over all clouds
    fewest_points: int = 0  # of one cloud: steps take each by itself
    digest: str = ""  # of its record


@dataclass(frozen=True)
class ShardRecord:
    """One shard: what was stored, what was quarantined and why, and the files that hold it."""

    identity: str  # of the plan
    shard: int
    captures: str  # digest of the state of the files that were read
    table: str  # SHA-256 of the list of the files of the shard
    samples: list[BuiltSample]
    quarantined: Mapping[str, str] = field(default_factory=dict)  # id -> error
    signals: Mapping[str, str] = field(default_factory=dict)  # as a manifest has them, of this shard
    files: Mapping[str, int] = field(default_factory=dict)  # bytes of each
    origins: list[dict[str, Any]] = field(default_factory=list)  # where the samples come from, with counts
    look: str = ""  # what its captures tell of a wrong unit or of wrong poses, in words; the first shard is looked at

    @property
    def folder_name(self) -> str:
        """The name of the folder that this record is of: two that hold different clouds never share one."""
        content = asdict(self)
        for sample in content["samples"]:
            for name in _NOT_BYTES:
                del sample[name]
        return f"{self.shard:05d}-{digest_of(content)[:16]}"

    def to_json(self) -> dict[str, Any]:
        """Return what the file holds that commits the shard."""
        return {"schema": SCHEMA, "folder": self.folder_name, **asdict(self)}

    @classmethod
    def of(cls, where: str, text: bytes, plan: Plan, shard: int) -> ShardRecord:
        """Return the record of a shard of a plan, as :meth:`to_json` wrote it.

        Raises:
            CacheError: damaged, or of another plan; the message begins with ``where`` it is.
        """
        content = json_object(where, text, error=CacheError)
        schema, folder = content.pop("schema", None), content.pop("folder", None)
        try:
            record = cls(**content)
            samples = [_sample(one) for one in content["samples"]]
            record = cls(**{**content, "samples": samples})
            ids = [one for one in plan.ids_of(shard) if one not in record.quarantined]
            is_it = (
                (schema, record.identity, record.shard) == (SCHEMA, plan.identity, shard)
                and [sample.id for sample in samples] == ids
                and folder == record.folder_name
                and isinstance(record.look, str)
            )
        except (TypeError, ValueError, KeyError, AttributeError) as error:
            raise CacheError(f"{where}: is no record of a shard: {error}") from error
        if not is_it:
            raise CacheError(f"{where}: is damaged, or the record of another build")
        return record

    @property
    def is_doubtful(self) -> bool:
        """Whether a capture was quarantined for what may be the machine's fault: memory, time, a killed process."""
        return any(why.startswith(("MemoryError", "TimeoutError", "ProcessEnded")) for why in self.quarantined.values())

    def is_whole(self, folder: Path) -> bool:
        """Say whether the files of the record lie in a folder: their list by its content, they by their sizes."""
        try:
            return hash_of(folder / TABLE)[1] == self.table and all(
                (folder / name).stat().st_size == size for name, size in self.files.items()
            )
        except (OSError, CacheError):
            return False

    def to_text(self) -> str:
        """Return the record as one text, for the way from a worker."""
        return json.dumps(asdict(self))

    @classmethod
    def from_text(cls, text: str) -> ShardRecord:
        """Return the record of a text of :meth:`to_text`."""
        content = json.loads(text)
        return cls(**{**content, "samples": [_sample(one) for one in content["samples"]]})


def _sample(content: Mapping[str, Any]) -> BuiltSample:
    counts = [(str(name), int(count)) for name, count in content["counts"]]
    return BuiltSample(**{**content, "counts": counts})
