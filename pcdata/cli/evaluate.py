"""The command that scores predicted labels of objects against true ones: evaluate."""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pcdata.cli.argument_types import positive, whole_numbers
from pcdata.cli.outputs import text_files

if TYPE_CHECKING:
    from pcdata.validation.label_files import LabelFile


def add_to(commands: Any) -> None:
    """Add the command to the parser."""
    evaluate = commands.add_parser(
        "evaluate", help="score predicted labels of objects against true ones: overlap, boundaries, objects found"
    )
    evaluate.add_argument(
        "predicted",
        metavar="PREDICTED",
        help="label image (.png) or cloud (.pcd, .ply); or a folder of such files; or a dataset that a build wrote, "
        "with the points of ClusterObjects as they are",
    )
    evaluate.add_argument(
        "true",
        metavar="TRUE",
        help="the right labels: a file, or a folder of files of the same names, of a dataset's ids",
    )
    for flag, whose in (("--background", "PREDICTED"), ("--true-background", "TRUE")):
        evaluate.add_argument(
            flag,
            type=whole_numbers,
            metavar="IDS",
            help=f"labels of {whose} that are no object, such as 0,1,255, beside negative ones (default: 0 in images)",
        )
    evaluate.add_argument(
        "--ignore",
        type=whole_numbers,
        default=(),
        metavar="IDS",
        help="labels of TRUE that are not scored, nor what is predicted there, such as a robot's",
    )
    evaluate.add_argument(
        "--true-parts",
        type=positive,
        metavar="N",
        help="TRUE labels objects in parts: label divided by N is the object",
    )
    evaluate.add_argument(
        "--tolerance",
        type=_tolerance,
        default=0.003,
        metavar="T",
        help="of boundaries, in parts of the image's diagonal; from 1 in pixels (default: 0.003)",
    )
    evaluate.add_argument("--json", metavar="FILE", help="also write the scores to this file")
    evaluate.set_defaults(run=_evaluate)


def _tolerance(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not (0 < value < math.inf):
        raise argparse.ArgumentTypeError(f"must be a positive number, got {text!r}")
    return value


def _evaluate(arguments: argparse.Namespace) -> None:
    from dataclasses import asdict

    from pcdata.files.strict_json import json_text
    from pcdata.report.segmentation_text import segmentation_text
    from pcdata.validation.label_files import matched_labels
    from pcdata.validation.segmentation import mean_scores, score_segmentation

    with text_files("evaluate", json=arguments.json) as write:
        scores = {}
        for name, predicted, true in _label_pairs(arguments):
            guess, truth, blank = matched_labels(predicted, true)
            scores[name] = score_segmentation(guess, truth, ignore=blank, tolerance=arguments.tolerance)
        told = {"mean": mean_scores([*scores.values()]), "scenes": {name: asdict(one) for name, one in scores.items()}}
        write("json", json_text(told, indent=1) + "\n")
    print(segmentation_text(scores))
    if arguments.json is not None:
        print(f"json  {arguments.json}")


def _label_pairs(arguments: argparse.Namespace) -> Iterator[tuple[str, LabelFile, LabelFile]]:
    """Read the labels of every scene: its name, the predicted ones, the true ones."""
    from pcdata.datasets.stored_clouds import StoredClouds
    from pcdata.errors import ConfigError
    from pcdata.io.store.manifest import Manifest
    from pcdata.validation.label_files import paired_files, read_label_file
    from pcdata.validation.stored_labels import labels_of_sample, paired_samples

    def read_true(path: Path) -> LabelFile:
        return read_label_file(
            path, background=arguments.true_background, ignore=arguments.ignore, parts=arguments.true_parts
        )

    if Manifest.is_one(Path(arguments.true)):
        raise ConfigError(f"evaluate: {arguments.true} is a dataset, which may be PREDICTED alone; give TRUE as files")
    if not Manifest.is_one(Path(arguments.predicted)):
        for name, predicted, path in paired_files(arguments.predicted, arguments.true):
            yield name, read_label_file(predicted, background=arguments.background), read_true(path)
        return
    if arguments.background is not None:
        raise ConfigError("evaluate: --background is for files; of a dataset the negative labels are no object")
    samples = StoredClouds(arguments.predicted)
    for name, path in paired_samples(samples.ids, arguments.predicted, arguments.true):
        true = read_true(path)
        yield name, labels_of_sample(samples.load(name), Path(arguments.predicted) / name, true), true
