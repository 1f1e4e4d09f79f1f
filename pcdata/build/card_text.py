"""``README.md`` of a dataset: the head that Hugging Face reads, and what people read."""

from __future__ import annotations

import itertools
import re
import unicodedata
from collections.abc import Mapping, Sequence
from typing import Any

from pcdata.build.card_answers import UNKNOWN
from pcdata.build.card_facts import CardFacts
from pcdata.build.origins import OTHERS, joined
from pcdata.files.sample_names import counted
from pcdata.validation.step_losses import PERCENTILES
from pcdata.yaml_nodes import yaml_text

_SHOWN = 20  # samples that were left out
_SIZES = ((10**3, "n<1K"), (10**4, "1K<n<10K"), (10**5, "10K<n<100K"), (10**6, "100K<n<1M"), (10**7, "1M<n<10M"))
# Identifiers of licenses that Hugging Face knows, of those that data has; others are "other" with a name.
# Source: huggingface/hub-docs, docs/hub/repositories-licenses.md.
_LICENSES = frozenset(
    [
        *("apache-2.0", "mit", "bsd-2-clause", "bsd-3-clause", "gpl-2.0", "gpl-3.0", "lgpl-3.0", "agpl-3.0"),
        *("cc", "cc0-1.0", "cc-by-2.0", "cc-by-3.0", "cc-by-4.0", "cc-by-sa-3.0", "cc-by-sa-4.0", "cc-by-nd-4.0"),
        *("cc-by-nc-2.0", "cc-by-nc-3.0", "cc-by-nc-4.0", "cc-by-nc-nd-3.0", "cc-by-nc-nd-4.0"),
        *("cc-by-nc-sa-2.0", "cc-by-nc-sa-3.0", "cc-by-nc-sa-4.0", "odbl", "odc-by", "pddl", "unlicense", "unknown"),
        *("cdla-permissive-1.0", "cdla-permissive-2.0", "cdla-sharing-1.0"),
    ]
)


def card_text(facts: CardFacts) -> str:
    """Return the card."""
    parts = [
        f"---\n{yaml_text(_head(facts))}---",
        f"# {as_markdown(facts.title)}",
        as_markdown(facts.description),
        *_source(facts),
        *_pipeline(facts),
        *_points(facts),
        *_coordinates(facts),
        *_splits(facts),
        *_left_out(facts),
        *_files(facts),
        *_unknown(facts),
    ]
    return "\n\n".join(parts) + "\n"


def _head(facts: CardFacts) -> dict[str, Any]:
    count = len(facts.manifest.samples)
    head: dict[str, Any] = {}
    said = facts.answers.license
    known = (said or "unknown").lower()
    if known in _LICENSES:
        head["license"] = known
    else:
        head |= {"license": "other", "license_name": str(said)}
        if facts.answers.license_link:
            head["license_link"] = facts.answers.license_link
    size = next((word for most, word in _SIZES if count < most), "n>10M")
    return {
        **head,
        "pretty_name": facts.title,
        "task_categories": ["robotics"],
        "size_categories": [size],
        "tags": ["point-cloud", "depth", "robotics", "3d", "pcdata"],
    }


def _source(facts: CardFacts) -> list[str]:
    source = facts.manifest.source
    rows = [
        ("sensor", facts.sensor),
        ("conditions", facts.answers.conditions or UNKNOWN),
        ("license of the source", facts.answers.license or UNKNOWN),
        ("creator", facts.answers.creator or UNKNOWN),
        ("at home", facts.answers.url or UNKNOWN),
        ("published", facts.answers.date_published or UNKNOWN),
        ("read as", ", ".join(f"{name} {value}" for name, value in source.items()) or UNKNOWN),
        ("change of depth before it was read", facts.depth_error),
    ]
    return ["## Source", _table(("fact", "value"), rows)]


def _pipeline(facts: CardFacts) -> list[str]:
    manifest = facts.manifest
    rows = [
        ("fingerprint of the stored steps", manifest.fingerprint),
        *((f"version of {name}", version) for name, version in manifest.versions.items()),
        *((f"steps from {one['file']}", f"sha256 {one['sha256']}") for one in manifest.imports),
        *([("made for the model", manifest.model["name"])] if manifest.model else []),
    ]
    words = "The steps before the first random one were run once and are stored; the others run when a sample is read."
    parts = [
        "## Pipeline",
        _table(("fact", "value"), rows),
        words,
        _fenced(yaml_text(manifest.pipeline), "yaml"),
    ]
    if manifest.steps:
        header = ("step", "samples", "median before", *(f"{name} after" for name in PERCENTILES))
        names = ("step", "samples", "before", *PERCENTILES)
        counts = [["" if one.get(name) is None else one[name] for name in names] for one in manifest.steps]
        parts += ["### Points before and after each step", _table(header, counts)]
    if manifest.alarms:
        told = [f"- {as_markdown(one.get('name'))}: {as_markdown(one.get('found'))}" for one in manifest.alarms]
        parts += ["### Steps that drop more than is usual", "\n".join(told)]
    return parts


def _points(facts: CardFacts) -> list[str]:
    rows = [(len(facts.manifest.samples), *facts.points.values(), facts.num_empty)]
    fields = [(name, str(tuple(value.shape)), value.dtype) for name, value in facts.first.fields().items()]
    return [
        "## Samples",
        _table(("samples", *(f"points, {name}" for name in facts.points), "empty"), rows),
        "Fields of the first sample:",
        _table(("field", "shape", "type"), fields),
    ]


