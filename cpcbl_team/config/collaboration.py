"""How a robot and its teammates help each other."""

import math
from typing import Annotated, Literal

import msgspec

from cpcbl_team.config.table import NotNegative, Positive, Share, Table

Fusion = Literal["split-ci", "naive"]
Direction = Literal["one-way", "both-ways"]


class BudgetSettings(Table, frozen=True, kw_only=True):
    """What a robot may spend on fixes, beliefs and places of landmarks; 0 means no limit."""

    bytes_per_s: NotNegative = 0.0
    """With Zenoh's own bytes, without those of TCP/IP. It holds over any 10 s; below 50 B/s,
    over the time in which 500 bytes are earned."""
    messages_per_minute: NotNegative = 0.0
    """It holds over any minute; with 2.5 the robot sends at most 3 messages in any 72 s."""
    match_share: NotNegative = 1.0
    """The robot's weight when `match.messages` are divided among the robots."""
    urgent_share: Share = 0.2
    """The part of every budget that is reserved for teammates that are lost."""


class TrustSettings(Table, frozen=True, kw_only=True):
    """How a robot detects teammates whose messages are wrong (docs/trust.md)."""

    enabled: bool = True
    limit: Positive = 30.0
    """The sum of NIS beyond the usual at which there is a dispute: three clear contradictions."""
    readmit_s: NotNegative = 5.0
    """A sender is used again after its messages were right for this time."""
    least_sigma_m: NotNegative = 0.02
    """The pose of a teammate is believed to be no better than this."""
    guest_sigma_m: NotNegative = 0.03
    """The same of a guest that no other source has confirmed yet."""
    nearest_m: NotNegative = 1.0
    """A teammate that moves is taken to be at least this far from a robot that it sees. Its sensor
    settings and this distance bound the certainty of its fixes. 0: they are not bounded."""
    clock_ahead_s: NotNegative = 0.1
    """Help is refused if the clock of its sender is further ahead than this."""
    clock_behind_s: Positive = 0.4
    """Help is refused if all of it arrives later than this after its time stamp."""


class CollaborationSettings(Table, frozen=True, kw_only=True):
    """Active and passive collaboration of one robot."""

    passive: bool = True
    active: bool = True
    fusion: Fusion = "split-ci"
    direction: Direction = "one-way"
    tier_width: Annotated[float, msgspec.Meta(gt=1.0)] = math.sqrt(2.0)
    """The ratio of the position sigma from one tier to the next."""
    tier_hysteresis: Annotated[float, msgspec.Meta(ge=1.0)] = 1.1
    """A robot leaves its tier only when sigma is beyond the tier's edge by this factor."""
    best_tier: Annotated[int, msgspec.Meta(ge=0, le=15)] = 0
    """The best tier that the robot announces, however accurate its estimate is: for sensors whose
    errors it cannot notice."""
    budget: BudgetSettings = BudgetSettings()
    trust: TrustSettings = TrustSettings()
    least_value: NotNegative = 0.05
    """The information gain (nats) from which on a fix is sent: the logarithm of the factor by which
    the ellipse of the receiver's position shrinks."""
    least_use: NotNegative = 0.05
    """The information gain (nats) from which on the beliefs of a teammate in sight are subscribed
    to."""
    belief_rate_hz: Positive = 5.0
    """The highest rate at which beliefs are sent."""
    belief_share: NotNegative = 0.5
    """A belief is sent when the receivers' extrapolation of the last one is off by this share of
    sigma."""
    belief_silence_s: NotNegative = 1.0
    """The longest time between two beliefs of a robot to whose beliefs somebody subscribes."""
    fix_interval_s: NotNegative = 0.0
    """The least time between two fixes for the same teammate."""
    max_age_s: Positive = 1.5
    """A teammate's belief that is older than this is not used."""
    after_s: NotNegative = 0.0
    """Collaboration begins this long after the start, to show its effect."""
