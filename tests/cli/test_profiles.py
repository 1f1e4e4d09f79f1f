"""``pcdata profiles``: every sensor in a table, one with its sources."""

from __future__ import annotations

import pytest

from pcdata.cli import main
from pcdata.sensors import sensor_profiles


def test_the_table_has_a_line_for_every_sensor(capsys):
    assert main(["profiles"]) == 0
    first_words = [line.split()[0] for line in capsys.readouterr().out.splitlines() if line]
    assert first_words[2:-1] == list(sensor_profiles())


@pytest.mark.parametrize("name", list(sensor_profiles()))
def test_one_sensor_is_shown_with_every_source(name, capsys):
    assert main(["profiles", name]) == 0
    text = " ".join(capsys.readouterr().out.split())
    profile = sensor_profiles()[name]
    assert profile.title in text
    assert profile.noise.formula in text
    for figure, source in profile.sources.items():
        assert f"{figure}: {' '.join(source.split())}" in text


def test_a_misspelled_sensor_is_the_request_at_fault(capsys):
    assert main(["profiles", "kinekt_v1"]) == 2
    assert "did you mean 'kinect_v1'?" in capsys.readouterr().err