def _coordinates(facts: CardFacts) -> list[str]:
    cloud = facts.first
    rows = [
        ("axes of cameras", "x right, y down, z forward (OpenCV)"),
        ("depth that is no reading", "0, and left out"),
    ]
    header = ("samples", "points in", "unit", "captured in", "other frames, known from there", "fields")
    parts = [
        "## Frames and units",
        _table(("fact", "value"), rows),
        _table(header, [*map(_frames, _by_frames(facts))]),
    ]
    if signals := cloud.recorded_signals:
        told = [(name, one.kind, one.frame or "none") for name, one in signals.items()]
        parts += ["Signals:", _table(("signal", "kind", "frame"), told)]
    return parts


def _by_frames(facts: CardFacts) -> list[dict[str, Any]]:
    """Return the origins of the samples, whatever they say of sensor and depth."""
    return joined(
        {name: value for name, value in origin.items() if name not in ("sensor", "depth")}
        for origin in facts.manifest.origins
    )


def _frames(origin: Mapping[str, Any]) -> tuple[object, ...]:
    """Return the row of the samples of one origin: their frames are a tree whose root is that of the capture."""
    if OTHERS in origin:
        return (origin.get("samples"), f"{origin[OTHERS]} other kinds", "", "", "", "")
    fields = origin.get("fields")
    return (
        origin.get("samples"),
        origin.get("frame"),
        origin.get("unit"),
        origin.get("source_frame"),
        ", ".join(map(str, origin.get("frames") or ())) or "none",
        ", ".join(f"{name} {kind}" for name, kind in fields.items()) if isinstance(fields, Mapping) else "",
    )


def _splits(facts: CardFacts) -> list[str]:
    if facts.splits is None:
        return ["## Splits", "None yet: `pcdata split DATASET` draws them and tells them here."]
    splits = facts.splits
    rows = [(name, len(splits.groups[name]), len(splits.ids(name))) for name in splits.names]
    drawn = ", ".join(f"{name}: {value}" for name, value in splits.settings.items())
    return ["## Splits", _table(("split", "groups", "samples"), rows), f"Drawn by {as_markdown(drawn)}."]


def _left_out(facts: CardFacts) -> list[str]:
    parts = ["## Left out"]
    for word, left in (("dropped", facts.manifest.skipped), ("quarantined", facts.manifest.quarantined)):
        parts.append(f"{word.capitalize()}: {counted(len(left), 'capture')}.")
        if left:
            rows = [*itertools.islice(left.items(), _SHOWN)]
            parts.append(_table(("capture", "why"), rows))
            if len(left) > _SHOWN:
                parts.append(f"and {len(left) - _SHOWN:,} more, which `dataset.json` or arrays in `index/` list.")
    return parts


def _files(facts: CardFacts) -> list[str]:
    manifest = facts.manifest
    raw = "lie beside the clouds, below `raw/` of each shard"
    if not manifest.keep_raw:
        raw = "stay in the source, under the ids of the samples"
    words = (
        f"Clouds are stored as {as_markdown(manifest.format)}, compression {as_markdown(manifest.compression)}, in "
        f"{counted(manifest.index.num_shards, 'shard')}; depth images, color and calibration {raw}. `python load.py` "
        "loads them batch by batch, `pcdata verify` hashes every file again."
    )
    return ["## Files", words]


def _unknown(facts: CardFacts) -> list[str]:
    missing = facts.missing()
    if not missing:
        return []
    lines = [f"- {as_markdown(line.strip())}" for line in missing]
    return ["## Not known", "Say it with `pcdata card DATASET`:", "\n".join(lines)]


def _table(header: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    lines = [header, ["---"] * len(header)]
    lines += [[f"{cell:,}" if type(cell) is int else as_markdown(cell) for cell in row] for row in rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _fenced(text: str, language: str) -> str:
    longest = max((len(run) for run in re.findall("`+", text)), default=0)
    fence = "`" * max(3, longest + 1)
    return f"{fence}{language}\n{text}{fence}"


# -- text of any origin: it shows as it is, and can become no heading, link, image, tag or table ---------------------

# Every sign that Markdown or HTML could read, where it could: as an entity it is text in both.
_SIGNS = re.compile(
    r"[&<>`*\[\]|\\~$#!{}@]|(?<![0-9A-Za-z])_|_(?![0-9A-Za-z])|:(?=//)|(?<=www)\.|^[-+=]|^[0-9]+(?=[.)]\s)",
    re.IGNORECASE,
)
_LONGEST = 300


def as_markdown(text: object) -> str:
    """Return a text in one line of Markdown that shows it, signs that cannot be seen as ``U+200B``."""
    shown = str(text)
    if not shown.isprintable():
        shown = "".join(map(_visible, shown))
    shown = shown if len(shown) <= _LONGEST else f"{shown[:_LONGEST]}..."
    return _SIGNS.sub(lambda found: "".join(f"&#{ord(sign)};" for sign in found[0]), shown.strip()) or "(empty)"


def _visible(sign: str) -> str:
    if sign in "\t\n\r":
        return " "
    # Controls, marks that turn the direction of writing, lone surrogates: nobody sees what they do.
    return f"(U+{ord(sign):04X})" if unicodedata.category(sign) in ("Cc", "Cf", "Cs", "Zl", "Zp", "Co", "Cn") else sign
