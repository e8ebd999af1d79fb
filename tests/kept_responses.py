"""The response of an organ to a tip, computed once for all models that a worker makes of it.

It follows from the organ alone and is found by the content of all that it is made of. To make it
takes a second, and tests make hundreds of models of few organs; each model gets copies of its own.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from typing import Any

from avatar_core.contact.tip_response import TipResponse

from .content import digest

KEPT = 24  # of some megabytes each


def kept(make: Callable[..., TipResponse]) -> Callable[..., TipResponse]:
    """What ``make`` gives, for arguments whose content was met before as well."""
    known: OrderedDict[bytes, TipResponse] = OrderedDict()

    def found(*arguments: Any) -> TipResponse:
        key = digest(*arguments)
        if key not in known:
            known[key] = make(*arguments)
            if len(known) > KEPT:
                known.popitem(last=False)
        known.move_to_end(key)
        return TipResponse(*(array.copy() for array in known[key]))

    return found
