"""Datasets, builds and captures in words."""

from __future__ import annotations

import shlex
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from statistics import median
from typing import Any

from pcdata.datasets import CachedCloudDataset, Splits
from pcdata.files.sample_names import counted
from pcdata.io.writers.writers import WRITERS
from pcdata.report.plain_table import text_table
from pcdata.report.split_text import splits_in_words
from pcdata.structures import PointCloud

_SKIPPED_SHOWN = 20  # captures that were left out, in a summary
_COUNTS = ("dropped", "doubled", "interpolated", "missing")  # of a stream


def skipped_text(
    skipped: Mapping[str, str], what: str = "capture", listed_in: str = "dataset.json", how: str = "left out"
) -> str:
    """Tell which captures, or others, were left out: how many for each kind of reason, and the first with their own."""
    kinds = Counter(reason.partition(":")[0] for reason in skipped.values())
    head = f"{counted(len(skipped), what)} {how}: " + ", ".join(f"{count} {kind}" for kind, count in kinds.items())
    lines = [f"  {sample_id}: {reason}" for sample_id, reason in list(skipped.items())[:_SKIPPED_SHOWN]]
    more = len(skipped) - len(lines)
    return "\n".join([head, *lines, *([f"  and {more} more; {listed_in} lists them all"] if more else [])])


def dataset_text(folder: str | Path) -> str:
    """Tell what a built dataset holds; reads its manifest and its first sample."""
    dataset = CachedCloudDataset(folder, augment=None)
    manifest = dataset.manifest
    counts = [sample.num_points for sample in manifest.samples]
    cloud = dataset[0]
    facts: list[list[object]] = [
        ["samples", len(dataset)],
        *([["left out", len(manifest.skipped)]] if manifest.skipped else []),
        *([["quarantined", len(manifest.quarantined)]] if manifest.quarantined else []),
        ["points", f"{min(counts):,} fewest, {round(median(counts)):,} median, {max(counts):,} most"],
        ["format", f"{manifest.format}, compression {manifest.compression}{', compact' * manifest.compact}"],
        ["frame, unit", f"{cloud.frame_id}, {cloud.unit}"],
        ["fields", ", ".join(f"{name} {tuple(value.shape)}" for name, value in cloud.fields().items())],
        ["fingerprint", manifest.fingerprint[:16]],
        ["made with", ", ".join(f"{name} {version}" for name, version in manifest.versions.items())],
    ]
    if dataset.splits.is_file():
        facts.insert(1, ["splits", splits_in_words(Splits.read(dataset.splits))])
    facts[-2:-2] = [[*row] for row in _signal_rows(cloud)]
    facts += [["built with", f"{one['file']}, sha256 {one['sha256'][:16]}"] for one in manifest.imports]
    stored, on_the_fly = dataset.pipeline.split()
    steps = [["stored", repr(step)] for step in stored.steps]
    steps += [["on the fly", repr(step)] for step in on_the_fly.steps]
    tables = f"{text_table(['dataset', str(folder)], facts)}\n\n{text_table(['when', 'step'], steps)}"
    return "\n\n".join([tables, *left_out_texts(manifest.skipped, manifest.quarantined)])


def left_out_texts(skipped: Mapping[str, str], quarantined: Mapping[str, str]) -> list[str]:
    """Tell which captures a dataset lacks: those that somebody left out, and those that failed."""
    parts = [skipped_text(skipped)] if skipped else []
    return parts + ([skipped_text(quarantined, how="failed twice, now quarantined")] if quarantined else [])


def facts_text(facts: Mapping[str, Any], words: Sequence[str] = ()) -> str:
    """Tell what :func:`~pcdata.report.capture_facts.capture_facts` found in a source.

    Args:
        facts: of the source.
        words: of the command line that opens it: path and options; then the commands to go on are told.
    """
    names = ", ".join(facts["ids"]) + (", ..." if facts["captures"] > len(facts["ids"]) else "")
    size = "" if facts["bytes"] is None else f", {size_in_words(facts['bytes'])}"
    rows = [
        ["layout", " of ".join(facts["layout"])],
        ["captures", f"{facts['captures']}: {names}{size}"],
        ["first", facts["first"]],
        *(_frame_rows(facts) if "cameras" in facts else _cloud_rows(facts)),
        *_rows_of("signals", map(_signal_row, *zip(*facts["signals"].items())) if facts["signals"] else ()),
        *_episode_rows(facts["episodes"]),
        *([["time", _times_in_words(facts["time"])]] if facts["time"] else []),
        *_rows_of("left out", _left_out(facts["left_out"])),
        *_rows_of("missing", facts["missing"]),
        *_rows_of("not read", facts["not_read"]),
        *_rows_of("next", next_commands(facts, words) if words else ()),
    ]
    tables = [text_table(["capture", facts["name"]], rows)]
    if facts["streams"]:
        tables.append(_stream_table(facts["streams"]))
    return "\n\n".join(tables)


