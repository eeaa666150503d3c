"""Which maneuver separates descriptions that these flights cannot: designed, not looked up.

A maneuver's worth is the smallest distance (discrimination.py) over all pairs of descriptions, each
member taken as the truth once, and the winner has the largest. What wins was flown with every
description and stays inside the safe envelope with each; one that is seen to leave it is left out.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from coax_env.design.candidates import Envelope, candidates, flown_inside
from coax_env.design.discrimination import Alternative, distance
from coax_env.errors import InputError
from coax_env.estimation.state_space import Noise
from coax_env.simulation.maneuvers import Maneuver

MOST_ALTERNATIVES = 4


@dataclass(frozen=True)
class Proposal:
    """A maneuver inside the envelope.

    nats: evidence it is expected to bring for the pair it separates least; a bound from above where a
    maneuver before it is better.
    """

    maneuver: Maneuver
    nats: float


@dataclass(frozen=True)
class Design:
    """Result of `design`: maneuvers by their worth, best first, and those left out with the reason."""

    alternatives: tuple[Alternative, ...]
    ranked: tuple[Proposal, ...]
    refused: tuple[tuple[Maneuver, str], ...]

    def worth(self, name: str) -> float | None:
        """Largest expected evidence [nats] of a maneuver of that name; None where it was left out."""
        return max((p.nats for p in self.ranked if p.maneuver.name == name), default=None)


def design(
    alternatives: Sequence[Alternative],
    noise: Noise,
    rates: Mapping[str, float],
    envelope: Envelope | None = None,
    maneuvers: Sequence[Maneuver] | None = None,
) -> Design:
    """Rank maneuvers by how well they separate confounded descriptions.

    Args:
        alternatives: two or more; of many the first MOST_ALTERNATIVES.
        noise: of gusts and readings.
        rates: channels aboard, and how often each is read [Hz].
        envelope: that no description may leave; default `Envelope()`.
        maneuvers: to choose from; default `candidates()`.
    """
    if len(alternatives) < 2:
        raise InputError(f"a design separates two descriptions or more, found {len(alternatives)}")
    envelope = envelope or Envelope()
    chosen = tuple(alternatives[:MOST_ALTERNATIVES])
    ranked: list[Proposal] = []
    refused = []
    best = -math.inf
    for plan in candidates() if maneuvers is None else maneuvers:
        nats, why = _worth(chosen, plan, noise, rates, envelope, best)
        if why:
            refused.append((plan, why))
            continue
        best = max(best, nats)
        ranked.append(Proposal(plan, nats))
    ranked.sort(key=lambda p: -p.nats)
    return Design(chosen, tuple(ranked), tuple(refused))


def _worth(
    alternatives: Sequence[Alternative],
    plan: Maneuver,
    noise: Noise,
    rates: Mapping[str, float],
    envelope: Envelope,
    enough: float,
) -> tuple[float, str]:
    """Smallest distance [nats] over pairs and directions, and why the maneuver must not be flown.

    A distance below `enough` ends the comparison: the maneuver cannot win.
    """
    least = math.inf
    for truth in alternatives:
        flown, why = flown_inside(truth.vehicle, plan, envelope, f" with {truth.name}")
        if flown is None:
            return least, why
        for other in alternatives:
            if other is not truth:
                least = min(least, distance(flown, other, noise, rates))
                if least < enough:
                    return least, ""
    return least, ""


def advise(result: Design | None, evidence: float) -> dict[str, Any] | None:
    """`next_maneuver` of findings.json, or None where nothing is confounded.

    evidence: nats that a decision takes.
    """
    if result is None or not result.ranked:
        return None
    best = result.ranked[0]
    hover = result.worth("hover")
    said = f"{best.maneuver.summary}: expected to separate them by {_nats(best.nats)} nats"
    if hover is not None and best.maneuver.name != "hover":
        said += f"; hover by {_nats(hover)}"
    if best.nats < evidence:
        said += f". No maneuver tried reaches the {evidence:g} nats that a decision takes"
        if best.nats > 0.1 * evidence:
            said += f": fly it {math.ceil(evidence / best.nats)} times"
        else:
            said += ": better sensors are needed, not another maneuver"
    return {
        "maneuver": best.maneuver.name,
        "separates": [a.name for a in result.alternatives],
        "why": said,
    }


def _nats(value: float) -> str:
    return f"{value:.0f}" if value >= 10.0 else f"{value:.1f}"
