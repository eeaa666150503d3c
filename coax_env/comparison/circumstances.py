"""What differs between two flights of an unchanged machine: air, ground, battery and pilot.

Each flight has these as numbers of its own, under their priors. They are fitted with everything else,
are never a change, and what they can explain is no evidence for one.
"""

from collections.abc import Sequence

from coax_env.comparison.two_flights import ROTOR_SPEED, B, OneFlight
from coax_env.diagnosis.preparation import namable
from coax_env.estimation.helicopter import HeliModel
from coax_env.estimation.parted_engine import of_part
from coax_env.estimation.state_space import FreeParameter
from coax_env.model import effects

OF_FLIGHT = ("wind", "battery_sag")
"""Effects that each flight has to itself."""
OF_PLACE = ("ground_effect",)
"""Effects that are as strong as the ground under a flight is hard and even: the machine's, but what
differs between two flights is the ground's."""
NEVER_CHANGES = frozenset(
    {*OF_FLIGHT, *OF_PLACE, "battery_voltage", "trim_drift", "wake_interference",
     "gyroscopic_coupling", "spin_up_reaction", "dynamic_inflow", "sonar_tilt", "thrust_exponent"}
)  # fmt: skip
"""Those, noise, and laws of motion and flow that no damage changes."""
BATTERY_SPEED = 0.035
"""Std of the rotors' speed per command between two states of a battery: three cells from 12.6 to 10.5 V
are 0.18 of it, most flights begin charged and end at half; ours."""
STATED_DENSITY, GUESSED_DENSITY = 0.004, 0.03
"""Std of the air's density as a share of it: where both cards state it (1 K, 1 hPa), and where not
(10 K, 20 hPa); ours."""


def of_flights(flights: Sequence[OneFlight]) -> list[FreeParameter]:
    """The numbers that are each flight's own, or the second's beside the first.

    Args:
        flights: both.
    """
    model = HeliModel(flights[0].vehicle)
    found = []
    for f in flights:
        effects_here = [e for e in OF_FLIGHT if e in namable((), f.vehicle, f.flight)]
        found += [own(p, f.name) for e in effects_here for p in model.effect_parameters(e)]
    if not battery_is_logged(flights):
        found.append(
            FreeParameter(
                of_part(ROTOR_SPEED, B), 0.0, BATTERY_SPEED,
                -5.0 * BATTERY_SPEED, 5.0 * BATTERY_SPEED,
            )
        )  # fmt: skip
    stated = all("density" in f.flight.air for f in flights)
    density = flights[0].vehicle["air_density"].value
    share = STATED_DENSITY if stated else GUESSED_DENSITY
    found.append(FreeParameter(of_part("air_density", B), 0.0, share * density))
    for e in OF_PLACE:
        found += [own(p, B) for p in model.effect_parameters(e) if not is_shape(p.name)]
    return found


def own(f: FreeParameter, part: str) -> FreeParameter:
    """A number of one part alone, beside that of all."""
    reach = 5.0 * f.std
    return FreeParameter(of_part(f.name, part), 0.0, f.std, -reach, reach, f.probe, f.reading_only)


def is_shape(name: str) -> bool:
    """Whether a number says only how an effect acts, not how much."""
    effect, _, plain = name.partition(".")
    return any(p.shape for p in effects.CATALOGUE[effect].parameters if p.name == plain)


def battery_is_logged(flights: Sequence[OneFlight]) -> bool:
    """Whether every run of both flights has its battery's voltage."""
    return all(run.battery is not None for f in flights for run in f.flight.runs)


def candidates(flights: Sequence[OneFlight]) -> tuple[str, ...]:
    """Effects that both flights can show and that are the machine's."""
    of_each = [namable((), f.vehicle, f.flight) for f in flights]
    return tuple(e for e in of_each[0] if e in of_each[1] and e not in OF_FLIGHT)
