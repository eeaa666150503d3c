"""What every program of this folder does with the env it opens; needs numpy and nothing of coax.

Called as ``python fly_X.py MODE COUNT SECONDS``; the last line printed is a JSON object.

- ``many``: COUNT envs in the simulator's own vector env, for SECONDS; env-steps per second.
- ``one``: one env.
- ``start``: seconds from here to the end of the first step, imports included.
"""

import json
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

START = time.perf_counter()
BATCHES = 16


@dataclass
class Flown:
    """An env that has been reset.

    ``step`` takes one of `actions`, drawn from the env's own action space before the clock runs, and
    resets what has ended where the env does not; ``finish`` waits for what is still being computed.
    """

    step: Callable[[Any], Any]
    actions: Sequence[Any]
    count: int
    control_hz: float
    physics_steps: int  # per env-step
    version: str
    note: str = ""
    finish: Callable[[], Any] = lambda: None


def main(make: Callable[[int | None], Flown]) -> None:
    """Time what `make` opens: so many envs in a vector env, or one env where the number is None."""
    mode, count, seconds = sys.argv[1], int(sys.argv[2]), float(sys.argv[3])
    if mode == "start":
        flown = make(None)
        flown.step(flown.actions[0])
        flown.finish()
        result = {"value": time.perf_counter() - START}
    elif mode == "one":
        flown = make(None)
        result = {"value": steps_per_second(flown, seconds)}
    else:
        small = make(min(count, 16))  # what it compiles is not counted
        steps_per_second(small, 0.0)
        before = resident()
        flown = make(count)
        result = {"value": steps_per_second(flown, seconds)}
        result["bytes_per_env"] = (resident() - before) / flown.count
    facts = ("count", "control_hz", "physics_steps", "version", "note")
    print(json.dumps(result | {name: getattr(flown, name) for name in facts}), flush=True)


def steps_per_second(flown: Flown, seconds: float) -> float:
    """Env-steps per second over at least so long, after every action has been flown once."""
    for action in flown.actions:
        flown.step(action)
    flown.finish()
    begin = time.perf_counter()
    steps = 0
    while True:
        for action in flown.actions:
            flown.step(action)
        flown.finish()
        steps += len(flown.actions)
        elapsed = time.perf_counter() - begin
        if elapsed >= seconds:
            return steps * flown.count / elapsed


def drawn(space: Any) -> list[Any]:
    """Actions from a space, the same in every run."""
    space.seed(0)
    return [space.sample() for _ in range(BATCHES)]


def with_resets(env: Any) -> Callable[[Any], Any]:
    """Step of a Gymnasium env that starts anew where the flight has ended."""

    def step(action: Any) -> None:
        _, _, terminated, truncated, _ = env.step(action)
        if terminated or truncated:
            env.reset()

    return step


def resident() -> int:
    """Memory of this process and its children that is held now [bytes]; Linux."""
    page = 4096
    own = Path("/proc/self")
    pids = (own / "task" / own.resolve().name / "children").read_text().split()
    return page * sum(
        int(Path(f"/proc/{pid}/statm").read_text().split()[1]) for pid in ("self", *pids)
    )
