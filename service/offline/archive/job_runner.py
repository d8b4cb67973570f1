"""Streaming execution of jobs over many sessions: jobs start while sessions are still searched.

Only running jobs are in memory, however many sessions there are. The caller passes the function
that maps jobs over processes or a cluster; both yield each job with its outcome.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field

from devices.errors import WorkerLostError
from service.offline.archive.jobs import Job, Outcome, make_failed_outcome, run_job
from service.offline.process_pool import Unfinished

JobMapper = Callable[
    [Callable[[Job], Outcome | Unfinished], Iterable[Job]],
    Iterator[tuple[Job, Outcome | Exception]],
]
MAX_LISTED_FAILURES = 20
"""Number of failures kept for display; the report has all."""


@dataclass
class OutcomeCounts:
    """Counts over the outcomes of a batch of jobs.

    Attributes:
        states: number of jobs by state: made, there, failed.
        verdicts: number of each verdict, for tasks with a verdict.
        failures: the first `MAX_LISTED_FAILURES` failures.
    """

    states: Counter[str] = field(default_factory=Counter)
    verdicts: Counter[str] = field(default_factory=Counter)
    failures: list[Outcome] = field(default_factory=list)

    def add_outcome(self, outcome: Outcome) -> None:
        """Count an outcome."""
        self.states[outcome.state] += 1
        if verdict := outcome.facts.get("verdict"):
            self.verdicts[verdict] += 1
        if outcome.state == "failed" and len(self.failures) < MAX_LISTED_FAILURES:
            self.failures.append(outcome)


def run_jobs(jobs: Iterable[Job], map_jobs: JobMapper) -> Iterator[Outcome]:
    """Run every job and yield its outcome, in order of completion.

    Raises:
        FootTileError: no job can run: workers have another version, or are not reachable.
    """
    for job, outcome in map_jobs(run_job, jobs):
        if isinstance(outcome, WorkerLostError):
            yield make_failed_outcome(job, str(outcome))
        elif isinstance(outcome, Exception):
            raise outcome
        else:
            yield outcome
