"""Every list of status codes agrees with ``avatar_core.contact.status``."""

from __future__ import annotations

import re
from collections.abc import Iterator

from avatar_core.contact.status import Status
from avatar_interfaces.msg import ContactState
from avatar_ros.loop.diagnostics import Faults
from avatar_ros.loop.settings import CONTACT
from avatar_ros.loop.statuses import EXPLANATIONS
from tests.helpers.paths import ROOT

Row = tuple[int, str, str]  # number, name, meaning
CODES = [(int(status), status.name, status.meaning) for status in Status]
SOUND = {Status.OK, Status.TOO_MANY_CONTACTS, Status.ENGAGING}  # none of these needs a remedy


def rows(path: str, pattern: str) -> Iterator[Row]:
    for found in re.finditer(pattern, (ROOT / path).read_text(), re.MULTILINE):
        yield int(found["number"]), found["name"], found["meaning"]


def test_the_message_has_them() -> None:
    pattern = r"^uint8 STATUS_(?P<name>\w+)=(?P<number>\d+) +# (?P<meaning>.+)$"
    assert list(rows("avatar_ros/avatar_interfaces/msg/ContactState.msg", pattern)) == CODES
    for number, name, _ in CODES:  # as generated
        assert getattr(ContactState, f"STATUS_{name}") == number


def test_a_past_fault_of_a_device_does_not_quote_what_it_says_now() -> None:
    fault = {int(Status.NOT_ENABLED): 3}
    past, present = (
        Faults(fault, int(status), "DISABLED, homed").text
        for status in (Status.OK, Status.NOT_ENABLED)
    )
    assert "is not enabled" in past and "DISABLED" not in past
    assert "(it says DISABLED, homed)" in present


def test_a_word_that_yaml_reads_as_false_is_asked_for_in_quotes() -> None:
    hints = {p.name: "in quotes if it is off" in p.wanted() for p in CONTACT}
    assert {name for name, is_hinted in hints.items() if is_hinted} == {"cloud", "safety.passivity"}


def test_the_page_has_them() -> None:
    pattern = r"^(?P<number>\d+) `STATUS_(?P<name>\w+)` \| (?P<meaning>.+)$"
    listed = list(rows("msg_docs/interfaces/contact_state.md", pattern))
    assert [row[:2] for row in listed] == [code[:2] for code in CODES]
    for (*_, said), (*_, meaning) in zip(listed, CODES, strict=True):
        assert said.replace("`", "").startswith(meaning)  # and may go on with details


def test_every_fault_has_a_cause_and_a_remedy() -> None:
    assert set(EXPLANATIONS) == set(Status) - SOUND
