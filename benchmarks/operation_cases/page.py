"""docs/speed.md: the kept results of operations.py as a page, losses first."""

from __future__ import annotations

from pathlib import Path
from typing import Any

PAGE = Path(__file__).parents[2] / "docs" / "speed.md"

HEAD = """# How fast the operations are, and where others are faster

Written by `python benchmarks/operations.py` from one run on {cores} cores with {threads} threads; the operations of the
README's table are timed by `--frame`. Each peer ran in the same process, in turn with ours; "NumPy", "torch" and "SciPy
and NumPy" are the usual recipes there, where no package on PyPI has the operation. A ratio above 1 means we are faster.
Not installed, so not compared: {left_out}.

What has no compiled body runs in torch: the inversion of f-theta and tilted lenses (their rays and maps are kept by
camera), normals of depth images, features of covariances, and whatever carries a gradient beyond voxels, distances and
covariances of neighbors.
"""


def page(result: dict[str, Any]) -> str:
    """The whole page."""
    machine = result["machine"]
    left_out = ", ".join(result["left_out"]) or "none"
    head = HEAD.format(cores=machine["cores"], threads=machine["threads"], left_out=left_out)
    lost = [row for row in result["rows"] if row["ratio"] < 1]
    parts = [head, "## Slower than a peer\n", table(lost) if lost else "None in this run.", ""]
    parts += ["## All\n", table(result["rows"]), ""]
    parts += ["## Many small clouds in one call\n", "The same 500,000 points, as 10,000 clouds of 50 and as one.\n"]
    parts += ["| operation | 10,000 clouds | one cloud |", "|---|---|---|"]
    parts += [f"| {row['operation']} | {row['many_ms']:.1f} ms | {row['one_ms']:.1f} ms |" for row in result["ragged"]]
    return "\n".join(parts) + "\n"


def table(rows: list[dict[str, Any]]) -> str:
    """Rows of measurements in Markdown, as in the README."""
    lines = ["| operation | points | pcdata | peer | ratio | results |", "|---|---|---|---|---|---|"]
    for row in rows:
        ratio = f"{row['ratio']:,.0f}x" if row["ratio"] >= 100 else f"{row['ratio']:.1f}x"
        lines.append(
            f"| {row['operation']} | {row['points']:,} | {row['pcdata_ms']:.1f} ms | {row['peer']} "
            f"{row['peer_ms']:,.0f} ms | {ratio} | {row['results']} |"
        )
    return "\n".join(lines)
