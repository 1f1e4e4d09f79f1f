"""The page on a dataset that was built: what its steps left, what is in it, and what the build was warned of."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path
from typing import Any

import yaml

from pcdata.datasets.stored_clouds import StoredClouds
from pcdata.io.store.manifest import Manifest
from pcdata.report.html.capture_report import page_of_captures
from pcdata.report.html.gathering import NUM_SHOWN, Gathered, Known, Progress, gather_captures
from pcdata.validation.grading import Grading
from pcdata.verdicts import Finding, Verdict


def dataset_page(
    folder: str | Path, *, num_shown: int = NUM_SHOWN, title: str = "", progress: Progress | None = None
) -> tuple[str, Grading]:
    """Judge every stored cloud of a dataset and return a self-contained page, and the grades it tells of.

    Args:
        folder: what ``pcdata build`` wrote.
        num_shown: samples with their clouds.
        title: of the page; "" = its name.
        progress: told (samples judged, all, which).

    Raises:
        CacheError: the dataset is damaged.
    """
    gathered = gather_dataset(folder, num_shown=num_shown, title=title, progress=progress)
    return page_of_captures(gathered), gathered.grading


def gather_dataset(
    folder: str | Path, *, num_shown: int = NUM_SHOWN, title: str = "", progress: Progress | None = None
) -> Gathered:
    """Judge every stored cloud of a dataset, and look at some; arguments and errors as :func:`dataset_page`."""
    stored = StoredClouds(folder)
    return gather_captures(
        stored,
        num_shown=num_shown,
        title=title,
        progress=progress,
        known=_known(stored.manifest),
    )


def _known(manifest: Manifest) -> Known:
    steps = [(str(one["step"]), float(one["median"])) for one in manifest.steps]
    left_out = {**manifest.quarantined, **manifest.skipped}
    findings = [_finding_of(alarm) for alarm in manifest.alarms]
    if manifest.quarantined:
        total = len(manifest.index.ids) + len(manifest.quarantined)
        findings.insert(
            0,
            Finding(
                name="quarantined",
                verdict=Verdict.WARN,
                found=f"{len(manifest.quarantined):,} of {total:,} captures could not be built",
                value=len(manifest.quarantined) / total,
                threshold=0.0,
                advice="see why below; mend them and build again with --retry-quarantined",
            ),
        )
    return Known(
        findings=tuple(findings),
        funnel=tuple(steps),
        left_out=left_out,
        pipeline=yaml.safe_dump(_plain(manifest.pipeline), sort_keys=False, width=120),
    )


def _finding_of(alarm: Any) -> Finding:
    known = {field.name for field in fields(Finding)}
    given = {name: value for name, value in alarm.items() if name in known}
    return Finding(**{**given, "verdict": Verdict(given.get("verdict", "warn"))})


def _plain(value: Any) -> Any:
    if hasattr(value, "items"):
        return {str(key): _plain(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(entry) for entry in value]
    return value
