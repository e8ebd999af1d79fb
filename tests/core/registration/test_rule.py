"""Prior knowledge of a registration: numbers that make no sense are refused."""

from __future__ import annotations

import re
from typing import Any

import pytest

from avatar_core.errors import RegistrationError
from avatar_core.registration.rule import RegistrationRule


@pytest.mark.parametrize(
    ("given", "reason"),
    [
        ({"noise": 1.0}, "noise is 1; give 1e-05 to 0.02 in metres"),
        ({"shift": 1.0}, "shift is 1; give 0 to 0.2 in metres"),
        ({"turn": 10.0}, "turn is 572.958 degrees; give 0 to 180"),
        ({"within": -1.0}, "within is -1; give 1e-05 to 0.2 in metres"),
        ({"within": float("nan")}, "within is nan"),
        ({"correlation": float("nan")}, "correlation is nan"),
        ({"correlation": -1.0}, "correlation is -1; give 0 to 0.2 in metres"),
        ({"support_shift": float("nan")}, "support_shift is nan"),
        ({"support_shift": -1e-3}, "support_shift is -0.001"),
        ({"freedom": 0.0}, "freedom is 0; give 1 to"),
        ({"tolerance": float("nan")}, "tolerance is nan"),
        ({"most_steps": 0}, "most_steps is 0; give 1 to"),
    ],
)
def test_a_number_of_the_rule_out_of_its_range_is_refused(
    given: dict[str, Any], reason: str
) -> None:
    with pytest.raises(RegistrationError, match=re.escape(reason)):
        RegistrationRule(**given)


def test_an_unknown_kind_of_loads_is_refused() -> None:
    kinds = "choose one of smooth, few, pressure, or None"
    with pytest.raises(RegistrationError, match=f"unknown kind 'pressur'; {kinds}"):
        RegistrationRule(kind="pressur")  # type: ignore[arg-type]
    assert RegistrationRule(kind="pressure").kind == "pressure"
