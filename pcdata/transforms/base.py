"""Transform: a module that first decides, then does.

To write one, subclass ``SpatialTransform`` (a 4x4 per cloud), ``SelectTransform`` (which rows stay), or
:class:`Transform` itself; declare the fields as annotations. Construction is keyword-only and validated; repr, YAML,
fingerprint and pickling come from the fields; every instance joins the contract suite through its class name.
"""

from __future__ import annotations

import dataclasses
import hashlib
import inspect
import json
from collections.abc import Callable, Sequence
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from torch import Tensor, nn
from typing_extensions import dataclass_transform

from pcdata.contracts.compiling import called_apart, is_traced
from pcdata.contracts.on_host import counts_of
from pcdata.errors import (
    ConfigError,
    DTypeError,
    FrameError,
    ReplayError,
    TooFewPointsError,
    UnitError,
    add_note,
)
from pcdata.registry import Registry
from pcdata.rng import GeneratorLike, Streams
from pcdata.structures import METRE, DepthFrame, PointCloud
from pcdata.structures.read_later import OfClouds, meta_at_hand
from pcdata.transforms.class_checks import check_class, undeclared_streams, watched
from pcdata.transforms.decisions import Decision, Decisions, Entry
from pcdata.transforms.field_checks import field_names, length_fields, validated_fields
from pcdata.transforms.noted_steps import NotedSteps, read_in_histories
from pcdata.transforms.replaying import replayed_through
from pcdata.transforms.row_sums import row_sums

Data = DepthFrame | PointCloud
Params = dict[str, Tensor]

REGISTRY: Registry[type[Transform]] = Registry("transform")


