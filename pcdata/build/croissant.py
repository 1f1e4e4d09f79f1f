"""``croissant.json``: the dataset for machines, as Croissant 1.1 describes one (JSON-LD).

Source: MLCommons, Croissant Format Specification 1.1, https://docs.mlcommons.org/croissant/docs/croissant-spec-1.1.html
"""

from __future__ import annotations

import json
import re
from typing import Any
from urllib.parse import quote

from pcdata.build.card_answers import UNKNOWN
from pcdata.build.card_facts import CardFacts
from pcdata.datasets.splits import FILE_NAME as SPLITS
from pcdata.io.store.left_out import FILES as LEFT_OUT_FILES
from pcdata.io.store.manifest import FILE_NAME
from pcdata.io.store.sample_index import FILES as INDEX_FILES
from pcdata.io.store.sample_index import FOLDER as INDEX
from pcdata.io.store.shards import TABLE, hash_of, read_table, shard_folder

_CONFORMS = "http://mlcommons.org/croissant/1.1"
_MOST_FILES = 1000  # that are listed one by one; of more, the tables of the shards list them with their SHA-256
_TYPES = {"json": "application/json", "npy": "application/octet-stream", "tsv": "text/tab-separated-values"}
_TYPES |= {
    "h5": "application/x-hdf5",
    "tar": "application/x-tar",
    "yaml": "application/yaml",
    "py": "text/x-python",
    "png": "image/png",
}
_OTHER = "application/octet-stream"
_CONTEXT: dict[str, Any] = {
    "@language": "en",
    "@vocab": "https://schema.org/",
    "citeAs": "cr:citeAs",
    "column": "cr:column",
    "conformsTo": "dct:conformsTo",
    "cr": "http://mlcommons.org/croissant/",
    "rai": "http://mlcommons.org/croissant/RAI/",
    "data": {"@id": "cr:data", "@type": "@json"},
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
    "dct": "http://purl.org/dc/terms/",
    "equivalentProperty": "cr:equivalentProperty",
    "examples": {"@id": "cr:examples", "@type": "@json"},
    "extract": "cr:extract",
    "field": "cr:field",
    "fileProperty": "cr:fileProperty",
    "fileObject": "cr:fileObject",
    "fileSet": "cr:fileSet",
    "format": "cr:format",
    "includes": "cr:includes",
    "isLiveDataset": "cr:isLiveDataset",
    "jsonPath": "cr:jsonPath",
    "key": "cr:key",
    "md5": "cr:md5",
    "parentField": "cr:parentField",
    "path": "cr:path",
    "recordSet": "cr:recordSet",
    "references": "cr:references",
    "regex": "cr:regex",
    "repeated": "cr:repeated",
    "replace": "cr:replace",
    "samplingRate": "cr:samplingRate",
    "sc": "https://schema.org/",
    "separator": "cr:separator",
    "source": "cr:source",
    "subField": "cr:subField",
    "transform": "cr:transform",
}


def croissant_text(facts: CardFacts) -> str:
    """Return the file."""
    answers = facts.answers
    content: dict[str, Any] = {
        "@context": _CONTEXT,
        "@type": "sc:Dataset",
        "conformsTo": _CONFORMS,
        "name": _name(facts.title),
        "description": facts.description,
        "license": answers.license_link or answers.license or UNKNOWN,
        "url": answers.url or UNKNOWN,
        "creator": {"@type": "sc:Organization", "name": answers.creator or UNKNOWN},
        # A date or nothing: another text makes the file invalid.
        **({"datePublished": answers.date_published} if answers.date_published else {}),
        "version": "1.0.0",
        "keywords": ["point cloud", "depth", "robotics"],
        "distribution": _files(facts),
    }
    if facts.splits is not None:
        content["recordSet"] = [_splits(facts)]
    return json.dumps(content, indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def _name(title: str) -> str:
    """Return a name of letters, digits, dots, dashes and underscores, as the specification asks for."""
    return re.sub(r"[^A-Za-z0-9._-]+", "-", title).strip("-.") or "dataset"


def _files(facts: CardFacts) -> list[dict[str, Any]]:
    folder, manifest = facts.folder, facts.manifest
    names = [
        FILE_NAME,
        "pipeline.yaml",
        "load.py",
        SPLITS,
        *(f"{INDEX}/{name}" for name in (*INDEX_FILES, *LEFT_OUT_FILES)),
    ]
    tables = [shard_folder(folder, number) for number in range(manifest.index.num_shards)]
    names += [(table / TABLE).relative_to(folder).as_posix() for table in tables]
    listed = [_file(name, *hash_of(folder / name)) for name in names if (folder / name).is_file()]
    stored: list[dict[str, Any]] = []
    for number, table in enumerate(tables):
        below = table.relative_to(folder).as_posix()
        for name, told in read_table(folder, number, manifest.index.tables[number].tobytes()).items():
            if len(stored) == _MOST_FILES:
                return listed
            stored.append(_file(f"{below}/{name}", told.size, told.sha256))
    return listed + stored


def _file(name: str, size: int, sha256: str) -> dict[str, Any]:
    return {
        "@type": "cr:FileObject",
        "@id": quote(name, safe="/"),
        "name": name,
        "contentUrl": quote(name, safe="/"),
        "contentSize": f"{size} B",
        "encodingFormat": _TYPES.get(name.rpartition(".")[2], _OTHER),
        "sha256": sha256,
    }


def _splits(facts: CardFacts) -> dict[str, Any]:
    assert facts.splits is not None
    fields = [("name", "sc:Text", "what the split is called"), ("num_samples", "sc:Integer", "how many samples it has")]
    return {
        "@type": "cr:RecordSet",
        "@id": "splits",
        "name": "splits",
        "description": f"The splits of the samples; {SPLITS} lists them.",
        "dataType": "cr:Split",
        "key": {"@id": "splits/name"},
        "field": [
            {
                "@type": "cr:Field",
                "@id": f"splits/{name}",
                "name": f"splits/{name}",
                "description": told,
                "dataType": kind,
            }
            for name, kind, told in fields
        ],
        "data": [
            {"splits/name": name, "splits/num_samples": len(facts.splits.ids(name))} for name in facts.splits.names
        ],
    }
