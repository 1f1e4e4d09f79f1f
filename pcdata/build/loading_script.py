"""The short script that every built dataset carries: it loads the dataset it lies in."""

from __future__ import annotations

from collections.abc import Sequence

import pcdata.datasets
from pcdata.build.config import Loader
from pcdata.datasets.collate import COLLATES
from pcdata.models import Preset

_TEMPLATE = '''"""Load this dataset, batch by batch: python load.py{usage}"""

{argparse}{functools}from pathlib import Path

from torch.utils.data import DataLoader

from pcdata import CachedCloudDataset, {names}


def main() -> None:
{imports}    dataset = CachedCloudDataset(Path(__file__).parent, seed={seed}{split})
{preset}    loader = DataLoader(
        {samples},
        batch_size={batch_size},
        shuffle=True,
        num_workers={num_workers},
        collate_fn={collate},
    )
    for epoch in range(2):
        {samples}.set_epoch(epoch)  # new random draws for every epoch, the same for any number of workers
        for batch in loader:
            print(f"epoch {{epoch}}: {{batch}}{shapes}")


if __name__ == "__main__":  # workers may import this file
    main()
'''
_IMPORTS = """    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--import", dest="files", action="append", default=[], metavar="FILE.py", help={files!r})
    files = parser.parse_args().files
    if not files:
        parser.error({missing!r})
    for file in files:
        import_file(file)
"""


def loading_script(loader: Loader, made: Preset | None = None, imports: Sequence[str] = ()) -> str:
    """Return the script's text.

    Args:
        loader: the settings that are filled in.
        made: the preset of the model that the dataset was built for: batches are the model's tensors.
        imports: names of the files that define steps of the dataset: the script asks for their paths.
    """
    settings = loader.model_dump(exclude={"collate", "buckets", "windows"})
    settings["split"] = "" if loader.split is None else f", split={loader.split!r}"
    settings |= {"usage": "", "argparse": "", "functools": "", "imports": "", "samples": "dataset"}
    if imports:
        files = ", ".join(imports)
        missing = f"this dataset has steps of its own; say where they are: --import FILE.py, for {files}"
        code = _IMPORTS.format(files=files.replace("%", "%%"), missing=missing)
        settings |= {"usage": " --import FILE.py", "argparse": "import argparse\n", "imports": code}
    if made is None:
        name = collate = COLLATES[loader.collate].__name__
        if not hasattr(pcdata.datasets, name):  # one of the user's own
            name, collate = "COLLATES", f"COLLATES[{loader.collate!r}]"
        if loader.buckets:
            settings["functools"] = "from functools import partial\n"
            collate = f"partial({collate}, buckets={loader.buckets!r})"
        shapes = ", points {tuple(batch.points.shape)}"
        line, names = "", [name]
        if loader.windows is not None:
            said = ", ".join(f"{key}={value!r}" for key, value in loader.windows.model_dump().items())
            line = f"    windows = EpisodeWindows(dataset, {said})\n"
            names.append("EpisodeWindows")
            settings["samples"] = "windows"
        shown = _names(names, imports)
        return _TEMPLATE.format(**settings, names=shown, collate=collate, preset=line, shapes=shapes)
    line = f"    model = {made!r}  # what the dataset was built for\n"
    shown = _names(["preset"], imports)
    return _TEMPLATE.format(**settings, names=shown, collate="model.collate", preset=line, shapes="")


def _names(names: Sequence[str], imports: Sequence[str]) -> str:
    return ", ".join(sorted([*names, *(["import_file"] if imports else [])]))
