"""The short script that every built dataset carries: it loads the dataset it lies in."""

from __future__ import annotations

from pcdata.build.config import Loader

_TEMPLATE = '''"""Load this dataset, batch by batch: python load.py"""

from pathlib import Path

from torch.utils.data import DataLoader

from pcdata import CachedCloudDataset, collate_{collate}


def main() -> None:
    dataset = CachedCloudDataset(Path(__file__).parent, seed={seed})
    loader = DataLoader(
        dataset,
        batch_size={batch_size},
        shuffle=True,
        num_workers={num_workers},
        collate_fn=collate_{collate},
    )
    for epoch in range(2):
        dataset.set_epoch(epoch)  # new random draws for every epoch, the same for any number of workers
        for batch in loader:
            print(f"epoch {{epoch}}: {{batch}}, points {{tuple(batch.points.shape)}}")


if __name__ == "__main__":  # workers may import this file
    main()
'''


def loading_script(loader: Loader) -> str:
    """Return the script's text with the loader's settings filled in."""
    return _TEMPLATE.format(**loader.model_dump())
