"""Many pieces of work at once: in this process, in joblib's own processes, or on a Ray cluster."""

import os
import sys
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import TypeVar

from coax_env.errors import InputError, require

BACKENDS = ("loky", "ray")
PORTION = 4  # pieces per worker between two hand-overs on Ray

Piece = TypeVar("Piece")
Result = TypeVar("Result")


def each(
    work: Callable[[Piece], Result], pieces: Sequence[Piece], jobs: int = 1, backend: str = "loky"
) -> Iterator[tuple[Piece, Result]]:
    """Every piece with what `work` makes of it, as they are done: in no order.

    What a piece gives must depend on nothing but the piece: then it is the same however many work.

    Args:
        work: a function that other processes can import, or a `partial` of one.
        pieces: what it is called with, one at a time.
        jobs: so many at once; -1: every core, or the whole cluster. One job works in this process.
        backend: ``"loky"``, joblib's processes, or ``"ray"``: the cluster of RAY_ADDRESS, else a
            local one, also for one job.
    """
    if jobs == 0 or backend not in BACKENDS:
        raise InputError(f"cannot work with {jobs} jobs on {backend!r}")
    if jobs == 1 and backend == "loky":
        for piece in pieces:
            yield piece, work(piece)
        return
    require("joblib", "study")
    from joblib import Parallel, delayed, parallel_config

    ray = backend == "ray"
    jobs = start_ray(jobs) if ray else jobs
    calls = [delayed(partial(_labelled, work))(piece) for piece in pieces]
    with parallel_config(backend=backend, n_jobs=jobs):
        if not ray:
            yield from Parallel(return_as="generator_unordered", batch_size=1)(calls)
            return
        portion = PORTION * jobs  # Ray's backend hands a whole call's results over together
        for first in range(0, len(calls), portion):
            yield from Parallel(batch_size=1)(calls[first : first + portion])


def _labelled(work: Callable[[Piece], Result], piece: Piece) -> tuple[Piece, Result]:
    """A piece with its result: they come back in no order."""
    return piece, work(piece)


def start_ray(jobs: int) -> int:
    """Join the cluster of RAY_ADDRESS, or start one here; the number of its workers.

    Every machine of a cluster needs this checkout at the same place.
    """
    require("ray", "study")
    import ray
    from ray.util.joblib import register_ray

    joined = bool(os.environ.get("RAY_ADDRESS"))
    if ray.is_initialized() and not joined and jobs > _cpus():
        ray.shutdown()  # ours, started here for fewer
    local = {} if joined else {"num_cpus": jobs if jobs > 0 else None}
    modules = {"PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
    ray.init(
        include_dashboard=False, logging_level="ERROR", ignore_reinit_error=True,
        runtime_env={"env_vars": modules}, **local,
    )  # fmt: skip
    register_ray()
    if jobs > _cpus():
        raise InputError(f"the Ray cluster has {_cpus()} CPUs, too few for {jobs} jobs")
    return jobs if jobs > 0 else _cpus()


def _cpus() -> int:
    import ray

    return int(ray.cluster_resources().get("CPU", 0))
