"""YAML that a person would not write: refused with the place, quickly, whatever it holds."""

from __future__ import annotations

import time

import pytest

from pcdata.build import config_from_yaml
from pcdata.errors import CalibrationError, ConfigError
from pcdata.io.calibration.calibration_yaml import calibration_from_yaml
from pcdata.yaml_nodes import parse_yaml

PIPELINE = "depth:\n  - MaskDepth: {{near: 0.2, far: {}}}\n  - Deproject\n"

VALUES = [
    "!!int ''", "!!int '_'", "!!float ''", "!!float x", "!!bool x", "!!timestamp x", "!!binary '!'", 
    "!!python/tuple []",
    "!!set {a}", "!!omap [a]", "!!pairs [a]", "!!null x", "!!str 1", "!own 1", "!!int", "._", "0x_", "0b", "1:2:3:4:5",
    "2026-13-45", "2026-01-01 99:99:99", "2026-01-01T00:00:00+99:99", "1" * 5000, "0x" + "f" * 5000, "1e999",
    ".nan", "-.inf",
    ".inf", "[1, 2]", "{a: 1}", "{? [a] : 1}", "{? {a: b} : 1}", "<<", "{<<: 1}", "=", "&a 1", "'1'", "yes",
    '"\\ud800"', '"\\xZZ"', "%", "@a", "`", "\x07",
]  # fmt: skip


@pytest.mark.parametrize("value", VALUES)
def test_a_value_that_does_not_fit_is_a_typed_error(value):
    with pytest.raises(ConfigError, match="<yaml>"):
        config_from_yaml(PIPELINE.format(value) if value != "&a 1" else PIPELINE.format("*a"))


@pytest.mark.parametrize("text", ["", "\n", "# only words\n", "---\n", "~", "null", "--- \n...\n", "\ufeff"])
def test_a_file_without_a_value_is_no_configuration_and_no_calibration(text):
    with pytest.raises(ConfigError, match="is empty"):
        config_from_yaml(text)
    with pytest.raises(CalibrationError, match="is empty"):
        calibration_from_yaml(text)


BOMBS = {
    "flow mappings": "{a: " * 75_000,
    "flow lists": "[" * 300_000,
    "block lists": "- " * 133_333,
    "block mappings": "\n".join(" " * level + "a:" for level in range(1200)),
    "keys that are mappings": "? " * 133_333,
    "many values": "[" + "1," * 150_000 + "]",
    "many entries": "\n".join(f"a{n}: 1" for n in range(30_000)),
    "one long word": "a" * 300_000,
    "one long key": "? " + "a" * 300_000 + "\n: 1",
    "many anchors": "[" + ", ".join(f"&a{n} x" for n in range(26_666)) + "]",
    "many steps": "depth: [" + "Deproject," * 8_333 + "]",
    "many unknown steps": "depth: [" + "Depraject," * 8_333 + "]",
    "many unknown fields": "depth: [Deproject: {" + ",".join(f"near{n}: 1" for n in range(4_666)) + "}]",
    "many documents": "--- 1\n" * 33_333,
    "an alias bomb": "a: &a [x,x]\n" + "\n".join(f"b{n}: &b{n} [*a,*a]" for n in range(20)),
}


@pytest.mark.parametrize("name", BOMBS)
def test_texts_made_to_take_long_end_in_a_short_typed_error(name):
    start = time.process_time()
    with pytest.raises(ConfigError) as caught:
        config_from_yaml(BOMBS[name], name="here")
    assert time.process_time() - start < 20  # seconds of this process; three of a quiet machine
    assert len(str(caught.value)) < 20_000


def test_a_name_given_twice_is_refused_at_every_level():
    with pytest.raises(ConfigError, match="twice"):
        config_from_yaml("depth: [Deproject]\ndepth: [Deproject]\n")
    with pytest.raises(ConfigError, match="twice"):
        config_from_yaml(PIPELINE.format("1, far: 2"))


def test_a_calibration_of_a_long_chain_takes_time_in_proportion_to_its_length():
    def seconds(count: int) -> float:
        pose = "{translation: [0, 0, 0.1], quaternion_xyzw: [0, 0, 0, 1]}"
        lines = "".join(f"  f{n}_from_f{n + 1}: {pose}\n" for n in range(count))
        start = time.process_time()
        calibration = calibration_from_yaml(
            f"format: pcdata-calibration\nversion: 1\nunit: metre\ntransforms:\n{lines}"
        )
        moved = calibration.transform("f0", f"f{count}")
        assert float(moved[2, 3]) == pytest.approx(0.1 * count)
        return time.process_time() - start

    seconds(10)
    assert seconds(800) < 16 * seconds(100)  # eight times the work; 64 times where it grows with the square


@pytest.mark.parametrize(
    "text", ["a: \x00", "a: \x07b", "a: *b", "a: !!python/x 1", "[" * 99, '"\\U99999999"', "%YAML 9.9.9"]
)
def test_yaml_of_any_origin_is_plain_data_or_a_value_error(text):
    with pytest.raises(ValueError, match=r"\S"):
        parse_yaml(text)
