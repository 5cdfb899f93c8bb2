"""Which problems are reported, of those that each judgement finds."""

from collections import Counter

from cpcbl_agents.input_diagnosis.motion_causes import CONTRADICTION, OR_START
from cpcbl_agents.input_diagnosis.problems import without_numbers
from cpcbl_team.trusted_pose import OR_MOVED

OVER = 4  # judgements in a row that find nothing, before a cause is no longer reported
CHANGED = 30  # judgements in a row that find another cause, before it replaces a cause


class ProblemHysteresis:
    """Keeps reported problems from flapping. A reported problem stays reported until several
    judgements in a row find nothing, or many in a row find another cause."""

    def __init__(self) -> None:
        self._reported: dict[str, str] = {}
        self._candidates: dict[str, str] = {}
        self._misses: Counter[str] = Counter()

    def __bool__(self) -> bool:
        return bool(self._reported or self._candidates)

    def __contains__(self, about: str) -> bool:
        return about in self._reported

    @property
    def reported_by_start(self) -> dict[str, str]:
        """The problems reported now that assume the robot was at its start, by subject."""
        return {about: text for about, text in self._reported.items() if OR_START in text}

    def update(self, found: dict[str, str]) -> tuple[str, ...]:
        """Takes what this judgement found, by subject, and returns the problems to report."""
        for about in {**self._reported, **self._candidates, **found}:
            self._judge(about, found.get(about, ""))
        return tuple(self._reported.values())

    def _judge(self, about: str, text: str) -> None:
        reported = self._reported.get(about, "")
        if reported and _problem_key(reported) == _problem_key(text):
            if OR_START not in reported and OR_MOVED not in reported:
                self._reported[about] = text
            self._misses[about] = 0
            return
        is_again = bool(text) and _problem_key(self._candidates.get(about, "")) == _problem_key(
            text
        )
        self._candidates[about] = text
        if not text:
            del self._candidates[about]
        self._misses[about] += 1
        is_cause = bool(reported) and CONTRADICTION not in reported
        if reported and self._misses[about] < (CHANGED if text and is_cause else OVER):
            return
        self._reported.pop(about, None)
        if is_again:
            self._reported[about] = text
            self._misses[about] = 0


def _problem_key(text: str) -> str:
    """The text of a problem without its figures and evidence: two problems with the same key have
    the same cause."""
    return without_numbers(text).removesuffix(f"; {OR_START}").removesuffix(f"; {OR_MOVED}")
