"""No private word names a function, a class or a module of the product: the field's terms do."""

import re
from collections.abc import Iterator
from pathlib import Path

TOP = Path(__file__).parents[1]
FOLDERS = ("cpcbl_team", "transport", "agents", "launch")
PRIVATE = set(
    re.findall(
        r"\w+",
        """
    Said Voice Voices Verdict Standing judged heard seen beside against silenced forgiven surprise
    told Told hear Whereabouts by_fix by_sensor placed Place Glance glanced remembered noted
    told_evidence sought_ns moved drive reckoned turns resting offers measured doubted widened
    Found carried once_each crawled_s worth heading_worth Helped Turned use_of expected survival
    learned Wiring follow Tally Tallies Stranger Guests Visit unfed Listened Looked look_round
    Eyes Glimpses Doubt twins together Pilot steer Stop begun while_time_holds through news
    Stepped said_by heard_by Treatment announce reading overhead handshake why_not PassingBus liar
    Lie Liar bodies Body posts carriers visitors Visitor Notes NoteTaker Kept LookEar ear standing
    Wish Visited yardstick yardsticks sights they_go_on all_is_well Weather Wire
    Held unseen kind cause turned way_of_speed seen_again by_ways by_pose by_start by_tokens
    Before changed tell_moved Shown serving bus_of doing done given guarded misunderstood
    determined unsettled lying spent healed thinned attached watched joined checked taken arrived
    stored connected filled clamped applied overlapping
    """,
    )
)


DEFINED = re.compile(r"^ *(?:async )?(?:def|class) (\w+)", re.MULTILINE)


def names(path: Path) -> Iterator[str]:
    """The names of a module and of its functions and classes."""
    yield path.stem
    yield from DEFINED.findall(path.read_text(encoding="utf-8"))


def test_no_definition_is_named_by_a_private_word() -> None:
    found = [
        f"{path.relative_to(TOP)}: {name}"
        for folder in FOLDERS
        for path in sorted((TOP / folder).rglob("*.py"))
        for name in names(path)
        if name.strip("_") in PRIVATE
    ]
    assert not found, "\n".join(found)
