"""Which tests of the compiled core sanitizers run (.ci/sanitize), and what those compare."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Any

# Set by .ci/sanitize, whose claim is that no call of the core leaves its memory. What the core gives is compared with
# the references by the tests without sanitizers. Under them the references, which are not instrumented, would take most
# of the time: the core answers for them, so that two runs over memory in another state must agree.
UNDER_SANITIZERS = "PCDATA_UNDER_SANITIZERS" in os.environ


def repeats_in_memory(test: str, parameters: Mapping[str, Any], best: str) -> bool:
    """Say whether a case takes the core through memory as another does, whatever instruction set it names.

    Random cases run with every library. Of the others, those that name a number of threads run with the best library
    anyway, where they name none; those that only name a library run with the best one.
    """
    if "fuzz" in test:
        return False
    named = parameters.get("machine", parameters.get("instruction_set"))
    return named[1] is not None if isinstance(named, tuple) else named not in (None, best)
