"""What every capture layout offers: named samples, each loaded on demand."""

from __future__ import annotations

import copy
import inspect
from abc import ABC, ABCMeta, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, Protocol

from pcdata.errors import (
    CaptureError,
    DTypeError,
    NonFiniteError,
    NoPlaneError,
    PcdataError,
    PoseError,
    TooFewPointsError,
    UnitError,
    add_note,
    near_matches,
)  # fmt: skip
from pcdata.files.inputs import Inputs, recording
from pcdata.files.opening import check_inside
from pcdata.files.sample_names import check_names, check_text, in_order, name_some, same_but_for_writing
from pcdata.io.sources.listing import LinkTargets, absolute, is_folder, link_targets
from pcdata.structures import DepthFrame, PointCloud

# What is wrong with one capture, not with what is asked of all of them.
REFUSALS = (CaptureError, PoseError, UnitError, NonFiniteError, TooFewPointsError, NoPlaneError)


class CaptureSource(Protocol):
    """Anything with ids that loads a capture by id: a :class:`Source`, a synthetic one, one around another."""

    @property
    def ids(self) -> list[str]:
        """The sample ids, unique and in a fixed order."""

    def load(self, sample_id: str) -> DepthFrame | PointCloud:
        """Load one sample."""


def checked_ids(where: str, source: Any) -> list[str]:
    """Return the ids of a source that can be read as a whole.

    Raises:
        DTypeError: it is no source.
        CaptureError: it has no samples, two with one id, or an id that no file can hold.
    """
    if not hasattr(source, "ids") or not hasattr(source, "load"):
        raise DTypeError(
            f"{where}: source must have ids and load(id), got {type(source).__name__}; pcdata.open_source(path) makes "
            "one of a folder or file"
        )
    ids = list(source.ids)
    if not ids:
        raise CaptureError(f"{where}: {source!r} has no samples")
    if len(set(ids)) != len(ids):
        twice = next(name for name in ids if ids.count(name) > 1)
        raise CaptureError(f"{where}: {source!r}: sample ids must be unique, but {twice!r} comes more than once")
    check_text(where, ids)
    return ids


class _Recorded(ABCMeta):
    """Lets every source know which files were read to open it: its calibration, its lists."""

    def __call__(cls, *args: Any, **kwargs: Any) -> Any:
        inputs = Inputs()
        with recording(inputs):
            source = super().__call__(*args, **kwargs)
        source.inputs = inputs
        return source

    @property
    def __signature__(cls) -> inspect.Signature:
        """What the class takes: of ``__call__`` above, inspect would see no option by its name."""
        _, *parameters = inspect.signature(cls.__init__).parameters.values()  # type: ignore[misc]
        return inspect.Signature(parameters)


def inputs_of(source: Any) -> Inputs:
    """Return what was read to open a source, and the sources that it is made of."""
    found = Inputs()
    if isinstance(own := getattr(source, "inputs", None), Inputs):
        found.add(own)
    within = [getattr(source, "source", None), *getattr(source, "sources", ())]
    for inner in within:
        if inner is not None and inner is not source:
            found.add(inputs_of(inner))
    return found


