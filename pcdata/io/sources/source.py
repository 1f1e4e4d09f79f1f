"""What every capture layout offers: named samples, each loaded on demand."""

from __future__ import annotations

import copy
import inspect
from abc import ABCMeta, abstractmethod
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, ClassVar

from pcdata.errors import CaptureError, PcdataError, add_note
from pcdata.files.inputs import Inputs, recording
from pcdata.files.opening import check_inside
from pcdata.files.sample_names import check_known, check_names, in_order, name_some, same_but_for_writing
from pcdata.io.sources.capture_source import CaptureSource
from pcdata.io.sources.combine import CombinedSource, Selectable
from pcdata.io.sources.episode_file import EPISODES, read_episodes
from pcdata.io.sources.listing import LinkTargets, absolute, has_file, is_folder, link_targets
from pcdata.structures import DepthFrame, Episode, PointCloud
from pcdata.structures.episodes import kept_episodes


class _Recorded(ABCMeta):
    """Lets every source know its episodes, and which files were read to open it: its calibration, its lists."""

    def __call__(cls, *args: Any, **kwargs: Any) -> Any:
        inputs = Inputs()
        with recording(inputs):
            source = super().__call__(*args, **kwargs)
            source._episodes = source._read_episodes()
        source.inputs, source.given = inputs, (args[1:], kwargs)
        return source

    @property
    def __signature__(cls) -> inspect.Signature:
        """What the class takes: of ``__call__`` above, inspect would see no option by its name."""
        _, *parameters = inspect.signature(cls.__init__).parameters.values()  # type: ignore[misc]
        return inspect.Signature(parameters)


class Source(Selectable["Source"], metaclass=_Recorded):
    """The samples of one capture: unique ids in the order that a person counts in, and a loader.

    A source holds paths and numbers only, no open file, so it can be pickled, sent to workers and used by many at once.
    Building one reads names and calibration, never an image.
    """

    kind: ClassVar[str]  # how open_source(kind=...) calls the layout
    needs: ClassVar[str]  # the layout in words, for error messages
    is_one_recording: ClassVar[bool] = (
        False  # the samples follow each other in time: one episode, unless said otherwise
    )
    inputs: Inputs  # the files that were read to open it
    given: tuple[tuple[Any, ...], dict[str, Any]]  # what it was made with besides the path: how captures are read
    _episodes: list[Episode]

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
        self._skipped: dict[str, str] = {}
        if not self._ids:
            raise CaptureError(f"{self}: no sample found; this layout needs {self.needs}")
        check_names(str(self), self._ids)

    def _read_episodes(self) -> list[Episode]:
        file = self.path / EPISODES
        if not is_folder(self.path) or not has_file(file):
            times = self._times() if self.is_one_recording else {}
            return (
                [Episode(self._printable_name(), 0, len(self._ids), [*times.values()])] if self.is_one_recording else []
            )
        check_inside(str(self), file, [self.path, *self.links_to])
        return read_episodes(file, self._ids, self._times())

    def _printable_name(self) -> str:
        """Return the name of the folder or file without suffix; what of it is no text, which a disk allows, as _."""
        return "".join(sign if sign.isprintable() else "_" for sign in self.path.stem) or "recording"

    def _times(self) -> Mapping[str, float]:
        """Return the seconds of every sample by id, or nothing where they are not known."""
        return {}

    @classmethod
    @abstractmethod
    def recognizes(cls, path: Path) -> bool:
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

    @classmethod
    def glance(cls, path: Path) -> list[str]:
        """Say in words what lies at a path of this layout, for who cannot open it yet; must not raise for any path."""
        return []

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

    @property
    def episodes(self) -> list[Episode]:
        """The episodes in the order of the ids, as ``episodes.json`` in the folder says.

        Without that file a capture that is one recording is one episode, and any other has none. Where samples were
        left out of one, what remains is cut there.
        """
        return list(self._episodes)

    def times(self) -> dict[str, float]:
        """Return the seconds of the samples by id, as far as they are known."""
        return {name: time for name, time in self._times().items() if name in self._known}

    @property
    def skipped(self) -> dict[str, str]:
        """What was left out: id -> why; see :meth:`without`."""
        return dict(self._skipped)

    def load(self, sample_id: str) -> DepthFrame | PointCloud:
        """Read one sample.

        Raises:
            CaptureError, UnitError, PoseError, ShapeError: the sample is unknown or cannot be trusted, and why.
        """
        check_known(str(self), sample_id, self._known)
        try:
            self.check_links(sample_id)
            return self._load(sample_id)
        except PcdataError as error:
            add_note(error, f"while loading sample {sample_id!r} of {self}", sample_id=sample_id, path=self.path)
            raise

    def _part(self, ids: list[str], skipped: Mapping[str, str]) -> Source:
        smaller = copy.copy(self)
        smaller._ids, smaller._known = ids, frozenset(ids)
        smaller._episodes = kept_episodes(
            self._episodes, [place for place, name in enumerate(self._ids) if name in smaller._known]
        )
        smaller._skipped, smaller.opened = {**self._skipped, **skipped}, {}
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


def stored_captures(source: CaptureSource, sample_id: str) -> list[tuple[Source, str]]:
    """Return the captures on disk that a sample is made of, by their layouts and ids; none of a synthetic one.

    Raises:
        CaptureError: no sample has this id.
    """
    if isinstance(source, Source):
        return [(source, sample_id)]
    made_of = source.made_of(sample_id) if isinstance(source, CombinedSource) else []
    return [stored for inner, own in made_of for stored in stored_captures(inner, own)]


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
        raise CaptureError(
            f"{where}: every sample needs the same files: {'; '.join(faults)}; add what is missing, or move "
            "what has no partners out"
        )
