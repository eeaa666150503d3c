"""The injector's vehicles: numbers of two real classes, and vehicles drawn between 0.05 and 5 kg."""

import math
from pathlib import Path
from typing import NamedTuple

import numpy as np


class Craft(NamedTuple):
    """One vehicle in its air, SI units: the paper's Tables I-VI unless given. Thrust and torque
    coefficients are those of T = C_T rho pi R^4 w^2 and Q = C_Q rho pi R^5 w^2."""

    mass: float = 0.8
    radius: float = 0.25
    density: float = 1.14
    gravity: float = 9.804
    hub_upper: float = 0.185
    hub_lower: float = 0.105
    inertia_x: float = 5.33e-3
    inertia_y: float = 6.26e-3
    inertia_z: float = 2.50e-3
    rotor_upper: float = 7.66e-4
    rotor_lower: float = 7.66e-4
    bar: float = 2.55e-4
    flap_time: float = 0.05
    bar_time: float = 3.0
    swash_gain: float = 0.91
    bar_lon: float = 0.54
    bar_lat: float = 0.54
    thrust_upper: float = 7.18e-3
    thrust_lower: float = 4.98e-3
    torque_upper: float = 5.98e-4
    torque_lower: float = 5.20e-4
    body_length: float = 0.14
    body_width: float = 0.04


LAMA = Craft()
COAX = Craft(
    mass=0.302, radius=0.171, density=1.2, gravity=9.81, hub_upper=0.165, hub_lower=0.103,
    inertia_x=1.837e-3, inertia_y=1.87e-3, inertia_z=2.7786e-4,
    rotor_upper=8e-5, rotor_lower=8e-5, bar=3e-5, flap_time=0.05, bar_time=1.6,
    swash_gain=0.5176, bar_lon=0.613, bar_lat=0.613,
    thrust_upper=7.01338e-3, thrust_lower=9.78188e-3,
    torque_upper=1.80892e-3, torque_lower=1.62802e-3, body_length=0.1, body_width=0.05,
)  # fmt: skip
"""Skybotix CoaX as its vendor and pilot state it (M. Faessler, 2011); rotor and bar inertias, fuselage
and flap time are not stated and are estimates."""

CRAFTS = {"lama": LAMA, "coax": COAX}
SHIPPED = {LAMA: "lama400d", COAX: "skybotix_coax"}
"""Craft -> name of the vehicle file that every user has of it."""

LIGHTEST, HEAVIEST = 0.05, 5.0  # kg


def draw(rng: np.random.Generator) -> Craft:
    """A vehicle of any size: geometric similarity to the paper's, with scatter.

    Mass log-uniform; radius with its cube root; inertias with m R^2; time constants with 1/w, which is
    the square root of the radius. The principal inertias obey the triangle inequality.
    """

    def about(value: float, scatter: float) -> float:
        return float(value * math.exp(scatter * rng.standard_normal()))

    mass = float(math.exp(rng.uniform(math.log(LIGHTEST), math.log(HEAVIEST))))
    radius = about(0.25 * (mass / 0.8) ** (1.0 / 3.0), 0.08)
    size, slow = mass * radius**2, math.sqrt(radius / 0.25)
    inertia_x = about(0.14 * size, 0.2)
    inertia_z = about(0.04 * size, 0.2)
    lean = min(max(0.05 * rng.standard_normal(), -0.2), 0.2) * inertia_z / inertia_x
    rotor = about(0.012 * size, 0.2)
    thrust, torque = about(7e-3, 0.1), about(9e-4, 0.25)
    bar = about(0.55, 0.1)
    return Craft(
        mass=mass, radius=radius, density=1.2, gravity=9.81,
        hub_upper=about(0.74 * radius, 0.08), hub_lower=about(0.42 * radius, 0.08),
        inertia_x=inertia_x, inertia_y=inertia_x * (1.0 + lean), inertia_z=inertia_z,
        rotor_upper=rotor, rotor_lower=rotor, bar=about(0.3 * rotor, 0.2),
        flap_time=about(0.05 * slow, 0.15), bar_time=about(2.3 * slow, 0.2),
        swash_gain=about(0.7, 0.2), bar_lon=bar, bar_lat=bar,
        thrust_upper=thrust, thrust_lower=thrust * about(0.9, 0.1),
        torque_upper=torque, torque_lower=torque * about(0.9, 0.05),
        body_length=0.56 * radius, body_width=0.16 * radius,
    )  # fmt: skip


# --- a vehicle's own scales -------------------------------------------------------------------------


class Rotors(NamedTuple):
    """What follows from a craft's numbers: T / w^2 [N s2], Q / w^2 [N m s2], the fuselage's load per
    upper thrust, and the speeds [rad/s] at which thrust is the weight and the torques balance."""

    thrust_upper: float
    thrust_lower: float
    torque_upper: float
    torque_lower: float
    downwash: float
    hover_upper: float
    hover_lower: float