class Source(ABC, metaclass=_Recorded):
    """The samples of one capture: unique ids in the order that a person counts in, and a loader.

    A source holds paths and numbers only, no open file, so it can be pickled, sent to workers and used by many at once.
    Building one reads names and calibration, never an image.
    """

    kind: ClassVar[str]  # how open_source(kind=...) calls the layout
    needs: ClassVar[str]  # the layout in words, for error messages
    inputs: Inputs  # the files that were read to open it

    def __init__(self, path: Path, ids: Iterable[str], links_to: LinkTargets = ()) -> None:
        """Take the ids.

        Args:
            path: the folder or file.
            ids: of the samples, in any order.
            links_to: folders outside, one or several, that links in the capture may lead to, such as the store of a
                DataLad or DVC checkout.

        Raises:
            CaptureError: there is no sample, or two names cannot be told apart.
        """
        self.path = absolute(path)
        self.links_to = link_targets(links_to)
        self._ids = in_order(ids)
        self._known = frozenset(self._ids)
        self.skipped: dict[str, str] = {}  # id -> why it was left out; see without
        if not self._ids:
            raise CaptureError(f"{self}: no sample found; this layout needs {self.needs}")
        check_names(str(self), self._ids)

    @classmethod
    @abstractmethod
    def recognises(cls, path: Path) -> bool:
        """Say whether the exact signs of this layout are there; must not raise for any path."""

    @abstractmethod
    def files(self, sample_id: str) -> dict[str, Path]:
        """Return the files of one sample by role, e.g. ``{"depth": ..., "color": ...}``; a cache may hash them."""

    def depth_files(self, sample_id: str) -> list[Path]:
        """Return the depth images of one sample, one for each view; none where depth is no file of its own."""
        files = self.files(sample_id)
        return [files["depth"]] if "depth" in files else []

    def check_links(self, sample_id: str) -> None:
        """Require that the files of a sample lie in the capture, or in a folder of ``links_to``, links followed.

        Raises:
            CaptureError: one leads elsewhere.
        """
        if is_folder(self.path):  # a file that the user named may be a link to anywhere
            for file in self.files(sample_id).values():
                check_inside(str(self), file, [self.path, *self.links_to])

    @abstractmethod
    def _load(self, sample_id: str) -> DepthFrame | PointCloud:
        """Load one known sample."""

    def unread(self) -> list[str]:
        """Say in words what lies in the capture but is not read, one line for each; nothing of it is an error."""
        return []

    @property
    def name(self) -> str:
        """The name of the folder or file."""
        return self.path.name

    @property
    def ids(self) -> list[str]:
        """The sample ids, unique, in the order of the numbers in them."""
        return list(self._ids)

    def load(self, sample_id: str) -> DepthFrame | PointCloud:
        """Read one sample.

        Raises:
            CaptureError, UnitError, PoseError, ShapeError: the sample is unknown or cannot be trusted, and why.
        """
        if sample_id not in self._known:
            raise CaptureError(f"{self}: no sample {sample_id!r}{near_matches(str(sample_id), self._ids)}")
        try:
            self.check_links(sample_id)
            return self._load(sample_id)
        except PcdataError as error:
            add_note(error, f"while loading sample {sample_id!r} of {self}")
            raise

    def subset(self, ids: Sequence[str]) -> Source:
        """Return the same source with some of its samples only, in the order that they have here."""
        unknown = set(ids) - self._known
        if unknown or not ids:
            raise CaptureError(f"{self}: subset needs ids of this source, got {name_some(unknown) or 'none'}")
        smaller = copy.copy(self)
        smaller._known = frozenset(ids)
        smaller._ids = [sample_id for sample_id in self._ids if sample_id in smaller._known]
        return smaller

    def without(self, ids: Iterable[str] | Mapping[str, str]) -> Source:
        """Return the same source without some of its samples; ``skipped`` tells which, and why.

        Args:
            ids: the samples to leave out, as from a list of bad frames, or with the reason of each, as
                :func:`refused_captures` returns them.

        Raises:
            CaptureError: one is no sample of this source, or none is left.
        """
        if isinstance(ids, (str, bytes)):
            raise DTypeError(f"{self}: without takes a list of ids, got the text {ids!r:.100}; put it into a list")
        reasons = {**ids} if isinstance(ids, Mapping) else dict.fromkeys(ids, "listed")
        unknown = [str(sample_id) for sample_id in reasons if sample_id not in self._known]
        if unknown:
            hint = near_matches(unknown[0], self._ids)
            raise CaptureError(f"{self}: cannot leave out {name_some(unknown)}, which it does not have{hint}")
        left = [sample_id for sample_id in self._ids if sample_id not in reasons]
        if not left:
            reason = next(iter(reasons.values()))
            raise CaptureError(f"{self}: nothing is left when {len(reasons)} samples are left out ({reason})")
        smaller = self.subset(left)
        smaller.skipped = {**self.skipped, **reasons}
        return smaller

    def provenance(self, sample_id: str) -> dict[str, Any]:
        """Return JSON-able facts on where a sample came from: layout, folder, file names within it."""
        root = self.path if self.path.is_dir() else self.path.parent
        files = {role: file.relative_to(root).as_posix() for role, file in self.files(sample_id).items()}
        return {"source": self.kind, "root": self.name, "files": files}

    def __len__(self) -> int:
        return len(self._ids)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({str(self.path)!r}, {len(self._ids)} samples)"

    def __str__(self) -> str:
        return f"{self.kind} source {self.path}"


def refused_captures(source: CaptureSource) -> dict[str, str]:
    """Load every capture once and return those that are refused, with the reason of each.

    ``source.without(refused_captures(source))`` is the source that loads throughout.
    """
    refused = {}
    for sample_id in checked_ids("refused_captures", source):
        try:
            source.load(sample_id)
        except REFUSALS as error:
            refused[sample_id] = reason_of(error)
    return refused


def skipped_of(source: Any) -> dict[str, str]:
    """Return what was left out of a source, or of the one that it is made around: id -> why."""
    skipped: dict[str, str] = {}
    while source is not None:
        skipped |= getattr(source, "skipped", {})
        source = getattr(source, "source", None)
    return skipped


def reason_of(error: PcdataError) -> str:
    """Return why a capture was refused, in one line."""
    return f"{type(error).__name__}: {str(error).splitlines()[0]}"


def check_partners(where: str, ids: Iterable[str], partners: Mapping[str, Iterable[str]]) -> None:
    """Require every role that is present at all to be present for exactly the given ids."""
    wanted = set(ids)
    faults = []
    for role, present in partners.items():
        missing, spare = wanted - set(present), set(present) - wanted
        if missing:
            faults.append(f"{role} is missing for {name_some(missing)}")
        if spare:
            faults.append(f"there is {role} but no depth for {name_some(spare)}")
        if missing and spare:
            faults[-1] += same_but_for_writing(missing, spare)
    if faults:
        raise CaptureError(f"{where}: every sample needs the same files: {'; '.join(faults)}")