@dataclass_transform(kw_only_default=True)
class Transform(nn.Module):
    """A configured step from captures or clouds to clouds; the same for one cloud, a batch, CPU and GPU."""

    is_random: ClassVar[bool] = False  # draws from the generator
    needs_metres: ClassVar[bool] = False  # works in metres, whatever its fields: refuse normalized clouds
    runs_statistics: ClassVar[bool] = False  # its cost and its answer depend on the rest of the scene
    keeps_clouds: ClassVar[bool] = True  # cloud b of the result is cloud b of the input: none is joined or split
    takes: ClassVar[type] = PointCloud
    gives: ClassVar[type] = PointCloud
    # What it decides about rows is repeated on data where it comes to the same rows; or it depends on their number
    # alone; or each point is judged by itself, by the fields and what the history tells, whatever data it is of.
    decides_by: ClassVar[Literal["rows", "count", "point"]] = "rows"
    version: ClassVar[int] = 1  # raised when the same fields give another result
    no_streams: ClassVar[Streams]  # those of a step that is not random

    def __init_subclass__(cls, *, abstract: bool = False, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        cls.no_streams = undeclared_streams(cls)
        dataclasses.dataclass(eq=False, repr=False, kw_only=True)(cls)
        check_class(cls)
        if not cls.__module__.startswith("pcdata."):  # those of pcdata are proven by the laws of the contract suite
            cls.forward = watched(cls.forward)  # type: ignore[method-assign]
        if not abstract:
            if cls.__name__ in REGISTRY and REGISTRY[cls.__name__].__module__ != cls.__module__:
                raise ConfigError(f"a transform called {cls.__name__} is registered already; choose another name")
            REGISTRY[cls.__name__] = cls

    def __new__(cls, *args: Any, **kwargs: Any) -> Transform:
        """Prepare the module before the generated ``__init__`` assigns fields (some hold other transforms)."""
        self: Transform = super().__new__(cls)
        nn.Module.__init__(self)
        return self

    def __post_init__(self) -> None:
        for name, value in validated_fields(type(self), self.config_fields()).items():
            if not isinstance(value, nn.Module):  # a step within is one of the module's own already
                self.__dict__[name] = value
        self.check_fields()

    # -- what a subclass writes ------------------------------------------------------------------------------------

    def check_fields(self) -> None:
        """Check rules that bind several fields; raise :class:`ConfigError`."""

    def make_params(self, data: Any, streams: Streams) -> Params:
        """Decide: all that is random or derived from the data; only steps that say ``is_random`` draw from ``streams``.

        Every value has leading dimension B, except ``index``, ``ptr``, ``per_point`` and those named after a per-point
        field. ``rows`` (B,) int64 tells which rows were decided about, where the step knows; else it is found out.
        """
        return {}

    def transform(self, data: Any, params: Params) -> Any:
        """Do: pure given the params; never draws, never changes its input."""
        raise NotImplementedError(f"{type(self).__name__}: write the method transform(self, data, params)")

    def fixed_work(self, like: Any) -> Callable[[Any], Any] | None:
        """Prepare to run with fixed shapes on data like these, frame after frame; None = the step cannot.

        What is returned takes a ``DepthFrame``, or the clouds of a step before as ``FixedRows`` (see
        :mod:`pcdata.functional.fixed_rows`), and gives likewise. It sends nothing to the device and waits for nothing,
        so a device can repeat what it started: values are looked at there alone.
        """
        return None

    def fixed_facts(self, before: PointCloud, params: Params, told: Tensor) -> tuple[Params, OfClouds]:
        """Return the params of what :meth:`fixed_work` did, and what joins the meta of each cloud.

        Args:
            before: the clouds that the step was given, points alone.
            params: which rows were chosen: ``index`` and ``ptr``.
            told: (B, K) float64 that the work had for the host.
        """
        raise NotImplementedError(f"{type(self).__name__}: write the method fixed_facts(self, before, params, told)")

    def repeat(self, data: Any, decided: Decisions) -> Params:
        """Decide as the history tells, on the data that it is of or on others.

        By default everything is decided anew, with the same draws, and what the history tells replaces what came out.
        """
        params = self.make_params(data, decided.streams() if self.is_random else self.no_streams)
        told = {name: decided.values(name, like=value) for name, value in params.items() if decided.has(name)}
        return {**params, **told}

    def origins(self, decisions: Sequence[Decision]) -> list[tuple[int, int | None]]:
        """Say what was decided about each cloud that went in, given what was about each that came out.

        For each that went in: a number of ``decisions``, and the view that it was before views were merged, or None.

        Raises:
            ReplayError: the step joins or splits clouds and does not say how.
        """
        if self.takes is DepthFrame:
            return [(0, None)]
        if not self.keeps_clouds:
            raise ReplayError(f"{type(self).__name__}: joins or splits clouds; write its method origins to replay it")
        return [(number, None) for number in range(len(decisions))]

    def frame_needed(self) -> str | None:
        """The coordinate frame that the fields are written in, or None when any will do."""
        return None

    def frame_given(self) -> str | None:
        """The coordinate frame of the result, or None when it follows from the input's."""
        return None

    def frame_after(self, frame: str | None) -> str | None:
        """The frame of the result for an input in ``frame``; None = not known yet."""
        return self.frame_given() or self.frame_needed() or frame

    def unit_needed(self) -> str | None:
        """The unit that the fields' lengths are in, or None when no length is given: any will do."""
        if self.needs_metres:
            return METRE
        for name, unit in length_fields(type(self)).items():
            if self.__dict__[name] is not None:
                return unit
        return None

    def unit_given(self) -> str | None:
        """The unit of the result, or None when it is the input's."""
        return None

    def parts(self) -> list[Transform]:
        """The steps that do the work: those within a step that is made of others, else the step itself."""
        return [self]

    # -- what everybody calls --------------------------------------------------------------------------------------

    def forward(self, data: Any, *, generator: GeneratorLike | None = None) -> Any:
        """Run the step and record it in the history of every cloud.

        Args:
            data: a ``DepthFrame`` or ``PointCloud``, as the step takes.
            generator: required by random steps: one CPU generator, one per cloud, or streams.
        """
        if is_traced():
            return called_apart(Transform.forward, self, data, generator=generator)
        try:
            self.check_input(data)
            streams, drawn = self.no_streams, None
            if self.is_random:
                streams = Streams.of(self._generator(generator), num_clouds(data))
                drawn = streams.here()
            params = self.make_params(data, streams)
            result = self.transform(data, params)
            return self.recorded(data, result, params, drawn)
        except Exception as error:
            add_note(error, f"in {self!r} on {data!r}", step=type(self).__name__, sample_id=_sample_id(data))
            raise

    def replay(self, data: Any, history: Any) -> Any:
        """Repeat exactly what a history says was decided: draws, motions, planes, boxes, the rows that were chosen.

        On the data that it was decided on the result is the same, bit for bit, history and all. On others of the same
        capture (another camera's clouds in the same frame, other colors or labels, another mask) motions and regions
        are the same ones; a step that chose among rows needs rows that it comes to the same choice with.

        Args:
            data: what the chain takes.
            history: ``cloud.history`` of what came out, with as many clouds; or the history of one cloud, for all; or
                that of a capture, ``capture.provenance["history"]``. It may tell of other steps too. From a stored
                sample it is the same.

        Raises:
            ReplayError: the history is not of these steps, or a decision cannot be carried over to the data; the error
                says which.
        """
        return replayed_through(f"{type(self).__name__}.replay", self._steps_for(data), data, history)

    def _steps_for(self, data: Any) -> list[Transform]:
        """The steps that data of this kind go through."""
        return [self]

    def replayed(self, data: Any, decided: Decisions) -> Any:
        """Repeat what was decided, and record it as it was."""
        try:
            self.check_input(data)
            if inspect.unwrap(type(self).forward) is not Transform.forward:
                raise ReplayError(
                    f"{type(self).__name__}: has a forward of its own, which replaying would not run; write "
                    "replayed(self, data, decided) beside it"
                )
            params = self.repeat(data, decided)
            decided.check_rows(self.told_rows(data, params))
            drawn = decided.streams().here() if self.is_random else None
            result = self.recorded(data, self.transform(data, params), params, drawn)
            if isinstance(result, PointCloud):
                decided.check_place(result.frame_id, result.unit)
            return result
        except Exception as error:
            add_note(error, f"in {self!r} replayed on {data!r}", step=type(self).__name__, sample_id=_sample_id(data))
            raise

    def find_decision(self, entries: Sequence[Entry], stop: int) -> tuple[Decision, int] | None:
        """Return what this step decided, if entry ``stop - 1`` of a history is its, and where its first entry is."""
        entry, note = entries[stop - 1], self._note()
        if all(entry.get(name) == note[name] for name in ("step", "version", "fields")):
            return Decision(entry, stop - 1), stop - 1
        return None

    def told_rows(self, data: Any, params: Params) -> Sequence[int] | None:
        """Return a number per cloud that tells which rows were decided about; None where that needs no telling."""
        if not isinstance(data, PointCloud) or self.decides_by == "point":
            return None
        if self.decides_by == "count":
            return counts_of(data.ptr)
        return row_sums(params, data.ptr)

    def config_fields(self) -> dict[str, Any]:
        """Return the fields by name, as they were given."""
        return {name: getattr(self, name) for name in field_names(type(self))}

    def to_config(self) -> dict[str, dict[str, Any]]:
        """Return ``{name: fields}`` with plain values, the form that YAML holds."""
        return {type(self).__name__: _described(self.config_fields(), lambda step: step.to_config())}

    def fingerprint(self) -> str:
        """Return the SHA-256 of names, versions and fields: equal for equal behavior."""
        return sha256_of(self._identity())

    def _identity(self) -> Any:
        return [type(self).__name__, self.version, _described(self.config_fields(), lambda step: step._identity())]

    def __repr__(self) -> str:
        defaults = {f.name: f.default for f in dataclasses.fields(self)}  # type: ignore[arg-type]
        told = {name: value for name, value in self.config_fields().items() if value != defaults.get(name)}
        return f"{type(self).__name__}({', '.join(f'{name}={value!r}' for name, value in told.items())})"

    # -- the frame around make_params and transform --------------------------------------------------------------------

    def _generator(self, generator: GeneratorLike | None) -> GeneratorLike:
        if generator is None:
            raise ConfigError(
                f"{type(self).__name__} is random and needs generator=...: pass torch.Generator().manual_seed(seed), "
                "or put the step into a dataset, which keys one to every sample"
            )
        return generator

    def check_input(self, data: Any) -> None:
        """Require what the step takes, in the frame and the unit that its fields are written in."""
        name = type(self).__name__
        if not isinstance(data, self.takes):
            hint = "; put Deproject before it" if isinstance(data, DepthFrame) else ""
            raise DTypeError(f"{name} takes a {self.takes.__name__}, got {type(data).__name__}{hint}")
        if not isinstance(data, PointCloud):
            return
        needed = self.frame_needed()
        if needed is not None and data.frame_id != needed:
            raise FrameError(
                f"{name}: its fields are given in frame {needed!r} but the cloud is in {data.frame_id!r}; "
                f"add ToFrame(frame={needed!r}) before it"
            )
        unit = self.unit_needed()
        if unit is not None and data.unit != unit:
            lengths = "metres" if unit == METRE else "the unit of normalized clouds"
            found = "in metres" if data.unit == METRE else data.unit
            raise UnitError(
                f"{name}: its fields are lengths in {lengths} but the cloud is {found}; {unit_advice(self)}"
            )

    def recorded(self, data: Any, result: Any, params: Params, drawn: NDArray[np.int64] | None = None) -> Any:
        """Return the result of this step on the data with the step in its history.

        Args:
            data: what went in.
            result: what came out.
            params: what was decided.
            drawn: (B,) the streams as they were before a random step; see :meth:`Streams.here`.
        """
        rows = self.told_rows(data, params)
        if isinstance(result, DepthFrame):
            (step,) = NotedSteps(self._note(), read_in_histories(params, 1), drawn=drawn, rows=rows)
            return result.with_provenance({"history": [*result.provenance.get("history", ()), step]})
        before = counts_of(data.ptr) if isinstance(data, PointCloud) and self.keeps_clouds else None
        return self.recorded_counts(result, before, counts_of(result.ptr), params, drawn=drawn, rows=rows)

    def recorded_counts(
        self,
        result: PointCloud,
        before: list[int] | None,
        after: list[int],
        params: Params,
        *,
        drawn: NDArray[np.int64] | None = None,
        rows: Sequence[int] | None = None,
        place: tuple[str, str] | None = None,
    ) -> PointCloud:
        """Return the result with the step in its history, given the points per cloud before and after it.

        Args:
            result: what came out.
            before: points per cloud; None = they were other clouds.
            after: points per cloud.
            params: what was decided.
            drawn: as :meth:`recorded` takes it.
            rows: what :meth:`told_rows` gives.
            place: frame and unit after the step; None = those of the result.

        Raises:
            TooFewPointsError: a cloud has lost its last point, or never had one.
        """
        keeps = before is not None and len(before) == len(after)
        for b in [b for b, count in enumerate(after) if not count] if 0 in after else ():
            had = before[b] if before is not None and keeps else None
            if had == 0:
                continue
            if had is not None:
                raise TooFewPointsError(
                    f"{type(self).__name__}: nothing is left of cloud {b}{sample_name(result, b)}: "
                    f"0 of {had} points; check its fields against the cloud's extent and frame"
                )
            raise TooFewPointsError(
                f"{type(self).__name__}: cloud {b}{sample_name(result, b)} has no points: no reading, or steps "
                "before left none (masks, ranges, crops); leave the capture out, or widen those"
            )
        frame, unit = place or (result.frame_id, result.unit)
        note = {**self._note(), "frame": frame, "unit": unit}
        return result.with_steps(
            NotedSteps(note, read_in_histories(params, len(after)), before if keeps else None, after, drawn, rows)
        )

    def _note(self) -> dict[str, Any]:
        """The beginning of an entry in a history; not to be changed."""
        own = self.__dict__
        given = tuple(map(own.get, field_names(type(self))))
        before, note = own.get("_told", (None, {}))
        if before != given or self._modules:  # a field was set since, or may have been in a step within
            (told,) = self.to_config().values()
            note = {"step": type(self).__name__, "version": self.version, "fields": told}
            own["_told"] = given, note
        return note


def unit_advice(step: Transform) -> str:
    """What to do where a step's lengths are not in the unit of the cloud."""
    if step.unit_needed() != METRE:
        return "put it after normalizing, or leave unit out and give metres"
    own = ", or say unit: normalized if the length is meant in the normalized cloud"
    return f"put it before normalizing{own if 'unit' in field_names(type(step)) else ''}"


def num_clouds(data: Data) -> int:
    """The number of independent clouds: B of a cloud, 1 of a capture."""
    return data.num_clouds if isinstance(data, PointCloud) else 1


def _sample_id(data: Any) -> str | None:
    """The sample id of one capture or one cloud; None = it has none, or there are several clouds."""
    if isinstance(data, PointCloud):
        return meta_at_hand(data, 0).get("sample_id") if data.num_clouds == 1 else None
    return data.sample_id if isinstance(data, DepthFrame) else None


def sample_name(cloud: PointCloud, b: int) -> str:
    """Return `` (sample 'id')`` for messages, or nothing when the cloud has no sample id."""
    sample = meta_at_hand(cloud, b).get("sample_id")
    return f" (sample {sample!r})" if sample else ""


_LEAVES = {str, int, float, bool, type(None)}


def _described(fields: dict[str, Any], of_step: Callable[[Transform], Any]) -> dict[str, Any]:
    """Turn fields into what YAML and JSON hold, the steps among them as ``of_step`` says."""

    def plain(value: Any) -> Any:
        if isinstance(value, Transform):
            return of_step(value)
        if isinstance(value, (list, tuple, nn.ModuleList)):
            return [*value] if _LEAVES.issuperset(map(type, value)) else [plain(item) for item in value]
        return value

    return {name: value if type(value) in _LEAVES else plain(value) for name, value in fields.items()}


def sha256_of(identity: Any) -> str:
    """Return the SHA-256 of plain data."""
    text = json.dumps(identity, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()
