"""Labels under other names."""

from __future__ import annotations

import pytest
import torch

from pcdata.errors import ConfigError, DTypeError
from pcdata.structures import PointCloud
from pcdata.transforms import MapLabels


def renamed(labels: list[int], **fields: object) -> list[int]:
    cloud = PointCloud(
        points=torch.rand(len(labels), 3), labels=torch.tensor(labels, dtype=torch.int64), frame_id="base"
    )
    result = MapLabels(**fields)(cloud)
    assert result.labels is not None
    assert torch.equal(result.points, cloud.points)
    assert cloud.labels.tolist() == labels
    return result.labels.tolist()


@pytest.mark.parametrize(
    ("mapping", "others", "expected"),
    [
        ((), None, [5, 1, 2, -1, 5]),
        (((1, 2), (2, 1)), None, [5, 2, 1, -1, 5]),  # exchanged, not one after the other
        (((2, 1), (5, 1)), None, [1, 1, 1, -1, 1]),
        (((3, 4),), None, [5, 1, 2, -1, 5]),  # a label that is not there
        (((5, 0),), 9, [0, 9, 9, 9, 0]),
        (((-1, 0), (5, -1)), None, [-1, 1, 2, 0, -1]),
    ],
)
def test_labels_become_what_the_table_says(mapping, others, expected):
    assert renamed([5, 1, 2, -1, 5], mapping=mapping, others=others) == expected


def test_a_table_that_names_a_label_twice_and_a_cloud_without_labels_are_refused():
    with pytest.raises(ConfigError, match=r"MapLabels: mapping must name every label once, \[1\] are named again"):
        MapLabels(mapping=((1, 2), (1, 3)))
    with pytest.raises(DTypeError, match="MapLabels: the cloud has no labels"):
        MapLabels(mapping=((1, 2),))(PointCloud(points=torch.rand(3, 3), frame_id="base"))
    assert renamed([], mapping=((1, 2),)) == []
