"""Reports of teammates for the tests of trust, without a filter."""

from cpcbl_team.config import (
    TrustSettings,
)
from cpcbl_team.sender_records import NEVER_NS, TeammateReport
from cpcbl_team.trust import TrustDecision, assess, with_own_sensor_result
from cpcbl_team.voters import SenderRecords

MS = 1_000_000
RULES = TrustSettings()
CONTRADICTS, AGREES = 100.0, 1.0


class Receiver:
    """Assesses reports, of each sender ten times a second."""

    def __init__(self, rules: TrustSettings = RULES) -> None:
        self.rules, self.now_ns = rules, 0
        self.senders: SenderRecords = {}
        self.decisions: list[tuple[str, TrustDecision]] = []

    def receive(self, seconds: float, **all_nis: float) -> None:
        """The senders' reports have these NIS (`own`: the robot's own sensors; guests are named
        so)."""
        for _ in range(round(10 * seconds)):
            self.now_ns += 100 * MS
            for name, nis in all_nis.items():
                if name == "own":
                    bad = int(nis == CONTRADICTS)
                    self.senders = with_own_sensor_result(
                        self.senders, self.now_ns, 1 - bad, bad, self.rules.limit
                    )
                else:
                    is_guest = name.startswith("guest")
                    report = TeammateReport(self.now_ns, nis, (0.5, 0.0), is_guest=is_guest)
                    self.report(name, report)

    def report(self, name: str, report: TeammateReport) -> TrustDecision:
        decision = assess(self.senders, name, report, NEVER_NS, self.rules)
        self.senders = decision.senders
        self.decisions.append((name, decision))
        return decision

    @property
    def quarantined(self) -> dict[str, str]:
        return {name: str(r.reason) for name, r in self.senders.items() if r.reason}

    @property
    def events(self) -> list[tuple[str, str]]:
        return [(name, d.event) for name, d in self.decisions if d.event]
