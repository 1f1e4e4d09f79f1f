"""The short script that every built dataset carries: it loads the dataset it lies in."""

from __future__ import annotations

from pcdata.build.config import Loader
from pcdata.models import Preset

_TEMPLATE = '''"""Load this dataset, batch by batch: python load.py"""

from pathlib import Path

from torch.utils.data import DataLoader

from pcdata import CachedCloudDataset, {name}


def main() -> None:
    dataset = CachedCloudDataset(Path(__file__).parent, seed={seed})
{preset}    loader = DataLoader(
        dataset,
        batch_size={batch_size},
        shuffle=True,
        num_workers={num_workers},
        collate_fn={collate},
    )
    for epoch in range(2):
        dataset.set_epoch(epoch)  # new random draws for every epoch, the same for any number of workers
        for batch in loader:
            print(f"epoch {{epoch}}: {{batch}}{shapes}")


if __name__ == "__main__":  # workers may import this file
    main()
'''


def loading_script(loader: Loader, made: Preset | None = None) -> str:
    """Return the script's text with the loader's settings filled in; a model's dataset gives the model's tensors."""
    settings = loader.model_dump(exclude={"collate"})
    if made is None:
        name = collate = f"collate_{loader.collate}"
        return _TEMPLATE.format(
            **settings, name=name, collate=collate, preset="", shapes=", points {tuple(batch.points.shape)}"
        )
    line = f"    model = {made!r}  # what the dataset was built for\n"
    return _TEMPLATE.format(**settings, name="preset", collate="model.collate", preset=line, shapes="")
