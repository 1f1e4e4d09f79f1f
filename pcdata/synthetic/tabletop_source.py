"""Many tabletop scenes as a source of captures."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from pcdata.errors import ConfigError
from pcdata.files.sample_names import check_known
from pcdata.structures import DepthFrame
from pcdata.structures.captures import Captures
from pcdata.synthetic.stereo_camera import SensorNoise, noise_named
from pcdata.synthetic.tabletop import Tabletop, tabletop
from pcdata.synthetic.viewpoints import Miscalibration


@dataclass(frozen=True, kw_only=True)
class SyntheticSource(Captures):
    """``num_scenes`` tabletop captures; scene i is ``tabletop(seed + i, ...)``, rendered when it is loaded.

    Holds only these numbers, so it pickles to any worker and loads the same bytes there.
    """

    num_scenes: int
    seed: int = 0
    num_objects: int = 5
    num_views: int = 1
    noise: SensorNoise | str | None = None
    size: tuple[int, int] = (480, 640)
    miscalibration: Miscalibration | None = None
    floor: bool = True
    name: str = "tabletop"

    def __post_init__(self) -> None:
        noise_named(self.noise)  # an unknown name is an error here, not in a worker later
        if self.num_scenes < 0 or self.seed < 0:
            raise ConfigError(f"SyntheticSource: needs num_scenes and seed >= 0, got {self.num_scenes}, {self.seed}")

    @property
    def ids(self) -> list[str]:
        """The sample ids in order, ``<name>-<seed of the scene>``."""
        width = max(4, len(str(self.seed + self.num_scenes - 1)))  # equal widths: text order is number order
        return [f"{self.name}-{self.seed + index:0{width}d}" for index in range(self.num_scenes)]

    def __len__(self) -> int:
        return self.num_scenes

    def load(self, sample_id: str) -> DepthFrame:
        """Render one capture.

        Raises:
            CaptureError: no scene has this id.
        """
        return self.scene(sample_id).frame

    def scene(self, sample_id: str) -> Tabletop:
        """Render one capture and keep the truth with it.

        Raises:
            CaptureError: no scene has this id.
        """
        ids = self.ids
        check_known(f"SyntheticSource {self.name!r}", sample_id, ids)
        return tabletop(
            self.seed + ids.index(sample_id),
            self.num_objects,
            self.num_views,
            noise=self.noise,
            size=self.size,
            miscalibration=self.miscalibration,
            floor=self.floor,
            sample_id=sample_id,
        )


def tabletop_frames(
    num_scenes: int,
    seed: int = 0,
    *,
    num_objects: int = 5,
    num_views: int = 1,
    noise: SensorNoise | str | None = None,
    size: tuple[int, int] = (480, 640),
) -> Iterator[DepthFrame]:
    """Yield the captures of scenes ``seed``, ``seed + 1``, ..."""
    source = SyntheticSource(
        num_scenes=num_scenes, seed=seed, num_objects=num_objects, num_views=num_views, noise=noise, size=size
    )
    return (source.load(sample_id) for sample_id in source.ids)
