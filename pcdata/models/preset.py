"""preset: a model's contract as a pipeline and a collate function that end in the model's own tensors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from pcdata.datasets import CloudDataset
from pcdata.errors import ConfigError, DTypeError
from pcdata.io import CaptureSource
from pcdata.models.batch import ModelBatch
from pcdata.models.batching import batch_of
from pcdata.models.catalog import contract as contract_named
from pcdata.models.catalog import missing_choices
from pcdata.models.contract import ModelContract
from pcdata.models.model_check import require
from pcdata.models.steps import pipeline_of
from pcdata.structures import DepthFrame, PointCloud
from pcdata.structures.unbatched import Unbatched
from pcdata.transforms import Compose
from pcdata.yaml_nodes import YamlDocument, yaml_text


class Preset:
    """A contract with its choices made, the pipeline that meets it, and :meth:`collate` for ``DataLoader``.

    The pipeline is yours to change (``preset.pipeline``): a chain of its steps and your own cleaning and augmentation;
    :func:`pcdata.models.model_check` says whether the result still fits the model.
    """

    def __init__(self, contract: ModelContract, choices: Mapping[str, Any], pipeline: Compose | None = None) -> None:
        self.contract = contract
        self.choices = dict(choices)
        self.pipeline = pipeline_of(contract, merge_views=True) if pipeline is None else pipeline

    def dataset(self, source: CaptureSource, *, seed: int = 0) -> CloudDataset:
        """Run the pipeline on the captures of a source; :meth:`collate` makes the batches."""
        return _PresetDataset(source, self.pipeline, seed=seed, gives=self._sample_type())

    def collate(self, samples: Sequence[PointCloud | DepthFrame]) -> ModelBatch:
        """Make a batch of the pipeline's results: the model's tensors, with all that leads back.

        Raises:
            ContractError: the clouds are in another frame or unit, or of another count than the model takes.
        """
        kind = self._sample_type()
        if not isinstance(samples, (list, tuple, Unbatched)) or not samples:
            raise DTypeError(f"{self!r}: collate takes a list of {kind.__name__}, got {type(samples).__name__}")
        wrong = [type(sample).__name__ for sample in samples if not isinstance(sample, kind)]
        if wrong:
            raise DTypeError(f"{self!r}: collate takes a list of {kind.__name__}, got a {wrong[0]} in it")
        batch = batch_of(samples, self.contract, self.choices)
        require(batch, self.contract.name, cheap=True)
        return batch

    def _sample_type(self) -> type:
        return DepthFrame if self.contract.takes == "depth image" else PointCloud

    def to_yaml(self) -> str:
        """Write model, choices and pipeline as YAML that :meth:`from_yaml` reads back."""
        parts = {"model": self.contract.name, "choices": self.plain_choices(), "pipeline": self.pipeline.sections()}
        return yaml_text(parts)

    def plain_choices(self) -> dict[str, Any]:
        """Return the choices as JSON and YAML can hold them."""
        return {name: _plain(value) for name, value in self.choices.items()}

    @classmethod
    def from_yaml(cls, text: str) -> Preset:
        """Build from YAML, with the pipeline as it is written there.

        Raises:
            ConfigError: not a preset, an unknown model or choice, or a pipeline that cannot be built.
        """
        document = YamlDocument(text, "preset")
        entries = document.mapping(document.root, "a preset")
        if set(entries) != {"model", "choices", "pipeline"}:
            document.fault(document.root, "the YAML must have model, choices and pipeline, and only those")
        document.raise_faults()
        name, choices, pipeline = (entries[key][1] for key in ("model", "choices", "pipeline"))
        chosen = {key: _tuples(document.plain(node)) for key, (_, node) in document.mapping(choices, "choices").items()}
        document.raise_faults()
        made = preset(str(document.plain(name)), **chosen)
        made.pipeline = Compose.from_document(document, pipeline)
        if made.pipeline.gives is not made._sample_type():
            document.fault(pipeline, f"{made!r} takes a {made._sample_type().__name__}, the pipeline ends in another")
            document.raise_faults()
        return made

    def __repr__(self) -> str:
        choices = "".join(f", {name}={value!r}" for name, value in self.choices.items())
        return f"preset({self.contract.name!r}{choices})"

    def __str__(self) -> str:
        return f"{self!r}: {self.contract.title}\n{self.to_yaml()}"


def preset(name: str, /, **choices: Any) -> Preset:
    """Return the pipeline and collate function of a model; what its contract leaves open must be given.

    Args:
        name: a name in :data:`pcdata.models.CONTRACTS`.
        choices: such as ``frame``, ``crop``, ``num_points``, ``channels``; see the model's page.

    Raises:
        ConfigError: an unknown model or choice, or an open choice that was not made, with what to give.
    """
    contract = contract_named(name, **choices)
    if contract.required_choices:
        raise ConfigError(f"preset({name!r}): the model leaves open what must be chosen: {missing_choices(contract)}")
    return Preset(contract, choices)


class _PresetDataset(CloudDataset):
    """A dataset whose samples are what the preset's pipeline gives."""

    def __init__(self, source: CaptureSource, pipeline: Compose, *, seed: int, gives: type) -> None:
        super().__init__(source, pipeline, seed=seed)
        self.gives = gives


def _plain(value: Any) -> Any:
    if isinstance(value, (set, frozenset)):
        value = sorted(value)
    return [_plain(item) for item in value] if isinstance(value, (list, tuple)) else value


def _tuples(value: Any) -> Any:
    return tuple(_tuples(item) for item in value) if isinstance(value, list) else value
