"""Write the argument types of the core's functions, for ctypes, from the one header that declares them.

Run ``python pcdata/kernels/core/write_signatures.py`` after a change of ``pc/exports.hpp``; a test compares.
"""

from __future__ import annotations

import hashlib
import re
import textwrap
from pathlib import Path

_FOLDER = Path(__file__).parent
HEADER = _FOLDER / "pc" / "exports.hpp"
SIGNATURES = _FOLDER.parent / "cpu" / "signatures.py"

_HEAD = '''"""The functions of the compiled core, with the types of their arguments after the context that all take.

Written by core/write_signatures.py from core/pc/exports.hpp, which says what they do.
"""

# A hash of the declarations, which a library built from them has in it.
INTERFACE_NUMBER = {number}

DECLARATIONS = """
{declarations}
"""
'''


def render(header: str) -> str:
    """Return the module that describes these declarations.

    Raises:
        ValueError: an argument is of a type that Python has no way to give.
    """
    code = " ".join(re.sub(r"//[^\n]*", "", header).split())
    lines = []
    for result, name, arguments in re.findall(r"PC_EXPORT (\w+) (pc_\w+)\(([^)]*)\);", code):
        first, *rest = arguments.split(", ") if arguments else [""]
        if first != "const pc_context* context":
            continue  # asked about the library itself: native.py knows these
        if result != "int32_t":
            raise ValueError(f"{name}: a function that takes a context returns a status, int32_t, not {result}")
        declared = f"{name}: {', '.join(_argument(name, one) for one in rest)}"
        lines.append(textwrap.fill(declared, 120, subsequent_indent="    ", break_long_words=False))
    return _HEAD.format(number=interface_number(code), declarations="\n".join(lines))


def interface_number(code: str) -> str:
    """Return the hash of declarations without comments and line breaks, as CMakeLists.txt computes it."""
    return "0x" + hashlib.sha256(code.encode()).hexdigest()[:15].upper()


def _argument(function: str, declaration: str) -> str:
    """Return "int64* rows" for "const int64_t* rows"; a pointer to pointers is an array of addresses."""
    match = re.fullmatch(r"(?:const )?(int64_t|int32_t|uint8_t|float|double|bool)(\*?(?: const\*)?) (\w+)", declaration)
    if match is None or (not match[2] and match[1] not in ("int64_t", "double")):
        raise ValueError(f"{function}: arguments are int64_t, double or pointers to plain numbers, not {declaration!r}")
    kind = match[1].removesuffix("_t")
    return f"{kind}{match[2][:1]} {match[3]}"


if __name__ == "__main__":
    SIGNATURES.write_text(render(HEADER.read_text()))
