"""The writers that come with pcdata, in the order that help texts and messages list them."""

# isort: off
from pcdata.io.writers import (  # noqa: F401
    capture_folder,
    mcap,
    lerobot,
)

# isort: on
from pcdata.io.writers.registry import WRITERS

__all__ = ["WRITERS"]
