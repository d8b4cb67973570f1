"""A plan over sessions: jobs go out as places are found, and outcomes come back as they are there.

No more is in memory than what is under way, however many sessions there are. Who spreads the jobs
over processes, or over a cluster, is told; both give each job with its outcome.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field

from devices.errors import WorkerLostError
from service.offline.archive.jobs import Job, Outcome, failed, run_job
from service.offline.processes import GoesOn

Spread = Callable[
    [Callable[[Job], Outcome | GoesOn], Iterable[Job]], Iterator[tuple[Job, Outcome | Exception]]
]
LISTED_MAX = 20
"""So many failures are kept to be shown; the report has all."""


@dataclass
class Summary:
    """What became of a plan.

    Attributes:
        states: how many jobs were made, there, or failed.
        verdicts: how often each was given, by tasks that give any.
        failures: the first of them.
    """

    states: Counter[str] = field(default_factory=Counter)
    verdicts: Counter[str] = field(default_factory=Counter)
    failures: list[Outcome] = field(default_factory=list)

    def add(self, outcome: Outcome) -> None:
        """Take the next outcome."""
        self.states[outcome.state] += 1
        if verdict := outcome.facts.get("verdict"):
            self.verdicts[verdict] += 1
        if outcome.state == "failed" and len(self.failures) < LISTED_MAX:
            self.failures.append(outcome)


def outcomes(jobs: Iterable[Job], spread: Spread) -> Iterator[Outcome]:
    """What becomes of every job, in the order in which they end.

    Raises:
        FootTileError: no job can be done in this way: workers are of another version, or away.
    """
    for job, outcome in spread(run_job, jobs):
        if isinstance(outcome, WorkerLostError):
            yield failed(job, str(outcome))
        elif isinstance(outcome, Exception):
            raise outcome
        else:
            yield outcome
