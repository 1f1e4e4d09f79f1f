"""Build configurations: every fault with its place, all at once."""

from __future__ import annotations

import pytest

from pcdata.build import config_from_yaml, load_config
from pcdata.errors import ConfigError


def faults(text: str) -> list[str]:
    with pytest.raises(ConfigError) as caught:
        config_from_yaml(text, name="c.yaml")
    return str(caught.value).splitlines()


def test_a_file_that_says_nothing_has_the_documented_defaults():
    config = config_from_yaml("{}")
    assert (config.output.format, config.output.compression, config.output.keep_raw) == ("hdf5", "none", False)
    assert (config.loader.batch_size, config.loader.num_workers, config.loader.collate) == (8, 2, "packed")


@pytest.mark.parametrize(
    ("text", "place", "words"),
    [
        ("outptu: {}", "1:1", ["'outptu'", "'output'"]),
        ("output:\n  fromat: npz", "2:3", ["output.fromat", "'format'"]),
        ("output:\n  format: parquet", "2:11", ["output.format", "hdf5", "'parquet'"]),
        ("output: {format: npz, compression: lzf}", "1:36", ["npz", "none, gzip", "lzf"]),
        ("output: {format: pt, compression: gzip}", "1:35", ["pt", "none", "gzip"]),
        ("output: {compression: zip}", "1:23", ["compression"]),
        ("output: {keep_raw: perhaps}", "1:20", ["keep_raw", "'perhaps'"]),
        ("output: npz", "1:9", ["output", "mapping", "'npz'"]),
        ("output: [npz]", "1:9", ["output", "mapping", "a list"]),
        ("loader: {batch_size: 0}", "1:22", ["batch_size", "greater than or equal to 1"]),
        ("loader: {batch_size: many}", "1:22", ["batch_size", "'many'"]),
        ("loader: {num_workers: -1}", "1:23", ["num_workers"]),
        ("loader: {collate: stacked}", "1:19", ["collate", "packed", "'stacked'"]),
        ("loader: {collate: windows}", "1:19", ["collate", "say which", "num_obs: 2"]),
        ("loader: {windows: {num_obs: 3, horizon: 2}}", "1:19", ["loader.windows", "num_obs or more"]),
        ("loader: {windows: {num_obs: 3}}", "1:19", ["loader.windows", "Field required"]),
        ("loader: {windows: {num_obs: 1, horizon: 2, pad: zeros}}", "1:49", ["loader.windows", "'repeat' or 'drop'"]),
        ("loader: {seed: 1.5}", "1:16", ["seed"]),
        ("loader: {seed: 1, seed: 2}", "1:19", ["'seed'", "twice"]),
        ("loader:\n  wokers: 2", "2:3", ["loader.wokers", "num_workers"]),
        ("output: {}\noutput: {}", "2:1", ["'output'", "twice"]),
        ("depth: [Deprojct]", "1:9", ["'Deprojct'", "'Deproject'"]),
        ("- a\n- b", "1:1", ["configuration", "mapping"]),
        ("depth: [", "", ["not valid YAML"]),
        ("a: &x [1]\nb: *x", "2:4", ["aliases"]),
    ],
)
def test_a_fault_is_told_with_its_place_and_what_would_do(text, place, words):
    (line,) = faults(text)
    assert line.startswith(f"c.yaml:{place}")
    for word in words:
        assert word in line


def test_all_faults_come_at_once_in_file_order():
    text = "depth: [Deprojct]\noutput: {format: x}\nloader: {batch_size: 0, colate: packed}\nmore: 1\n"
    assert [line.split(" ")[0] for line in faults(text)] == ["c.yaml:1:9:", "c.yaml:2:18:", *["c.yaml:3:22:"], "c.yaml:3:25:", "c.yaml:4:1:"]  # fmt: skip  # noqa: E501


@pytest.mark.parametrize("content", [None, b"\xff\xfe\xfa"])
def test_a_file_that_cannot_be_read_is_a_config_error_that_names_it(tmp_path, content):
    path = tmp_path / "my.yaml"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(ConfigError, match=r"my\.yaml"):
        load_config(path)
    with pytest.raises(ConfigError, match="configuration: "):
        load_config(tmp_path)


def test_a_file_gives_what_its_text_gives(tmp_path):
    text = "depth: [Deproject]\noutput: {format: hdf5, compression: lzf, keep_raw: true}\nloader: {collate: fixed}\n"
    (tmp_path / "my.yaml").write_text(text)
    config = load_config(tmp_path / "my.yaml")
    assert (config.output.compression, config.output.keep_raw, config.loader.collate) == ("lzf", True, "fixed")
    assert config.pipeline.to_config() == config_from_yaml(text).pipeline.to_config()