def next_commands(facts: Mapping[str, Any], words: Sequence[str]) -> list[str]:
    """Return the commands to go on with captures that are opened by these words."""
    checked = shlex.join(word for word in words if word != "--skip-refused")
    if "cameras" not in facts:
        return [f"pcdata build --model MODEL --source {checked} --out DATASET   # pcdata models lists them"]
    known = [name for name in ("lerobot", "mcap", "folder") if name in WRITERS]
    others = ", ".join(f"--to {name}" for name in known[1:])
    model = "dp3_sim" if facts["signals"] and facts["episodes"] else "MODEL"
    return [
        f"pcdata validate {checked}",
        f"pcdata convert {shlex.join(words)} --to {known[0]} --out DIR   # or {others}",
        f"pcdata build --model {model} --source {checked} --out DATASET   # pcdata models lists them",
    ]


def _rows_of(name: str, lines: Iterable[str]) -> list[list[str]]:
    return [[name * (not number), line] for number, line in enumerate(lines)]


def _signal_row(name: str, facts: Mapping[str, Any]) -> str:
    if "text" in facts:
        return f"{name}: text, such as {facts['text']!r:.100}"
    frame = "" if facts["frame"] is None else f" in {facts['frame']!r}"
    return f"{name}: {facts['kind']}{frame}, {tuple(facts['shape'])} {facts['dtype']}"


def _episode_rows(episodes: Sequence[Mapping[str, Any]]) -> list[list[str]]:
    if not episodes:
        return []
    lengths = [one["captures"] for one in episodes]
    span = f"{lengths[0]}" if len(set(lengths)) == 1 else f"{min(lengths)} to {max(lengths)}"
    rows = [f"{len(episodes)} of {span} captures: {_named(one['id'] for one in episodes)}"]
    if timed := [one for one in episodes if "seconds" in one]:
        rates = [one["rate_hz"] for one in timed if "rate_hz" in one]
        worst = max(timed, key=lambda one: float(one["largest_gap_s"]))
        even = f"{median(rates):.4g} Hz" if rates else "all at one time"
        gaps = sum(one["gaps"] for one in timed)
        told = f", {gaps} gaps, the largest {worst['largest_gap_s']:.3g} s in {worst['id']}" if gaps else ", no gaps"
        rows.append(f"{sum(one['seconds'] for one in timed):.1f} s in all, {even}{told}")
    if attributes := {name: value for one in episodes for name, value in one["attributes"].items()}:
        rows.append("attributes: " + ", ".join(f"{name} ({value!r:.40})" for name, value in attributes.items()))
    return _rows_of("episodes", rows)


def _times_in_words(facts: Mapping[str, Any]) -> str:
    rate = f", {facts['rate_hz']:.4g} Hz" if "rate_hz" in facts else ""
    gaps = f"{facts['gaps']} gaps, the largest {facts['largest_gap_s']:.3g} s" if facts["gaps"] else "no gaps"
    return f"{facts['seconds']:.1f} s{rate}, {gaps}"


def _stream_table(streams: Sequence[Mapping[str, Any]]) -> str:
    """Tell each topic once: of several recordings the messages of all, and the largest gap."""
    header = ["stream", "as", "Hz", "messages", "joined by", *_COUNTS, "largest gap"]
    topics: dict[tuple[str, str], list[Mapping[str, Any]]] = {}
    for one in streams:
        topics.setdefault((str(one["topic"]), str(one["role"])), []).append(one)
    rows = [
        [
            topic,
            role,
            _rates([one["rate_hz"] for one in parts if one.get("rate_hz")]),
            sum(one.get("messages", 0) for one in parts),
            str(parts[0].get("rule", "")),
            *(sum(one.get(word) or 0 for one in parts) for word in _COUNTS),
            f"{max(one.get('largest_gap_s') or 0.0 for one in parts):.3g} s",
        ]
        for (topic, role), parts in topics.items()
    ]
    return text_table(header, rows)


