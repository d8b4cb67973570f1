"""Streaming execution of jobs over many sessions: jobs start while sessions are still searched.

Only running jobs are in memory, however many sessions there are. The caller passes the function
that maps jobs over processes or a cluster; both yield each job with its outcome.
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
"""Number of failures kept for display; the report has all."""


@dataclass
class Summary:
    """Counts over the outcomes of a batch of jobs.

    Attributes:
        states: number of jobs by state: made, there, failed.
        verdicts: number of each verdict, for tasks with a verdict.
        failures: the first `LISTED_MAX` failures.
    """

    states: Counter[str] = field(default_factory=Counter)
    verdicts: Counter[str] = field(default_factory=Counter)
    failures: list[Outcome] = field(default_factory=list)

    def add(self, outcome: Outcome) -> None:
        """Count an outcome."""
        self.states[outcome.state] += 1
        if verdict := outcome.facts.get("verdict"):
            self.verdicts[verdict] += 1
        if outcome.state == "failed" and len(self.failures) < LISTED_MAX:
            self.failures.append(outcome)


def outcomes(jobs: Iterable[Job], spread: Spread) -> Iterator[Outcome]:
    """Run every job and yield its outcome, in order of completion.

    Raises:
        FootTileError: no job can run: workers have another version, or are not reachable.
    """
    for job, outcome in spread(run_job, jobs):
        if isinstance(outcome, WorkerLostError):
            yield failed(job, str(outcome))
        elif isinstance(outcome, Exception):
            raise outcome
        else:
            yield outcome
