"""Where the team's router is, what it lets in, and how links are secured."""

from typing import Annotated, Literal

import msgspec

from cpcbl_team.config.table import Positive, Table

Security = Literal["none", "mtls"]


class GuardSettings(Table, frozen=True, kw_only=True):
    """Limits in the router on what one robot sends, so that it cannot flood the others."""

    enabled: bool = True
    fix_rate_hz: Positive = 100.0
    """Of fixes for one teammate. The router drops a fix that follows the last one sooner than
    1 / rate, and messages come unevenly, so this must be at least twice the sensor's rate."""
    belief_rate_hz: Positive = 50.0
    largest_help_bytes: Annotated[int, msgspec.Meta(ge=1)] = 256
    """The largest payload of a fix or belief."""
    largest_bytes: Annotated[int, msgspec.Meta(ge=1)] = 65_536
    """The largest payload of any other message; robots refuse larger ones too."""
    largest_frame_bytes: Annotated[int, msgspec.Meta(ge=1)] = 1_048_576
    """The largest payload of a camera's image, plain or annotated."""


class TransportSettings(Table, frozen=True, kw_only=True):
    """The team's Zenoh router."""

    listen: tuple[str, ...] = ()
    """The endpoints at which `up` opens its router; default: a free port of 127.0.0.1."""
    connect: tuple[str, ...] = ("tcp/127.0.0.1:7447",)
    """The endpoints at which a robot looks for the router."""
    guards: GuardSettings = GuardSettings()
    security: Security = "none"
    """mtls: every link is mutual TLS, and a certificate permits only what its owner may do."""
    keys: Annotated[str, msgspec.Meta(min_length=1)] = "keys"
    """The folder of the keys that `cpcbl-team keys` makes, relative to the team file."""

    @property
    def secured(self) -> bool:
        return self.security == "mtls"

    @property
    def usual(self) -> tuple[str, ...]:
        """The endpoints of this machine's router, unless the file names others."""
        return ("tls/127.0.0.1:7447",) if self.secured else ("tcp/127.0.0.1:7447",)
