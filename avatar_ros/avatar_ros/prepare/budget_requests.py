"""The budget that was asked for last, and the one in force."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import asdict

from avatar_core.vademecum.accuracy import Budget
from avatar_ros.prepare.handover import OVERTAKEN, Answer
from avatar_ros.prepare.orders import Change, Prepared


class BudgetRequests:
    """Has the detail chosen anew for each budget; one that cannot be met gives way to the last.

    What is asked is compared with what was asked last, not with what is in force: between the two
    lie some tenths of a second in which a budget may be taken back. Answers come in a thread of
    their own.

    kept : the budget in force; None for none
    ask : of the handover
    on_kept : called with a budget once it is in force
    on_refused : called with the budget that stays in force, and why the one asked for is refused
    """

    def __init__(
        self,
        kept: Budget | None,
        ask: Callable[[Change, Answer], None],
        on_kept: Callable[[Budget | None], None],
        on_refused: Callable[[Budget | None, str], None],
    ) -> None:
        self.kept = kept
        self._asked = kept
        self._number = 0
        self._lock = threading.Lock()  # of the three above
        self._ask, self._on_kept, self._on_refused = ask, on_kept, on_refused

    def ask(self, budget: Budget | None) -> None:
        """Returns at once; what was asked last already is not asked again."""
        with self._lock:
            if budget == self._asked:
                return
            self._asked = budget
            self._number += 1
            number = self._number

        def answer(prepared: Prepared | None, refusal: str) -> None:
            if refusal == OVERTAKEN:
                return
            with self._lock:
                if not refusal:
                    self.kept = budget
                elif number == self._number:
                    self._asked = self.kept
                else:  # a newer one is on its way
                    return
            if refusal:
                self._on_refused(self.kept, refusal)
            else:
                self._on_kept(budget)

        self._ask({"budget": asdict(budget) if budget else {}}, answer)
