"""Numbers over which the likelihood is as rough as noise: their best and std over several std.

When a linkage's play lets go depends on every twitch of the command. Signatures and small differences
see that, and not the milliradians: of eight **synthetic** flights with play two had it 5 and 8 std off,
0.0163 +- 0.0003 rad for 0.0212, where the likelihood over several milliradians has 0.018 +- 0.0017. So
such a number is at the top of a parabola through points which lie some nats lower.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np

from coax_env.estimation.engine import Engine, objective
from coax_env.estimation.quadratic import Quadratic
from coax_env.estimation.state_space import FreeParameter, Noise

ROUGH = ("servo_play",)
"""Effects whose likelihood is rough over less than their std."""
FALL = 4.0
"""nats by which the likelihood is to fall to either side of a rough number: more than it is rough."""
MOST_DOUBLED = 5
"""Times that a step of one std is doubled until it does; ours."""
BESIDE = (-1.0, -0.7, -0.4, 0.4, 0.7, 1.0)
"""Points of the parabola, in steps. Where the fit ended is none: that is the top of a spike; ours."""


@dataclass(frozen=True)
class Top:
    """Values of all parameters with a rough number at its best, minus their log-posterior [nats], and
    the number's std over that of its signature; None where no parabola opens upwards.
    """

    values: dict[str, float]
    objective: float
    std_ratio: float | None


def is_rough(name: str) -> bool:
    """Whether a parameter is one; name: with its effect's before the point."""
    return name.partition(".")[0] in ROUGH


def top_of(
    engine: Engine,
    free: Sequence[FreeParameter],
    values: Mapping[str, float],
    noise: Noise,
    name: str,
) -> Top:
    """A rough number at the top of its parabola, where that is likelier; all others at their optimum.

    A fit that stays beside the top is as unsure as that is far.

    Args:
        engine: model and records. free: parameters that were fitted. values: of all, by name.
        noise: levels. name: of the number.
    """
    _, lin = engine.linearise(values, noise, free, gains=False)
    quadratic = Quadratic.of(lin, free, values)
    k = int(quadratic.index([name])[0])
    covariance = quadratic.covariance(quadratic.names)
    std, profile = math.sqrt(covariance[k, k]), covariance[k] / covariance[k, k]

    @cache
    def moved(by: float) -> Top:
        along = np.clip(quadratic.at + by * profile, quadratic.lower, quadratic.upper)
        there = {**values, **dict(zip(quadratic.names, along.tolist(), strict=True))}
        return Top(there, objective(engine.filter(there, noise), free, there), None)

    here = moved(0.0)
    step = std
    for _ in range(MOST_DOUBLED):
        fallen = moved(step).objective + moved(-step).objective - 2.0 * here.objective
        if fallen >= 2.0 * FALL:
            break
        step *= 2.0
    points = step * np.array(BESIDE)
    curvature, slope, _ = np.polyfit(points, [moved(by).objective for by in points], 2)
    if not curvature > 0.0:
        return here
    off = float(np.clip(-0.5 * slope / curvature, -step, step))
    top = moved(off)
    apart = math.sqrt(0.5 / curvature)
    if top.objective >= here.objective:
        top, apart = here, math.hypot(apart, off)
    return Top(top.values, top.objective, max(apart / std, 1.0))