def rotors_of(craft: Craft) -> Rotors:
    """The rotors of a craft."""
    thrust = craft.density * math.pi * craft.radius**4
    torque = craft.density * math.pi * craft.radius**5
    t_u, t_l = craft.thrust_upper * thrust, craft.thrust_lower * thrust
    q_u, q_l = craft.torque_upper * torque, craft.torque_lower * torque
    load = craft.body_length * craft.body_width / (4.0 * math.pi * craft.radius**2)
    ratio = math.sqrt(q_u / q_l)
    hover = math.sqrt(craft.mass * craft.gravity / (t_u * (1.0 - load) + t_l * ratio**2))
    return Rotors(t_u, t_l, q_u, q_l, load, hover, hover * ratio)


def tilt_authority(craft: Craft) -> float:
    """Angular acceleration [rad/s2] per rad of swash tilt."""
    rotors = rotors_of(craft)
    lift = rotors.thrust_lower * rotors.hover_lower**2
    return craft.swash_gain * lift * craft.hub_lower / craft.inertia_x


def yaw_authority(craft: Craft) -> float:
    """Angular acceleration [rad/s2] per share by which the rotor speeds are moved apart."""
    rotors = rotors_of(craft)
    return 4.0 * rotors.torque_upper * rotors.hover_upper**2 / craft.inertia_z


# --- its file ---------------------------------------------------------------------------------------

_FILE = {
    "mass": ("mass", 0.01, "kg"), "gravity": ("gravity", 0.0, "m/s2"),
    "air_density": ("density", 0.0, "kg/m3"), "rotor_radius": ("radius", 0.0, "m"),
    "fuselage_length": ("body_length", 0.01, "m"), "fuselage_width": ("body_width", 0.01, "m"),
    "arm_upper": ("hub_upper", 0.01, "m"), "arm_lower": ("hub_lower", 0.01, "m"),
    "inertia_xx": ("inertia_x", 0.05, "kg m2"), "inertia_yy": ("inertia_y", 0.05, "kg m2"),
    "inertia_zz": ("inertia_z", 0.05, "kg m2"),
    "rotor_inertia_upper": ("rotor_upper", 0.05, "kg m2"),
    "rotor_inertia_lower": ("rotor_lower", 0.05, "kg m2"),
    "flybar_inertia": ("bar", 0.05, "kg m2"),
    "thrust_coefficient_upper": ("thrust_upper", 0.02, "1"),
    "thrust_coefficient_lower": ("thrust_lower", 0.02, "1"),
    "torque_coefficient_upper": ("torque_upper", 0.02, "1"),
    "torque_coefficient_lower": ("torque_lower", 0.02, "1"),
    "flap_time_constant": ("flap_time", 0.07, "s"),
    "flybar_time_constant": ("bar_time", 0.07, "s"),
    "swash_to_flap": ("swash_gain", 0.03, "1"), "flybar_to_rotor_lon": ("bar_lon", 0.03, "1"),
    "flybar_to_rotor_lat": ("bar_lat", 0.03, "1"),
}  # fmt: skip
"""Name in a vehicle file -> field, std as a share of the value, unit."""
_FIXED = {
    "fuselage_drag_coefficient": (1.0, 0.3, "1"), "flap_coupling_lon": (0.0, 0.0, "1"),
    "flap_coupling_lat": (0.0, 0.0, "1"),
}  # fmt: skip


MOST_SPREAD = 1.5  # std


def spread(craft: Craft, rng: np.random.Generator) -> Craft:
    """A vehicle that another one's file describes as well as files do.

    Every number is drawn about the file's, with its std, and never further off than MOST_SPREAD of it:
    what is further off may rightly be named.
    """
    changed = {}
    for field, share, _ in _FILE.values():
        off = min(max(rng.standard_normal(), -MOST_SPREAD), MOST_SPREAD)
        changed[field] = getattr(craft, field) * (1.0 + share * float(off))
    return craft._replace(**changed)


def write_vehicle(craft: Craft, path: Path) -> None:
    """A vehicle file that says what the craft is, as exactly as vehicles are usually known."""
    lines = ['name = "drawn"', 'description = "drawn for a study"', "[parameters]"]
    values = {n: (getattr(craft, f), s, unit) for n, (f, s, unit) in _FILE.items()}
    values |= _FIXED
    lines += [
        f'{name} = {{ value = {value!r}, std = {abs(value) * share!r}, unit = "{unit}",'
        ' source = "drawn" }'
        for name, (value, share, unit) in values.items()
    ]
    path.write_text("\n".join(lines) + "\n")
