"""diagnostic_msgs/DiagnosticArray: what is wrong with each robot, its inputs and its teammates."""

from collections.abc import Iterable, Sequence

from cpcbl_agents.robot_state import robot_state
from cpcbl_launch.run.ros2.planar import Fields, header_fields
from cpcbl_transport.messages import Status

OK, WARN, ERROR, STALE = 0, 1, 2, 3
LEVELS = {"good": OK, "warning": WARN, "error": ERROR}
STATUS_S = 1.0  # between two statuses of a robot
MOST_LINES = 20  # of one status
LONGEST = 200  # characters of a line


def diagnostics_message(statuses: Iterable[Fields], stamp_ns: int) -> Fields:
    """The array of these statuses."""
    return {"header": header_fields(stamp_ns, ""), "status": list(statuses)}


def robot_diagnostic(robot: str, status: Status | None, age_s: float) -> Fields:
    """The diagnostic of one robot, by its latest status, which came `age_s` ago: stale without
    one, an error while it is lost, a warning for whatever else is wrong."""
    state = robot_state(status, silent_s=age_s, pause_s=STATUS_S)
    if status is None or state.word == "gone":
        text = f"no status for {age_s:.0f} s: does cpcbl-team robot run?"
        return _diagnostic(robot, STALE, text if status is not None else "no status yet", ())
    quarantined = [f"{t.peer} ({t.reason})" for t in status.trust if t.reason]
    message = next(iter(state.reasons), "localized")
    values: list[tuple[str, object]] = [
        ("position sigma m", f"{status.position_sigma_m:.3f}"),
        ("heading sigma rad", f"{status.heading_sigma_rad:.3f}"),
        ("tier", status.tier),
        ("lost", status.lost),
        ("unconfirmed", status.unconfirmed),
        ("quarantine", ", ".join(quarantined)),
    ]
    values += [(f"problem {i}", text) for i, text in enumerate(state.problems)]
    for health in status.inputs:
        values.append((f"{health.input} rate hz", f"{health.rate_hz:.1f}"))
        refused = ", ".join(f"{count} x {reason}" for reason, count in health.refused.items())
        values.append((f"{health.input} refused", refused))
    return _diagnostic(robot, LEVELS[state.severity], message, values)


def bridge_diagnostic(robot: str, findings: Sequence[str]) -> Fields:
    """What the bridge does not hear or cannot use, and why."""
    message = findings[0] if findings else "all topics are heard"
    values = [(f"finding {i}", text) for i, text in enumerate(findings[:MOST_LINES])]
    name = f"{robot} bridge" if robot else "bridge"
    return _diagnostic(name, WARN if findings else OK, message, values)


def _diagnostic(name: str, level: int, text: str, values: Iterable[tuple[str, object]]) -> Fields:
    return {
        "level": level,
        "name": f"cpcbl: {name}",
        "message": text[:LONGEST],
        "hardware_id": name.partition(" ")[0],
        "values": [{"key": key, "value": str(value)[:LONGEST]} for key, value in values],
    }
