"""Imports go one way: every module imports only from the layers before its own."""

from __future__ import annotations

import ast
import sys
from functools import cache
from pathlib import Path

import pytest

import pcdata

ROOT = Path(pcdata.__file__).parent

# Each layer may import from those before it. Packages on one line are siblings: they do not import each other, unless
# ALLOWED_SIBLINGS says so.
LAYERS = [
    {"errors"},
    {"extras"},
    {"rng", "threads", "files", "registry", "progress"},
    {"contracts"},
    {"geometry"},
    {"functional"},
    {"kernels"},  # registers beside the functions, which load it by name when it is first asked for
    {"verdicts"},
    {"structures"},
    {"alignment", "sensors"},
    {"yaml_nodes"},
    {"yaml_paths"},
    {"io", "transforms", "synthetic"},
    {"imports"},
    {"datasets", "validation"},
    {"calibration", "models"},
    {"build"},  # datasets for a model are built by its preset
    {"exports"},  # holds samples to the contracts of models
    {"live"},
    {"report"},
    {"cli", "__main__"},
]
LEVEL = {name: level for level, names in enumerate(LAYERS) for name in names}
ALLOWED_SIBLINGS = {("__main__", "cli")}

# What may be imported besides pcdata and the standard library, by package; everywhere else nothing is limited here.
OUTSIDE = {
    "errors": set(),
    "extras": set(),
    "files": {"numpy"},
    "rng": {"torch", "numpy"},
    "threads": {"torch"},
    "contracts": {"torch", "numpy", "typing_extensions"},
    "geometry": {"torch", "numpy"},
    "functional": {"torch", "numpy"},
    "kernels": {"torch", "numpy"},
    "registry": set(),
    "progress": set(),
    "verdicts": set(),
    "structures": {"torch", "numpy"},
    "alignment": {"torch", "numpy"},
    "yaml_nodes": {"yaml"},
    "yaml_paths": {"yaml"},
}
OUTSIDE_OF_ONE_MODULE = {
    "kernels/torch_cluster.py": {"torch_cluster"},
    "functional/hulls.py": {"scipy"},  # hulls in space, when they are asked for
    "functional/boxes.py": {"scipy"},  # a search, likewise
}

MODULES = sorted(path.relative_to(ROOT).as_posix() for path in ROOT.rglob("*.py"))


def package_of(module: str) -> str:
    """The first name under pcdata: ``functional`` for ``functional/depth.py``, ``rng`` for ``rng.py``."""
    return module.split("/")[0].removesuffix(".py")


@cache
def parsed(module: str) -> ast.Module:
    return ast.parse((ROOT / module).read_text(encoding="utf-8"))


def imported_names(module: str, *, functions: bool = True, type_checking: bool = True) -> set[str]:
    """Absolute dotted names that a module imports, with or without what waits in functions or is for type checkers."""
    names = set()
    waiting: list[ast.AST] = [parsed(module)]
    while waiting:
        node = waiting.pop()
        if not functions and isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda)):
            continue
        if not type_checking and _is_for_type_checkers(node):
            continue
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{module}: relative imports hide the layer"
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
        waiting += ast.iter_child_nodes(node)
    return names


def _is_for_type_checkers(node: ast.AST) -> bool:
    return isinstance(node, ast.If) and "TYPE_CHECKING" in ast.dump(node.test)


def test_every_module_has_a_layer():
    packages = {package_of(module) for module in MODULES} - {"__init__"}
    assert packages == set(LEVEL)


@pytest.mark.parametrize("module", [name for name in MODULES if name != "__init__.py"])
def test_imports_come_from_the_layers_before(module):
    own = package_of(module)
    for name in imported_names(module):
        parts = name.split(".")
        if parts[0] != "pcdata" or len(parts) == 1:
            continue
        other = parts[1]
        if other not in LEVEL:  # from pcdata import __version__
            assert other.startswith("__") or LEVEL[own] >= LEVEL["report"], f"{module} imports {name} from the top"
        elif other != own and (own, other) not in ALLOWED_SIBLINGS:
            assert LEVEL[other] < LEVEL[own], f"{module} imports {name}: {other} is not before {own}"


@pytest.mark.parametrize("module", [name for name in MODULES if package_of(name) in OUTSIDE])
def test_the_lower_layers_need_torch_and_numpy_alone(module):
    allowed = OUTSIDE[package_of(module)] | OUTSIDE_OF_ONE_MODULE.get(module, set())
    outside = {name.split(".")[0] for name in imported_names(module)} - {"pcdata"} - set(sys.stdlib_module_names)
    assert outside <= allowed


def imported_modules() -> dict[str, set[str]]:
    """The modules of pcdata that each of them imports, at the top or inside a function, by dotted names."""
    paths = {f"pcdata/{name}".removesuffix(".py").removesuffix("/__init__").replace("/", "."): name for name in MODULES}
    imported: dict[str, set[str]] = {}
    for module, path in paths.items():
        names = imported_names(path, type_checking=False)
        # The last part is a module, or something out of the module before it.
        homes = {name if name in paths else name.rpartition(".")[0] for name in names}
        imported[module] = homes & paths.keys() - {module}
    return imported


def circles(imported: dict[str, set[str]]) -> list[set[str]]:
    """Sets of modules that reach each other."""
    reach = {module: _reachable(imported, module) for module in imported}
    found: list[set[str]] = []
    for module in sorted(imported):
        circle = {other for other in reach[module] if module in reach[other]}
        if circle and circle not in found:
            found.append(circle)
    return found


def _reachable(graph: dict[str, set[str]], start: str) -> set[str]:
    seen: set[str] = set()
    waiting = set(graph[start])
    while waiting:
        module = waiting.pop()
        seen.add(module)
        waiting |= graph[module] - seen
    return seen


def test_no_modules_import_each_other_in_a_circle():
    assert circles(imported_modules()) == []


def test_a_circle_is_found_through_any_number_of_modules():
    chain = {"a": {"b"}, "b": {"c"}, "c": {"b", "d"}, "d": set(), "e": {"f"}, "f": {"g"}, "g": {"e", "a"}}
    assert circles(chain) == [{"b", "c"}, {"e", "f", "g"}]


HEAVY = {"cv2", "small_gicp", "open3d", "torch_cluster", "matplotlib", "kornia", "scipy", "h5py", "pydantic"}


@pytest.mark.parametrize("module", MODULES)
def test_heavy_packages_are_imported_where_they_are_used(module):
    """io may load h5py and scipy with itself; nothing else loads a heavy package before it is called for."""
    loaded = {name.split(".")[0] for name in imported_names(module, functions=False, type_checking=False)}
    assert not loaded & (HEAVY - ({"h5py", "scipy", "pydantic"} if package_of(module) in {"io", "build"} else set()))


def test_numpy_and_torch_global_generators_are_never_drawn_from():
    for module in MODULES:
        text = (ROOT / module).read_text(encoding="utf-8").replace("open3d.utility.random.seed(", "")  # its only one
        for call in ("np.random.", "numpy.random.", "torch.manual_seed(", "import random\n", "random.seed("):
            assert call not in text, f"{module} uses {call}"
