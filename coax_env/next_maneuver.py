"""Which maneuver parts effects that these flights cannot tell apart.

For now a table of what is known to separate the usual look-alikes (design/effects.md); designing the
maneuver by the distance of the tied predictions comes with the diagnosis issue.
"""

from collections.abc import Sequence
from typing import Any

PARTED_BY: tuple[tuple[frozenset[str], str, str], ...] = (
    (frozenset({"swash_offset", "cg_offset"}), "heave_3211",
     "a centre of gravity off the mast follows the total thrust, rigging follows the lower rotor's"),
    (frozenset({"wind", "swash_offset"}), "heading_turn",
     "wind keeps its direction over the ground while a rigging error turns with the machine"),
    (frozenset({"wind", "cg_offset"}), "heading_turn",
     "wind keeps its direction over the ground while the centre of gravity turns with the machine"),
    (frozenset({"wind", "attitude_bias"}), "heading_turn",
     "wind keeps its direction over the ground while a sensor's bias turns with the machine"),
    (frozenset({"ground_effect", "axial_damping"}), "low_hover",
     "height below 0.5 m changes the ground's share and hardly any speed"),
    (frozenset({"airframe_drag", "rotor_drag"}), "forward_run",
     "above 3 m/s the square law of the airframe leaves the rotor's straight line"),
    (frozenset({"rotor_drag", "flap_blowback"}), "forward_run",
     "a run in speed changes the ratio of force to moment"),
    (frozenset({"servo_lag", "servo_delay"}), "lon_3211",
     "steps shorter than a third of a second show the shape of the servo's answer"),
    (frozenset({"motor_lag", "spin_up_reaction"}), "yaw_3211",
     "quick differential rotor speed parts the reaction (at once) from the lag (later)"),
    (frozenset({"torque_balance", "yaw_inertia"}), "yaw_3211",
     "a torque out of balance is steady, a wrong inertia shows only while turning"),
    (frozenset({"swash_gain", "hub_stiffness"}), "lon_3211",
     "thrust changes the one moment and not the other: 3-2-1-1 at two thrust levels"),
    (frozenset({"added_mass", "thrust_scale"}), "heave_3211",
     "weight is constant, thrust follows the square of the rotor speed"),
)  # fmt: skip


def advise(ties: Sequence[tuple[str, str]]) -> dict[str, Any] | None:
    """The maneuver of `findings.json` for the first tied pair that the table knows, or None."""
    for first, second in ties:
        for pair, maneuver, why in PARTED_BY:
            if pair == {first, second}:
                return {"maneuver": maneuver, "separates": [first, second], "why": why}
    if ties:
        first, second = ties[0]
        return {
            "maneuver": "lon_3211",
            "separates": [first, second],
            "why": "no entry for this pair yet: a rich input on all axes is the best known answer",
        }
    return None
