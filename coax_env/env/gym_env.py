"""CoaxHeli-v0: a small coaxial helicopter for Gymnasium.

`CoaxEnv` is a thin shell over a fleet of one (fleet.py), as `CoaxVectorEnv` (vector_env.py) is over one
of many.
"""

from typing import Any

import gymnasium
import numpy as np

from coax_env.env import hover, tasks
from coax_env.env.actions import Nominal
from coax_env.env.fleet import Fleet
from coax_env.env.randomisation import Randomize, Wind
from coax_env.env.screen import RENDER_MODES, Screen, checked_render_mode
from coax_env.env.spaces import action_space, observation_space, observed
from coax_env.errors import InputError
from coax_env.model.layout import N_FULL, N_STATES
from coax_env.model.sensors import BASE_RATE
from coax_env.model.vehicle import Vehicle

_FPS = round(1.0 / hover.CONTROL_PERIOD)
_ALL = np.ones(1, dtype=np.bool_)


class CoaxEnv(gymnasium.Env[np.ndarray, np.ndarray]):
    """Fly a micro coaxial helicopter on its own noisy sensors: hover, hold a place, follow waypoints.

    ## Description
    The nonlinear model of Huynh et al. (2012), eqs (1)-(44), with whatever effects, sensors and
    limits of actuators the vehicle file has, at a control rate of 100 Hz. ``task="hover"``: stay at
    1.5 m over the start, heading north. ``"position"``: go to a position and a heading, and stay
    there. ``"waypoints"``: one after the other, each reached once the machine has been within 0.3 m
    and 15 deg of it for 0.5 s; the last of a list is held. ``"trajectory"``: follow a path in time, a
    circle, a figure eight, a lemniscate or one's own (`coax_env.env.paths`).

    ## Action Space
    ``Box(-1, 1, (4,), float32)``, about the hover trim of the *nominal* vehicle; larger actions are
    clipped.

    | number | command | meaning | -1 .. 1 |
    |---|---|---|---|
    | 0 | omega_u | speed of the upper rotor | trim -+ 15 % |
    | 1 | omega_l | speed of the lower rotor | trim -+ 15 % |
    | 2 | delta_lon | swash tilt, positive tilts the thrust back | trim -+ 0.2 rad |
    | 3 | delta_lat | swash tilt, positive tilts the thrust right | trim -+ 0.2 rad |

    Rotors and swash plate follow at once but for what the vehicle file has: the effects
    `motor_lag`, `motor_droop`, `servo_lag`, `servo_play`, `servo_deadband`, `servo_rate`,
    `servo_delay`, `command_delay` and `battery_sag`, and ``[actuators]``, limits of travel, speed
    and rates.

    ## Observation Space
    ``Box(low, high, (n,), float32)``; ``observation_names`` and ``observation_units`` say what
    every entry is; noise is a std. ``sensors="onboard"``, n = 18:

    | number | entry | unit | low | high | noise | rate |
    |---|---|---|---|---|---|---|
    | 0 | rpm_upper | rev/min | 0 | 4000 | 2 | 100 Hz |
    | 1 | rpm_lower | rev/min | 0 | 4000 | 2 | 100 Hz |
    | 2 | p | rad/s | -8.727 | 8.727 | 0.0349 | 100 Hz |
    | 3 | q | rad/s | -8.727 | 8.727 | 0.0349 | 100 Hz |
    | 4 | r | rad/s | -8.727 | 8.727 | 0.0349 | 100 Hz |
    | 5 | ax | m/s2 | -58.84 | 58.84 | 0.1 | 100 Hz |
    | 6 | ay | m/s2 | -58.84 | 58.84 | 0.1 | 100 Hz |
    | 7 | az | m/s2 | -58.84 | 58.84 | 0.1 | 100 Hz |
    | 8 | phi | rad | -3.142 | 3.142 | 0.00873 | 40 Hz |
    | 9 | theta | rad | -1.571 | 1.571 | 0.00873 | 40 Hz |
    | 10 | psi | rad | -3.142 | 3.142 | 0.00873 | 40 Hz |
    | 11 | h | m | 0.15 | 6.5 | 0.05 | 20 Hz |
    | 12 | vn | m/s | -30 | 30 | 0.2 | 10 Hz |
    | 13 | ve | m/s | -30 | 30 | 0.2 | 10 Hz |
    | 14 | vd | m/s | -30 | 30 | 0.2 | 10 Hz |
    | 15 | new_compass | 1 | 0 | 1 |  |  |
    | 16 | new_sonar | 1 | 0 | 1 |  |  |
    | 17 | new_velocity | 1 | 0 | 1 |  |  |

    What the entries are, in the body's axes x forward, y right, z down where not said otherwise:

    | entry | meaning |
    |---|---|
    | rpm_upper, rpm_lower | speeds of the rotors |
    | p, q, r | gyros: roll, pitch and yaw rate |
    | ax, ay, az | accelerometers at the centre of gravity: acceleration less gravity |
    | phi, theta, psi | compass: roll, pitch, heading (0 north, clockwise from above) |
    | h | sonar: height over ground, upwards |
    | vn, ve, vd | velocity north, east, down |
    | v | speed of the whole velocity (``paper``) |
    | pn, pe | motion capture: place north, east of the start |
    | new_compass, new_sonar, new_velocity | 1: this instrument's readings are new in this step |
    | target_forward, target_right, target_up | way to the target, in the heading's axes |
    | heading_error | turn to the target's heading, clockwise |

    An instrument slower than 100 Hz holds its last value, and has a flag that is 1 where it is new.
    ``paper``: p q r ax ay az h v, all at 100 Hz. ``mocap``: ``onboard`` with pn, pe (2 mm, 100 Hz)
    before the flags. ``state``: the sixteen states, rotor speeds and swash tilt, exact. What the
    vehicle file says under ``[sensors]`` takes the place of the suite's numbers (not in ``state``):
    noise, bias (its std: drawn for every flight), rate, delay, limits, and dropout, the share of
    lost samples, as of a sonar's echoes: the last value is held, and its flag is 0. The previous
    action is not observed: whoever gave it knows it.

    ``position``, ``waypoints`` and ``trajectory`` append the way to the target by the readings, in the
    heading's axes; they need ``mocap`` or ``state``, and other sensors are an InputError. With
    ``mocap``:

    | 20 | target_forward | m | -50 | 50 |  |  |
    | 21 | target_right | m | -50 | 50 |  |  |
    | 22 | target_up | m | -10 | 10 |  |  |
    | 23 | heading_error | rad | -3.142 | 3.142 |  |  |

    ``trajectory`` appends, after these, how the target moves, in the heading's axes: path_forward,
    path_right, path_up [m/s], path_turn [rad/s], and path_forward_acceleration,
    path_right_acceleration, path_up_acceleration [m/s2].

    ## Rewards
    A weighted sum of terms 1/(1 + |error|/scale) about the target, in (0, 1]: alive (1), height,
    position (horizontal), speed, heading, rates, effort (of the action); scales and weights of each
    task in `coax_env.env.tasks`. ``waypoints`` adds ``reached``, 50 for each waypoint.
    ``info["reward_terms"]`` has the weighted terms by name. Weights, and in brackets the error
    that halves the term (m, m/s, deg, deg/s, and 1 for the action):

    | term | hover | position | waypoints | trajectory |
    |---|---|---|---|---|
    | alive | 0.1 | 0.1 | 0.1 | 0.1 |
    | height | 0.2 (0.25) | 0.2 (0.25) | 0.2 (0.25) | 0.2 (0.25) |
    | position | 0.1 (2) | 0.25 (0.5) | 0.35 (1) | 0.4 (0.25) |
    | speed | 0.3 (1) | 0.15 (1) | 0.05 (2) | 0 (1) |
    | heading | 0.15 (20) | 0.15 (20) | 0.15 (20) | 0.15 (20) |
    | rates | 0.05 (60) | 0.05 (60) | 0.05 (60) | 0.05 (60) |
    | effort | 0.1 (0.5) | 0.1 (0.5) | 0.1 (0.5) | 0.1 (0.5) |
    | reached | - | - | 50 | - |

    ## Starting State
    Uniform: tilt +-5 deg, heading +-20 deg, rates +-10 deg/s, velocity +-0.3 m/s per axis, height
    1.5 +- 0.3 m, at the origin; rotors at the nominal trim. ``reset(options={"state": x})`` starts
    from a state (16,) or (29,) instead. Targets that are not given are drawn, north and east of the
    origin +-1 m, height 1 to 2 m, heading +-45 deg in ``position``; +-2 m, 1 to 2.5 m and any
    heading in ``waypoints``.

    ## Episode End
    Terminated: height under 0.05 or over 6 m, tilt over 60 deg, 25 m from the origin, 15 m/s, or a
    state that is not a number (as after an action that is not); never by success. Truncated after
    2000 steps, 20 s (the TimeLimit of `gymnasium.make`). `coax_env.env.tasks.succeeded` judges a
    flight.

    ## Arguments
    - ``vehicle``: shipped name, path, or Vehicle: what flies.
    - ``nominal``: the vehicle whose trim centres the action; default the shipped bare one of the
      same name, else `vehicle` without its effects. Or (trim, scale), as controllers store it.
    - ``sensors``: ``"onboard"``, ``"paper"``, ``"mocap"`` or ``"state"``.
    - ``wind``: None, (north, east) in m/s, a speed whose direction is drawn at each reset, or
      {"speed": (low, high)}, drawn with it.
    - ``turbulence``: None, ``"light"``, ``"moderate"``, ``"severe"``, or the mean wind at 6 m in
      m/s whose Dryden turbulence blows (`coax_env.env.turbulence`); the mean itself is ``wind``. Both
      act through the vehicle's drag, damping and blow-back: the bare model has none and feels
      nothing.
    - ``gusts``: None, or the std of gust force [N] and moment [N m], memory 0.5 s; any vehicle
      feels them.
    - ``randomize``: what each flight draws. None; ``"posterior"``: a vehicle from the file's
      spread; {parameter: (low, high)}: uniform numbers, as ``{"mass": (0.7, 0.9),
      "ground_effect.gain": (0, 0.3)}``; or a list of vehicles (names, paths, Vehicles), each as
      likely.
    - ``render_mode``: None, ``"rgb_array"`` or ``"human"``.
    - ``task``: ``"hover"``, ``"position"``, ``"waypoints"`` or ``"trajectory"``.
    - ``target``: (north, east, height, heading) in m and rad, for ``waypoints`` one or several;
      None: drawn. For ``trajectory``: ``"circle"``, ``"figure_eight"``, ``"lemniscate"``, {"shape":
      name, "size": m, "period": s}, or a table with the columns t, north, east, height and, if it
      likes, heading: its rows or the path of a CSV. None: the circle.
    - ``control_rate``: 100 Hz, or that over a whole number: 50, 25, 20, 10 ... An action is then held
      for so many periods of 0.01 s, rewards are their sum, flags tell of any new reading among
      them; readings, physics and turbulence stay at 100 Hz, and the 2000 steps of the time limit last
      longer. No more than 100 Hz: rates, delays and dropout of the sensors, the batch's rows and the
      filters' gains are counted in periods of 0.01 s, the paper's log.

    Actions that mean rates and thrust, or a velocity: `controllers.action_levels`.

    ## Info
    ``state``, the true full state (29,), `coax_env.model.layout.FULL_STATES`; ``target``, x y z psi in
    force, (4,), where the task has one; ``target_rates``, theirs, of a path; ``reached``, waypoints so
    far; after a reset with ``randomize``, ``vehicle``: the numbers drawn, by name.

    | state | name | unit |
    |---|---|---|
    | 0-2 | u v w: velocity forward, right, down in the body's axes | m/s |
    | 3-5 | p q r: roll, pitch, yaw rate | rad/s |
    | 6-9 | alpha_l beta_l, alpha_f beta_f: tilt of the lower disc and of the stabiliser bar | rad |
    | 10-12 | phi theta psi: roll, pitch, heading | rad |
    | 13-15 | x y z: place north, east, down of the start on the ground | m |
    | 16, 17 | omega_u omega_l: speeds of the rotors | rad/s |
    | 18, 19 | swash_lon swash_lat: tilt of the swash plate | rad |
    | 20-25 | gust_X .. gust_N: force and moment of ``gusts`` | N, N m |
    | 26, 27 | trim_Z trim_N: drift of thrust and torque, which estimators use; 0 here | N, N m |
    | 28 | inflow: induced velocity over that of hover, less one | 1 |

    ## Version History
    - v0: first.
    """

    metadata = {"render_modes": list(RENDER_MODES), "render_fps": _FPS}  # noqa: RUF012

    def __init__(
        self,
        vehicle: str | Vehicle = "lama400d",
        nominal: Nominal = None,
        sensors: str = "onboard",
        wind: Wind = None,
        gusts: tuple[float, float] | None = None,
        randomize: Randomize = None,
        render_mode: str | None = None,
        turbulence: float | str | None = None,
        task: str = "hover",
        target: Any = None,
        control_rate: float = BASE_RATE,
    ) -> None:
        self.render_mode = checked_render_mode(render_mode)
        self.fleet = Fleet(
            1, vehicle, nominal, sensors, wind, gusts, randomize,
            turbulence=turbulence, task=task, target=target, control_rate=control_rate,
        )  # fmt: skip
        entries = observed(self.fleet)
        self.observation_space = observation_space(entries)
        self.action_space = action_space()
        self.observation_names = tuple(entry.name for entry in entries)
        self.observation_units = tuple(entry.unit for entry in entries)
        self._terms = self.fleet.task.terms
        if self.fleet.periods > 1:
            self.metadata = {**self.metadata, "render_fps": round(control_rate)}
        self._screen = Screen(self.fleet, render_mode)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start a new flight; with a seed, from the beginning of that seed's random stream."""
        fresh = self._np_random is None
        super().reset(seed=seed)
        if seed is not None:
            self.fleet.seed(0, seed)
        elif fresh:
            self.fleet.seed(0, int(self.np_random.integers(2**63)))
        observation = self.fleet.restart(_ALL, start_states(options, 1))[0]
        self._screen.update()
        info = self._info()
        if self.fleet.draws.random:
            drawn = self.fleet.drawn[0].tolist()
            info["vehicle"] = dict(zip(self.fleet.draws.names, drawn, strict=True))
        return observation, info

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """One step of 1/control_rate seconds."""
        outcome = self.fleet.fly_held(np.asarray(action, dtype=np.float64).reshape(1, 4), _ALL)
        if self.render_mode is not None:
            self._screen.update()
        info = self._info()
        terms = outcome.terms.tolist()[0]
        info["reward_terms"] = dict(zip(self._terms, terms))  # noqa: B905 - strict is slow
        reward, over = outcome.rewards.item(), outcome.over.item()
        return outcome.observations[0], reward, over, False, info

    def render(self) -> np.ndarray | None:
        """The picture (540, 960, 3), uint8, in mode ``rgb_array``; ``human`` shows it, every 40 ms."""
        return self._screen.pictures([0])[0] if self.render_mode == "rgb_array" else None

    def close(self) -> None:
        """Close the window, if there is one."""
        self._screen.close()

    def _info(self) -> dict[str, Any]:
        fleet = self.fleet
        info: dict[str, Any] = {"state": fleet.x[0].copy()}
        if fleet.task.shows_target:
            info["target"] = fleet.targets[0].copy()
        if fleet.task.follows_path:
            info["target_rates"] = fleet.target_rates[0]
        if fleet.task.moves_on:
            info["reached"] = int(fleet.progress[0, tasks.REACHED])
        return info


def start_states(options: dict[str, Any] | None, count: int) -> np.ndarray | None:
    """``options["state"]`` of a reset for so many helicopters, (count, 16 or 29); None without."""
    if not options or "state" not in options:
        return None
    states = np.asarray(options["state"], dtype=float)
    if states.shape[-1:] not in ((N_STATES,), (N_FULL,)) or states.ndim > 2:
        raise InputError(f"options['state'] must be ({N_STATES},) or ({N_FULL},) per helicopter")
    return np.broadcast_to(states, (count, states.shape[-1]))
