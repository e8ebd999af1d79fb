"""The budget that was requested last, and the one in force."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import asdict

from avatar_core.vademecum.accuracy import Budget
from avatar_ros.prepare.requests import Change, PreparedModel
from avatar_ros.prepare.supplier import SUPERSEDED, Answer


class BudgetRequests:
    """Has the detail chosen for each new budget; if it cannot be met, the last stays in force.

    A new budget is compared with the one requested last, not with the one in force: it takes some
    tenths of a second from one to the other, in which a budget may be withdrawn. Answers come in
    a thread of the supplier.

    in_force : the budget in force; None for none
    ask : of the ModelSupplier
    on_granted : called with a budget once it is in force
    on_refused : called with the budget that stays in force, and the reason of the refusal
    """

    def __init__(
        self,
        in_force: Budget | None,
        ask: Callable[[Change, Answer], None],
        on_granted: Callable[[Budget | None], None],
        on_refused: Callable[[Budget | None, str], None],
    ) -> None:
        self.in_force = in_force
        self._requested = in_force
        self._number = 0
        self._lock = threading.Lock()  # guards the three above
        self._ask, self._on_granted, self._on_refused = ask, on_granted, on_refused

    def ask(self, budget: Budget | None) -> None:
        """Request a budget, unless it was requested last already; returns at once."""
        with self._lock:
            if budget == self._requested:
                return
            self._requested = budget
            self._number += 1
            number = self._number

        def answer(model: PreparedModel | None, refusal: str) -> None:
            if refusal == SUPERSEDED:
                return
            with self._lock:
                if not refusal:
                    self.in_force = budget
                elif number == self._number:
                    self._requested = self.in_force
                else:  # a newer request is pending
                    return
            if refusal:
                self._on_refused(self.in_force, refusal)
            else:
                self._on_granted(budget)

        self._ask({"budget": asdict(budget) if budget else {}}, answer)
