"""What models of an organ share, computed once for all models that a worker makes of it.

The response to a tip and the modes of the cloud follow from the organ alone and are found by the
content of all that they are made of. To make them takes a second, and tests make hundreds of models
of few organs; each model gets copies of its own.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from typing import Any

from avatar_core.vademecum.model import Vademecum
from tests.helpers.content import digest

KEPT = 24  # of some megabytes each


def cached(make: Callable[..., Any], key: Callable[..., Any] = lambda *made_of: made_of) -> Any:
    """What ``make`` gives, a tuple of arrays, for arguments whose content was met before as well.

    key : what it is made of, of the arguments
    """
    known: OrderedDict[bytes, Any] = OrderedDict()

    def found(*arguments: Any) -> Any:
        made_of = digest(key(*arguments))
        if made_of not in known:
            known[made_of] = make(*arguments)
            if len(known) > KEPT:
                known.popitem(last=False)
        known.move_to_end(made_of)
        return known[made_of]._make(array.copy() for array in known[made_of])

    return found


def of_cloud(vademecum: Vademecum, *others: Any) -> tuple[Any, ...]:
    """What the modes of a cloud are made of."""
    v, display = vademecum, vademecum.display
    corners = None if display is None else display.corners
    return v.mesh, v.surface.n_positions, v.far, v.regional, corners, *others