def _rates(rates: Sequence[float]) -> str:
    low, high = (f"{rate:.4g}" for rate in (min(rates, default=0.0), max(rates, default=0.0)))
    return "" if not rates else low if low == high else f"{low} to {high}"


def _left_out(skipped: Mapping[str, str]) -> list[str]:
    lines = [f"{sample_id}: {reason}" for sample_id, reason in list(skipped.items())[:3]]
    more = len(skipped) - len(lines)
    return [counted(len(skipped), "capture"), *lines, *([f"and {more} more"] if more else [])] if skipped else []


def _named(names: Iterable[str]) -> str:
    listed = list(names)
    return ", ".join(listed[:3]) + (", ..." if len(listed) > 3 else "")


def _frame_rows(facts: Mapping[str, Any]) -> list[list[str]]:
    depth, changes = facts["depth"], facts["changes"]
    span = f", {depth['nearest_m']:.3f} to {depth['farthest_m']:.3f} m" if "nearest_m" in depth else ""
    moved = max(changes.get("cameras_moved_m", [0.0]))
    moving = f", {moved:.3g} m from the first to the last capture" if moved else ""
    still = ", the same in the first and the last" if "cameras_moved_m" in changes and not moved else ""
    still = "" if changes.get("cameras_turned") else still
    return [
        *_rows_of("cameras", [_camera_in_words(camera) for camera in facts["cameras"]]),
        *([["", "intrinsics change from capture to capture"]] if changes.get("intrinsics") else []),
        ["depth", f"{depth['valid']:,} of {depth['pixels']:,} pixels valid{span}"],
        ["unit", _unit(facts)],
        ["images", ", ".join(facts["images"]) or "none beside the depth"],
        ["poses", "none" if facts["poses"] is None else f"lead to {facts['poses']!r}{moving}{still}"],
        *(
            [["sensor", ", ".join(f"{name} {value}" for name, value in facts["sensor"].items())]]
            * bool(facts["sensor"])
        ),
        *([["last", changes["last"]]] if "last" in changes else []),
    ]


def _camera_in_words(camera: Mapping[str, Any]) -> str:
    lens = "" if camera["lens"] is None else f", lens of {camera['lens']} coefficients"
    focal = ", ".join(f"{word} {camera[word]:.1f}" for word in ("fx", "fy", "cx", "cy"))
    return f"{camera['name']}: {camera['width']}x{camera['height']}, {focal}{lens}"


def _unit(facts: Mapping[str, Any]) -> str:
    """Say how a stored number became metres, as the reader says it."""
    stored, order = facts["metres_per_unit"], facts["depth_encoding"]
    unit = "metres" if stored in (None, 1.0) else f"1 stored = {stored:.10g} m"
    unit += f" ({facts['unit_source']})" if facts["unit_source"] else ""
    return unit if order == "plain" else f"{unit}, {order}"


def _cloud_rows(facts: Mapping[str, Any]) -> list[list[str]]:
    if facts["extent_m"] is None:
        return [["extent", "none, the cloud is empty"], ["fields", ", ".join(facts["fields"])]]
    extent = ", ".join(f"{axis} {a:.3f} to {b:.3f}" for axis, a, b in zip("xyz", *facts["extent_m"]))
    return [["extent", f"{extent} m"], ["fields", ", ".join(facts["fields"])]]


def _signal_rows(cloud: PointCloud) -> list[list[str]]:
    """Tell each signal's name, kind, frame and shape."""
    return _rows_of("signals", [f"{name}: {signal!r}" for name, signal in cloud.recorded_signals.items()])


def size_in_words(size: float) -> str:
    """Return a number of bytes as a person says it."""
    for unit in ("bytes", "kB", "MB", "GB"):
        if size < 1000 or unit == "GB":
            break
        size /= 1000
    return f"{size:.0f} {unit}" if unit == "bytes" else f"{size:.1f} {unit}"
