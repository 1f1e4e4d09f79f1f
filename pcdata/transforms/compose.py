"""Compose: the one chain, from captures or clouds to what a model takes."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import zip_longest
from os import PathLike
from typing import Any

from torch import Generator, Tensor, nn

from pcdata.contracts.compiling import called_apart, is_traced
from pcdata.errors import ConfigError
from pcdata.files.opening import read_text
from pcdata.rng import GeneratorLike, Streams
from pcdata.structures import PointCloud
from pcdata.structures.showing import shown_page
from pcdata.transforms.base import Data, Transform, num_clouds, sha256_of
from pcdata.transforms.chain_reading import SECTIONS, steps_of_document, steps_of_sections
from pcdata.transforms.chain_rules import check_chain, warn_of_order
from pcdata.transforms.decisions import Decision, Decisions, Entry, in_a_row
from pcdata.transforms.field_checks import validated_fields
from pcdata.transforms.fused_beginning import find_beginning
from pcdata.transforms.fused_motions import read_by_motions
from pcdata.transforms.passes import run_step, run_steps
from pcdata.yaml_nodes import Document, YamlDocument, yaml_text


class Compose(Transform):
    """Run steps one after another, on captures or on clouds; check at construction that neighbors fit.

    A cloud enters at the first step that takes one, so one chain serves depth images and PLY files; where every step
    takes captures and the last gives clouds, it stays as it is. The steps before the first random one always give the
    same: a dataset may store what they leave (:meth:`split`). A chain within is opened: it adds nothing to its steps.

    Raises:
        ConfigError: a step cannot take what the step before it gives (capture or cloud, frame, unit).
    """

    steps: Sequence[Transform]

    def __init__(self, steps: Sequence[Transform]) -> None:
        given = validated_fields(Compose, {"steps": list(steps)})["steps"]
        flat: list[Transform] = []
        for step in given:
            flat += step.steps if isinstance(step, Compose) else [step]
        check_chain(flat)
        warn_of_order(flat, stacklevel=2)
        self._hold(flat)

    @classmethod
    def _of(cls, steps: Sequence[Transform]) -> Compose:
        """A part of a chain, which was checked as a whole and warned about."""
        part = cls.__new__(cls)
        assert isinstance(part, Compose)
        part._hold(steps)
        return part

    def _hold(self, steps: Sequence[Transform]) -> None:
        self._beginning = find_beginning(steps)
        random, clouds, keeps = [], [], True
        for position, step in enumerate(steps):
            random += [position] * step.is_random
            clouds += [position] * issubclass(PointCloud, step.takes)
            keeps = keeps and step.keeps_clouds
        self._captures = clouds[0] if clouds else len(steps)  # so many steps take captures alone
        self._stored = random[0] if random else len(steps)  # so many steps may be stored
        self._last_random = random[-1] if random else -1
        self.steps = nn.ModuleList(steps)  # type: ignore[assignment]
        self.is_random = bool(random)  # type: ignore[misc]
        self.keeps_clouds = keeps  # type: ignore[misc]
        self.takes = steps[0].takes if steps else PointCloud  # type: ignore[misc]
        self.gives = steps[-1].gives if steps else PointCloud  # type: ignore[misc]

    def frame_after(self, frame: str | None) -> str | None:
        """The frame after the last step."""
        for step in self.steps:
            frame = step.frame_after(frame)
        return frame

    def unit_given(self) -> str | None:
        """The unit that the last step to change it gives."""
        units = [step.unit_given() for step in self.steps]
        return next((unit for unit in reversed(units) if unit is not None), None)

    def parts(self) -> list[Transform]:
        """The steps, with those within them."""
        return [part for step in self.steps for part in step.parts()]

    # -- running ---------------------------------------------------------------------------------------------------

    def forward(self, data: Data, *, generator: GeneratorLike | None = None) -> Any:
        """Run every step from the first that takes the data; the steps record themselves, the chain adds nothing."""
        if is_traced():
            return called_apart(Compose.forward, self, data, generator=generator)
        return run_steps(list(self.steps), data, *self._enter(data, generator), beginning=self._beginning)

    def consume(
        self, data: PointCloud, *, generator: GeneratorLike | None = None, sources: Mapping[str, Tensor] | None = None
    ) -> Any:
        """Run every step on clouds that nobody else holds: their memory may be used for the result.

        Args:
            data: the clouds.
            generator: as of any step.
            sources: by the name of a field, (B,) int64 addresses where the rows of each cloud lie, in memory that
                somebody holds; the clouds have only room for them. None = they have all.
        """
        return run_steps(
            list(self.steps),
            data,
            *self._enter(data, generator),
            beginning=self._beginning,
            is_own=not data.points.requires_grad,
            sources=sources,
        )

    def run_in_passes(
        self, data: Data, *, generator: GeneratorLike | None = None, after: Callable[[range, Any], None]
    ) -> Any:
        """Run every step as :meth:`forward` does; call ``after(positions of the steps, data)`` behind each pass.

        Several steps may be one pass, so what lies between them is never made, and between selections fields that none
        of them looks at are missing: :meth:`step_through` makes all. It may look at data alone.
        """
        return run_steps(list(self.steps), data, *self._enter(data, generator), beginning=self._beginning, told=after)

    def steps_from(self, position: int) -> Compose:
        """Return the steps from one on, for what those before it leave."""
        return self._of(list(self.steps)[position:])

    @property
    def fields_read_once(self) -> Sequence[str]:
        """The fields of clouds that are read by one pass alone, before anybody looks at them: see :meth:`consume`."""
        return read_by_motions(list(self.steps)[self._captures :])

    def step_through(self, data: Data, *, generator: GeneratorLike | None = None) -> Iterator[tuple[Transform, Any]]:
        """Yield ``(step, data)`` after every step, for looking inside."""
        position, generator = self._enter(data, generator)
        for step in list(self.steps)[position:]:
            data, generator = run_step(step, data, generator)
            yield step, data

    def _enter(self, data: Data, generator: GeneratorLike | None) -> tuple[int, GeneratorLike | None]:
        """Return the first step to run, and the generator or one for each cloud."""
        # A chain of images alone has no place for a cloud: its first step says so.
        position = self._first_step(data)
        if self._last_random < position:
            return position, None
        generator = self._generator(generator)
        if not isinstance(generator, Generator | Streams):
            generator = Streams.of(generator, num_clouds(data))
        return position, generator

    # -- running again ---------------------------------------------------------------------------------------------

    def _steps_for(self, data: Data) -> list[Transform]:
        return list(self.steps)[self._first_step(data) :]

    def _first_step(self, data: Data) -> int:
        return self._captures if isinstance(data, PointCloud) and issubclass(self.gives, PointCloud) else 0

    def find_decision(self, entries: Sequence[Entry], stop: int) -> tuple[Decision, int] | None:
        """Return what the steps decided, if their entries end one after another at ``stop``."""
        found = in_a_row(list(self.steps), entries, stop)
        return None if found is None else (Decision({}, stop - 1, found[0]), found[1])

    def replayed(self, data: Data, decided: Decisions) -> Any:
        """Repeat what each step decided."""
        for number, step in enumerate(self.steps):
            of_step = [one.within[number] for one in decided.of_clouds]
            data = step.replayed(data, Decisions(type(step).__name__, of_step))
        return data

    # -- what may be stored ----------------------------------------------------------------------------------------

    def split(self) -> tuple[Compose, Compose]:
        """Return the longest deterministic beginning, which a dataset may store, and the rest."""
        steps = list(self.steps)
        return self._of(steps[: self._stored]), self._of(steps[self._stored :])

    def stored_fingerprint(self) -> str:
        """SHA-256 of what may be stored: equal for datasets that hold the same clouds."""
        steps = list(self.steps)[: self._stored]
        text = ""
        for part in (steps[: self._captures], steps[self._captures :], []):  # of captures, of clouds, nothing random
            text += sha256_of(["Compose", Compose.version, {"steps": [step._identity() for step in part]}])
        return hashlib.sha256(text.encode()).hexdigest()

    def difference(self, other: Compose) -> str:
        """Say where the steps of two chains that may be stored first differ."""
        pairs = zip_longest(list(self.steps)[: self._stored], list(other.steps)[: other._stored])
        for position, (mine, stored) in enumerate(pairs, start=1):
            if mine is None or stored is None or mine.fingerprint() != stored.fingerprint():
                return f"step {position}: {mine or 'nothing'} here, {stored or 'nothing'} there"
        return "a transform's version changed"

    # -- written down ----------------------------------------------------------------------------------------------

    def sections(self) -> dict[str, list[Any]]:
        """Return the steps as plain data in the sections of a configuration, which :meth:`from_config` reads.

        ``depth`` takes captures, ``cloud`` clouds, and ``augment`` begins with the first random step on clouds.
        """
        steps = list(self.steps)
        end = max(self._captures, self._stored)
        if self._stored < self._captures:  # a random step on captures: it is not that one
            end = next((i for i in range(end, len(steps)) if steps[i].is_random), len(steps))
        parts = (steps[: self._captures], steps[self._captures : end], steps[end:])
        return {section: [step.to_config() for step in part] for section, part in zip(SECTIONS, parts)}

    def show_steps(self, data: Data, *, generator: GeneratorLike | None = None, max_points: int = 100_000) -> Any:
        """Return a :class:`pcdata.report.Page` that steps through the clouds after every step.

        Args:
            data: a capture or a cloud.
            generator: as of any step; needed where steps are random.
            max_points: drawn of each cloud; of more every k-th is.
        """
        views: list[tuple[str, Any]] = [("capture", data)]
        for step, made in self.step_through(data, generator=generator):
            if isinstance(made, PointCloud):
                views.append((type(step).__name__, made))
        return shown_page(views, repr(data), max_points=max_points)

    def to_yaml(self) -> str:
        """Write the sections as YAML that :meth:`from_yaml` reads."""
        return yaml_text(self.sections())

    @classmethod
    def from_yaml(cls, text: str, *, name: str = "<yaml>") -> Compose:
        """Build from YAML: a list of ``{transform: fields}``, or such lists in the sections depth, cloud and augment.

        Beside sections, ``sensor`` may name the one whose figures stand for the word ``sensor`` as a value: the value
        is computed here, and the chain holds the number.

        Raises:
            ConfigError: every fault, as ``name:line:column: what``.
        """
        document = YamlDocument(text, name)
        return cls.from_document(document, document.root)

    @classmethod
    def from_config(cls, steps: Sequence[Any] | Mapping[str, Any], *, name: str = "<config>") -> Compose:
        """Build from plain data: a list of steps, or the sections that :meth:`sections` returns.

        Raises:
            ConfigError: every fault.
        """
        return cls.from_document(Document(steps, name), steps)

    @classmethod
    def load(cls, path: str | PathLike[str]) -> Compose:
        """Build from a YAML file; see :meth:`from_yaml`."""
        return cls.from_yaml(read_text("configuration", path, error=ConfigError), name=str(path))

    @classmethod
    def from_document(cls, document: Document, node: Any) -> Compose:
        """Build from a node of a document and raise its faults; see :meth:`from_yaml`."""
        return cls._placed(document, steps_of_document(document, node))

    @classmethod
    def from_sections(cls, document: Document, entries: Mapping[str, tuple[Any, Any]]) -> Compose:
        """Build from those entries of a document that are sections of a chain, and raise its faults."""
        return cls._placed(document, steps_of_sections(document, entries))

    @classmethod
    def _placed(cls, document: Document, placed: Sequence[tuple[Transform, Any]]) -> Compose:
        document.raise_faults()
        try:
            return cls([step for step, _ in placed])
        except ConfigError as error:
            places = [node for step, node in placed for _ in (step.steps if isinstance(step, Compose) else [step])]
            for (position, *_), message in error.faults:
                document.fault(places[int(position)], message)
            document.raise_faults()
            raise

    def __len__(self) -> int:
        return len(self.steps)

    def __repr__(self) -> str:
        return f"Compose([{', '.join(map(repr, self.steps))}])"
