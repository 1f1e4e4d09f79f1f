"""The tables of docs/fusion.md, written from results/fusion.json."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

PAGE = Path(__file__).parents[1] / "docs" / "fusion.md"
GROWING = "pcdata, growing"  # without room beforehand, where pcdata has it
CAUSES = {
    "same": "the same readings",
    "free": "free space too",
    "missed": "fewer readings",
}


_END = "<!-- end -->"
LENGTHS = ("voxel", "truncation", "frames")


def tables(result: dict[str, Any]) -> dict[str, str]:
    """Every table, as Markdown, by the name that it has on the page."""
    return {name: make(result) for name, make in _TABLES.items()}


def update_page(result: dict[str, Any]) -> None:
    """Put the tables where the page has their names."""
    text = PAGE.read_text(encoding="utf-8")
    for name, table in tables(result).items():
        before, _, after = _parted(text, name)
        text = before + table + after
    PAGE.write_text(text, encoding="utf-8")


def shown(name: str) -> str:
    """The table of that name that the page has now."""
    return _parted(PAGE.read_text(encoding="utf-8"), name)[1]


def _parted(text: str, name: str) -> tuple[str, str, str]:
    """The page before, in and after a table."""
    start = f"<!-- table: {name} -->\n"
    before, found, rest = text.partition(start)
    table, ended, after = rest.partition(_END)
    if not found or not ended or start in after:
        raise ValueError(f"{PAGE} must have one table named {name!r}, from {start.strip()} to {_END}")
    return before + start, table, _END + after


def _machine(result: dict[str, Any]) -> str:
    header = ["cores", "processor", "load average at the start", *result["versions"]]
    machine = result["machine"]
    cells = [str(machine["cores"]), machine["processor"], f"{machine['load']:.1f}"]
    return _markdown(header, [[*cells, *result["versions"].values()]])


def _truth(result: dict[str, Any]) -> str:
    columns: dict[str, Callable[[dict[str, Any]], str]] = {
        "views": lambda row: str(row["views"]),
        "noise": lambda row: row["noise"],
        "mean error": lambda row: f"{row['mean error, mm']:.2f} mm",
        "of the best view alone": lambda row: f"{row['best single view, mean error, mm']:.2f} mm",
        "without carving": lambda row: f"{row['no carving, mean error, mm']:.2f} mm",
        "covered within 4 mm": lambda row: f"{100 * row['covered within 4 mm']:.2f} %",
        "median normal error on the table": lambda row: f"{row['median normal error, degrees']:.1f} degrees",
        "labels right away from contacts": lambda row: f"{100 * row['labels right away from contacts']:.2f} %",
    }
    return _markdown(list(columns), [[cell(row) for cell in columns.values()] for row in result["truth"]])


def _workspace(result: dict[str, Any]) -> str:
    row = result["workspace"]
    header = ["captures", "the first", "each that follows", "extraction", "stored voxels"]
    cells = [row["captures"], f"{row['first ms']:.0f} ms", f"{row['median ms']:.0f} ms"]
    return _markdown(header, [[*cells, f"{row['extract ms']:.0f} ms", f"{row['MiB']:.0f} MiB"]])


def _speed(runs: list[dict[str, Any]]) -> str:
    header = [*LENGTHS, "library", "a frame", "on two threads", "extraction", "on two threads"]
    rows = []
    for run in runs:
        for name in run["libraries"]:
            one, two = run["libraries"], run["two threads"]
            cells = [_against(one, name, "cpu ms", "{:.0f} ms"), _against(two, name, "wall ms", "{:.0f} ms")]
            cells += [
                _against(one, name, "extract cpu s", "{:.2f} s"),
                _against(two, name, "extract wall s", "{:.2f} s"),
            ]
            rows.append([*_lengths(run), name, *cells])
    return _markdown(header, rows)


def _again(runs: list[dict[str, Any]]) -> str:
    header = [*LENGTHS, "library", "a frame", "on two threads"]
    rows = []
    for run in runs:
        one, two = run["again"]["1"], run["again"]["2"]
        for name in one:
            cells = [_against(one, name, "cpu ms", "{:.0f} ms"), _against(two, name, "wall ms", "{:.0f} ms")]
            rows.append([*_lengths(run)[:2], "10", name, *cells])
    return _markdown(header, rows)


def _memory(runs: list[dict[str, Any]]) -> str:
    header = [*LENGTHS, "library", "stored voxels", "the process grows by", "and extracting"]
    rows = []
    for run in runs:
        for name, row in run["memory"].items():
            known = [kind for kind in ("stored MiB", "peak MiB", "peak extracting MiB") if row[kind] is not None]
            cells = [_against(run["memory"], name, kind, "{:.0f} MiB") for kind in known]
            rows.append([*_lengths(run), name, *([""] * (3 - len(cells))), *cells])
    return _markdown(header, rows)


def _agreement(runs: list[dict[str, Any]]) -> str:
    header = [*LENGTHS, "pcdata", "a quarter voxel", "ours to theirs", "theirs to ours"]
    header += ["our points", "theirs"]
    rows = []
    for run in runs:
        for name, row in run["apart"].items():
            apart = [_length(row[f"{way}, mm"]) for way in ("ours to theirs", "theirs to ours")]
            counts = [f"{row[kind] / 1e6:.2f} million" for kind in ("points", "Open3D points")]
            setting = "without carving" if "carving" in name else "as it is"
            rows.append([*_lengths(run), setting, f"{run['voxel mm'] / 4:.2f} mm", *apart, *counts])
    return _markdown(header, rows)


def _causes(runs: list[dict[str, Any]]) -> str:
    header = [*LENGTHS, "Open3D averaged, next to the point", "points of pcdata"]
    header += ["Open3D has one on the same edge", "median distance to Open3D's nearest"]
    rows = []
    for run in runs:
        for name, words in CAUSES.items():
            shares = [f"{100 * run['causes'][f'{name}, {kind}']:.1f} %" for kind in ("share", "Open3D crosses")]
            rows.append([*_lengths(run), words, *shares, _length(run["causes"][f"{name}, mm"])])
    return _markdown(header, rows)


def _predicted(runs: list[dict[str, Any]]) -> str:
    header = [*LENGTHS, "points with the distances and weights that Open3D stores"]
    return _markdown(header, [[*_lengths(run), f"{100 * run['causes']['predicted']:.1f} %"] for run in runs])


def _against(rows: dict[str, dict[str, Any]], name: str, kind: str, form: str) -> str:
    """A value, and how many times that of pcdata it is."""
    value, ours = rows[name][kind], rows["pcdata"][kind]
    return form.format(value) + ("" if name == "pcdata" else f" ({value / ours:.1f}x)")


def _lengths(run: dict[str, Any]) -> list[str]:
    return [f"{run['voxel mm']:g} mm", f"{run['truncation voxels']:g} voxels", str(run["frames"])]


def _length(millimetres: float) -> str:
    return f"{millimetres:.2f} mm" if millimetres >= 0.005 else "under 0.01 mm"


def _markdown(header: list[str], rows: list[list[str]]) -> str:
    return "".join("| " + " | ".join(line) + " |\n" for line in (header, ["---"] * len(header), *rows))


_TABLES: dict[str, Callable[[dict[str, Any]], str]] = {
    "machine": _machine,
    "truth": _truth,
    "workspace": _workspace,
    "speed": lambda result: _speed(result["recording"]),
    "again": lambda result: _again(result["recording"]),
    "memory": lambda result: _memory(result["recording"]),
    "legacy speed": lambda result: _speed(result["legacy"]),
    "legacy memory": lambda result: _memory(result["legacy"]),
    "agreement": lambda result: _agreement(result["recording"]),
    "predicted": lambda result: _predicted(result["recording"]),
    "causes": lambda result: _causes(result["recording"]),
}
