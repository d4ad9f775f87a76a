"""What daemon and relay say to each other does not change without a thought of the relays that run."""

from __future__ import annotations

from support.words import words, words_digest
from zsched.link.pipe.relay_socket import PROTOCOL

TODAY = (3, "35360c2092ccf9c1")
"""Another digest means: relays of the versions before say other words. Raise `PROTOCOL`, unless one side without the
word does right all the same: what was added has a default, nobody waits for it, and no member of an enum is new. A
higher number replaces every relay at an upgrade, and cuts its robot's applications off for a second: say so in the
CHANGELOG. Then write both here."""


def test_the_words_are_those_of_the_versions_before() -> None:
    assert (PROTOCOL, words_digest()) == TODAY, "\n".join(words())


def test_every_class_and_all_that_it_is_made_of_is_told() -> None:
    told = {line.partition(":")[0] for line in words()}
    assert {"RoutePlan", "Slot", "Route", "StreamSettings", "StreamClass", "StreamCount", "RelayHello"} <= told
