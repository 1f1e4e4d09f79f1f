"""Builds in words: what one did, and what one would do."""

from __future__ import annotations

from pathlib import Path
from statistics import median
from typing import Any

from pcdata.build import BuildConfig, BuildReport, outlook
from pcdata.files.sample_names import counted, name_some
from pcdata.io.sources.capture_source import CaptureSource
from pcdata.models.value_rules import OBJECT_STEPS
from pcdata.report.inspection_text import left_out_texts, size_in_words
from pcdata.report.plain_table import text_table


def build_text(report: BuildReport) -> str:
    """Tell how many points every step left, over all captures of a build."""
    rows: list[list[object]] = []
    chains: dict[tuple[str, ...], list[list[int]]] = {}
    for sample in report.samples:
        names = tuple(name for name, _ in sample.counts)
        chains.setdefault(names, []).append([count for _, count in sample.counts])
    for names, counts in chains.items():
        for position, name in enumerate(names):
            left = [sample[position] for sample in counts]
            rows.append([name, min(left), round(median(left)), max(left)])
    seconds = sum(sample.seconds for sample in report.samples)
    as_clouds = sum(sample.entered_at == "cloud" for sample in report.samples)
    head = f"{counted(len(report.samples), 'sample')} in {seconds:.1f} s"
    if as_clouds:
        head += f"; clouds already, which entered at the first step that takes one: {counted(as_clouds, 'capture')}"
    if report.num_finished < report.num_shards:
        head += f"; {report.num_finished} of {report.num_shards} shards are finished, the rest is others' work"
    tables = [head, text_table(["points after", "fewest", "median", "most"], rows)] if rows else [head]
    return "\n\n".join([*tables, *left_out_texts(report.skipped, report.quarantined)])


def notes_of(config: BuildConfig, report: BuildReport) -> list[str]:
    """Say what was stored as asked and yet is not what training takes."""
    told = (_whole_scenes(config, report), _views_apart(config, report), _too_few_points(config, report))
    return [note for note in told if note is not None]


def _whole_scenes(config: BuildConfig, report: BuildReport) -> str | None:
    """Say that the model takes single objects, where no step cut any out of depth images."""
    if config.model is None or not any(sample.entered_at == "depth" for sample in report.samples):
        return None
    contract = config.model.contract
    if contract.table != "removed" or OBJECT_STEPS & {type(step).__name__ for step in config.pipeline.parts()}:
        return None
    return (
        f"{contract.name} takes clouds of one object, and these hold all that the captures show: cut objects out first "
        "(docs/segmentation.md), unless the captures show one alone"
    )


def _views_apart(config: BuildConfig, report: BuildReport) -> str | None:
    """Say that a sample of a model holds the views of its capture one by one, where nothing joined them."""
    steps = {type(step).__name__ for step in config.pipeline.parts()}
    if config.model is None or steps & {"MergeViews", "FuseTSDF", *OBJECT_STEPS}:
        return None
    apart = [one for one in report.samples if one.entered_at == "depth" and one.fewest_points < one.num_points]
    if not apart:
        return None
    return (
        f"{counted(len(apart), 'sample')} made of several views: a cloud of each by itself, in the frame of its own "
        "camera; name the frame that all poses lead to (--set frame=NAME) for one cloud of all views, or read one "
        "camera (--camera NAME, or its folder)"
    )


def _too_few_points(config: BuildConfig, report: BuildReport) -> str | None:
    """Say which samples a random step will refuse whenever they are read."""
    for step in config.pipeline.split()[1].steps:
        name, wanted = type(step).__name__, getattr(step, "num_points", None)
        if wanted is not None and getattr(step, "if_short", "error") != "error":
            break  # those behind it get as many as it fills up to
        if isinstance(wanted, int) and getattr(step, "if_short", None) == "error" and not hasattr(step, "spread"):
            short = [
                f"{sample.id!r} ({'' if sample.fewest_points == sample.num_points else 'a cloud of '}"
                f"{sample.fewest_points:,})"
                for sample in report.samples
                if sample.fewest_points < wanted
            ]
            if short:
                way = "leave them out with --skip ID" + ("" if config.model else f", or choose if_short of {name}")
                return (
                    f"{counted(len(short), 'sample')} will be refused when read, having fewer than the {wanted:,} "
                    f"points that {name} takes: {name_some(short)}; {way}"
                )
    return None


def plan_text(config: BuildConfig, source: CaptureSource, folder: str | Path, **asked: Any) -> str:
    """Tell what a build would do, how large the result may become, and what of it is finished.

    ``asked`` is what :func:`pcdata.build.outlook` takes besides.
    """
    plan = outlook(config, source, folder, **asked)
    tries_again = bool(asked.get("retry_quarantined"))
    rows = [
        ["captures", f"{plan.num_samples:,} in {counted(plan.num_shards, 'shard')} of {plan.shard_size:,}"],
        ["read", "unknown" if plan.bytes_to_read is None else size_in_words(plan.bytes_to_read)],
        ["format", f"{config.output.format}, compression {config.output.compression}"],
        ["steps", ", ".join(type(step).__name__ for step in config.pipeline.split()[0].steps) or "none"],
        ["identity", plan.identity[:16]],
        [
            "kept" if tries_again else "finished",
            f"{counted(plan.num_finished, 'shard')}, {size_in_words(plan.bytes_finished)}",
        ],
        ["to do", counted(plan.num_to_do, "shard") + ("" if asked.get("part") is None else " of this job")],
    ]
    if plan.num_finished:
        rows.append(["about", f"{size_in_words(plan.bytes_finished / plan.num_finished * plan.num_shards)} in the end"])
    if plan.quarantined:
        captures = counted(len(plan.quarantined), "capture")
        rows.append(["tried again", captures] if tries_again else ["quarantined", f"{captures} so far"])
    if plan.replaces:
        rows.append(["replaces", "the dataset that is there, once this is built"])
    rows += [["in the way", text] for text in plan.hindrances]
    return text_table(["build", str(folder)], rows)
