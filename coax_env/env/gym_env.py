"""CoaxHeli-v0: a small coaxial helicopter for Gymnasium, one or many.

Both envs are thin shells over the same batch kernel (fleet.py); `CoaxEnv` is a fleet of one.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from coax_env.env import hover, tasks
from coax_env.env.fleet import Fleet, Nominal
from coax_env.env.randomisation import Randomize
from coax_env.env.spaces import action_space, observation_space, observed
from coax_env.errors import InputError
from coax_env.model.layout import N_FULL, N_STATES
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
    and 15 deg of it for 0.5 s; the last of a list is held.

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
    `motor_lag`, `servo_lag`, `servo_delay` and `battery_sag`, and ``[actuators]``, limits of
    travel, speed and rates.

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

    An instrument slower than 100 Hz holds its last value, and has a flag that is 1 where it is new.
    ``paper``: p q r ax ay az h v, all at 100 Hz. ``mocap``: ``onboard`` with pn, pe (2 mm, 100 Hz)
    before the flags. ``state``: the sixteen states, rotor speeds and swash tilt, exact. What the
    vehicle file says under ``[sensors]`` takes the place of the suite's numbers (not in ``state``):
    noise, bias (its std: drawn for every flight), rate, delay, limits, and dropout, the share of
    lost samples, as of a sonar's echoes: the last value is held, and its flag is 0. The previous
    action is not observed: whoever gave it knows it.

    ``position`` and ``waypoints`` append the way to the target as the readings tell it, in the
    heading's axes; they need ``mocap`` or ``state``, and other sensors are an InputError. With
    ``mocap``:

    | 20 | target_forward | m | -50 | 50 |  |  |
    | 21 | target_right | m | -50 | 50 |  |  |
    | 22 | target_up | m | -10 | 10 |  |  |
    | 23 | heading_error | rad | -3.142 | 3.142 |  |  |

    ## Rewards
    A weighted sum of terms 1/(1 + |error|/scale) about the target, in (0, 1]: alive (1), height,
    position (horizontal), speed, heading, rates, effort (of the action); scales and weights of each
    task in `coax_env.env.tasks`. ``waypoints`` adds ``reached``, 50 for each waypoint.
    ``info["reward_terms"]`` has the weighted terms by name.

    ## Starting State
    Uniform: tilt +-5 deg, heading +-20 deg, rates +-10 deg/s, velocity +-0.3 m/s per axis, height
    1.5 +- 0.3 m, at the origin; rotors at the nominal trim. ``reset(options={"state": x})`` starts
    from a state (16,) or (26,) instead. Targets that are not given are drawn, north and east of the
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
    - ``wind``: None, (north, east) in m/s, or a speed whose direction is drawn at each reset.
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
    - ``task``: ``"hover"``, ``"position"`` or ``"waypoints"``.
    - ``target``: (north, east, height, heading) in m and rad, for ``waypoints`` one or several;
      None: drawn.

    ## Info
    ``state``, the true full state (26,), `coax_env.model.layout.FULL_STATES`; ``target``, x y z psi in
    force, (4,), where the task has one; ``reached``, waypoints so far; after a reset with
    ``randomize``, ``vehicle``: the numbers drawn, by name.

    ## Version History
    - v0: first.
    """

    metadata = {"render_modes": ["human", "rgb_array"], "render_fps": _FPS}  # noqa: RUF012

    def __init__(
        self,
        vehicle: str | Vehicle = "lama400d",
        nominal: Nominal = None,
        sensors: str = "onboard",
        wind: float | Sequence[float] | None = None,
        gusts: tuple[float, float] | None = None,
        randomize: Randomize = None,
        render_mode: str | None = None,
        turbulence: float | str | None = None,
        task: str = "hover",
        target: Any = None,
    ) -> None:
        self.render_mode = _render_mode(render_mode)
        self.fleet = Fleet(
            1, vehicle, nominal, sensors, wind, gusts, randomize,
            turbulence=turbulence, task=task, target=target,
        )  # fmt: skip
        entries = observed(self.fleet)
        self.observation_space = observation_space(entries)
        self.action_space = action_space()
        self.observation_names = tuple(entry.name for entry in entries)
        self.observation_units = tuple(entry.unit for entry in entries)
        self._terms = self.fleet.task.terms
        self._screen = _Screen(self.fleet, render_mode)

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
        observation = self.fleet.restart(_ALL, _start_states(options, 1))[0]
        self._screen.moved()
        info = self._told()
        if self.fleet.draws.random:
            drawn = self.fleet.drawn[0].tolist()
            info["vehicle"] = dict(zip(self.fleet.draws.names, drawn, strict=True))
        return observation, info

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """One control period of 0.01 s."""
        outcome = self.fleet.fly(np.array(action, dtype=np.float64).reshape(1, 4), _ALL)
        if self.render_mode is not None:
            self._screen.moved()
        info = self._told()
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

    def _told(self) -> dict[str, Any]:
        fleet = self.fleet
        info: dict[str, Any] = {"state": fleet.x[0].copy()}
        if fleet.task.aims:
            info["target"] = fleet.targets[0].copy()
        if fleet.task.moves_on:
            info["reached"] = int(fleet.progress[0, tasks.REACHED])
        return info


class CoaxVectorEnv(VectorEnv[np.ndarray, np.ndarray, np.ndarray]):
    """Many `CoaxEnv` in one compiled batch; row i seeded s flies as a single env seeded s + i.

    Arguments are those of `CoaxEnv`, and

    - ``num_envs``: number of helicopters.
    - ``max_episode_steps``: the time limit; None for none.
    - ``autoreset_mode``: NEXT_STEP (default), SAME_STEP (``info["final_obs"]`` and
      ``info["final_info"]`` then hold what the flight ended with, row by row) or DISABLED (an ended
      row stays as it is until ``reset(options={"reset_mask": mask})``).
    - ``threads``: at most so many; default one per 256 rows and processor.

    Infos are those of `CoaxEnv` with a first axis of num_envs, and masks ``_NAME`` as Gymnasium has
    them: ``info["state"]`` is (num_envs, 26) and read-only, ``info["reward_terms"]`` and
    ``info["vehicle"]`` (where rows have started anew) are dicts of (num_envs,). ``render`` gives one
    picture per row.
    """

    def __init__(
        self,
        num_envs: int = 1,
        vehicle: str | Vehicle = "lama400d",
        nominal: Nominal = None,
        sensors: str = "onboard",
        wind: float | Sequence[float] | None = None,
        gusts: tuple[float, float] | None = None,
        randomize: Randomize = None,
        render_mode: str | None = None,
        max_episode_steps: int | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        threads: int | None = None,
        turbulence: float | str | None = None,
        task: str = "hover",
        target: Any = None,
    ) -> None:
        if num_envs < 1:
            raise InputError(f"num_envs must be at least 1, found {num_envs}")
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        self.metadata = {**CoaxEnv.metadata, "autoreset_mode": self.autoreset_mode}
        self.render_mode = _render_mode(render_mode)
        self.num_envs = num_envs
        self.max_episode_steps = max_episode_steps
        self.fleet = Fleet(
            num_envs, vehicle, nominal, sensors, wind, gusts, randomize, threads,
            turbulence, task, target,
        )  # fmt: skip
        entries = observed(self.fleet)
        self.single_observation_space = observation_space(entries)
        self.single_action_space = action_space()
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.observation_names = tuple(entry.name for entry in entries)
        self.observation_units = tuple(entry.unit for entry in entries)
        self._ended = np.zeros(num_envs, dtype=np.bool_)
        self._every = np.ones(num_envs, dtype=np.bool_)
        self._seeded = False
        self._screen = _Screen(self.fleet, render_mode)

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start new flights in all rows, or in those of ``options["reset_mask"]``.

        Args:
            seed: row i gets the stream of seed + i, or of seed[i]; None: streams go on.
        """
        which = np.asarray((options or {}).get("reset_mask", self._every), dtype=np.bool_)
        if which.shape != (self.num_envs,):
            raise InputError(f"reset_mask must have shape ({self.num_envs},), found {which.shape}")
        first = seed if isinstance(seed, int | np.integer) else None
        super().reset(seed=first)
        if seed is None and not self._seeded:
            first = int(self.np_random.integers(2**62))
        if first is not None:
            seeds: list[int | None] = [int(first) + i for i in range(self.num_envs)]
        else:
            seeds = [None] * self.num_envs if seed is None else list(seed)  # type: ignore[arg-type]
        if len(seeds) != self.num_envs:
            raise InputError(f"seed must be one number or {self.num_envs}, found {len(seeds)}")
        for i, row_seed in enumerate(seeds):
            if row_seed is None and not self._seeded:
                row_seed = int(self.np_random.integers(2**62))
            if row_seed is not None and (which[i] or not self._seeded):
                self.fleet.seed(i, row_seed)
        self._seeded = True
        self._ended &= ~which
        self.fleet.x = self.fleet.x.copy()
        observations = self.fleet.restart(which, _start_states(options, self.num_envs))
        self._screen.moved()
        return observations, self._told(which) | self._vehicles(which)

    def step(
        self, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """One control period of every row; ended rows as `autoreset_mode` says."""
        fleet, ended = self.fleet, self._ended
        waiting = ended.any()
        active = ~ended if waiting else self._every
        anew = ended if waiting and self.autoreset_mode == AutoresetMode.NEXT_STEP else None
        commands = np.array(actions, dtype=np.float64).reshape(self.num_envs, 4)
        outcome = fleet.fly(commands, active, anew)
        terminated = outcome.over
        truncated = np.zeros(self.num_envs, dtype=np.bool_)
        if self.max_episode_steps is not None:
            truncated = (fleet.rows >= self.max_episode_steps) & active
        observations = outcome.observations
        info: dict[str, Any] = {}
        done = terminated | truncated
        if self.autoreset_mode == AutoresetMode.NEXT_STEP:
            if waiting:
                info |= self._vehicles(ended)
            self._ended = done
        elif self.autoreset_mode == AutoresetMode.DISABLED:
            terminated = terminated | ended
            self._ended = ended | done
        elif done.any():
            info["final_obs"] = observations.copy()
            info["final_info"] = self._step_info(outcome.terms)
            info["_final_obs"] = info["_final_info"] = done
            fleet.x = fleet.x.copy()
            fleet.restart(done, observations=observations)
            info |= self._vehicles(done)
        info |= self._step_info(outcome.terms)
        self._screen.moved()
        return observations, outcome.rewards, terminated, truncated, info

    def render(self) -> tuple[np.ndarray, ...] | None:
        """One picture per row in mode ``rgb_array``; ``human`` shows the first row's."""
        rows = range(self.num_envs)
        return self._screen.pictures(rows) if self.render_mode == "rgb_array" else None

    def close_extras(self, **kwargs: Any) -> None:
        """Close the window, if there is one."""
        self._screen.close()

    def _step_info(self, terms: np.ndarray) -> dict[str, Any]:
        named = {name: terms[:, k] for k, name in enumerate(self.fleet.task.terms)}
        every = self._every.copy()
        return self._told(every) | {"reward_terms": _masked(named, every), "_reward_terms": every}

    def _told(self, which: np.ndarray) -> dict[str, Any]:
        fleet = self.fleet
        state = fleet.x.view()
        state.flags.writeable = False
        info: dict[str, np.ndarray] = {"state": state}
        if fleet.task.aims:
            info["target"] = fleet.targets.copy()
        if fleet.task.moves_on:
            info["reached"] = fleet.progress[:, tasks.REACHED].copy()
        return _masked(info, which.copy())

    def _vehicles(self, which: np.ndarray) -> dict[str, Any]:
        """What the rows of a mask drew, where vehicles are drawn."""
        draws = self.fleet.draws
        if not draws.random:
            return {}
        drawn, which = self.fleet.drawn.copy(), which.copy()
        named = {name: drawn[:, k] for k, name in enumerate(draws.names)}
        return {"vehicle": _masked(named, which), "_vehicle": which}


def _masked(info: Mapping[str, np.ndarray], which: np.ndarray) -> dict[str, Any]:
    """Gymnasium's form of a batch's info: with every key, which rows have it."""
    return {**info, **{f"_{name}": which for name in info}}


def _render_mode(render_mode: str | None) -> str | None:
    modes = CoaxEnv.metadata["render_modes"]
    if render_mode not in (None, *modes):
        raise InputError(f"render_mode must be None, {' or '.join(modes)}, found {render_mode!r}")
    return render_mode


class _Screen:
    """Pictures of a fleet, where they are wanted; drawing is imported with the first of them."""

    def __init__(self, fleet: Fleet, render_mode: str | None) -> None:
        self._fleet, self._mode = fleet, render_mode
        self._renderer: Any = None
        self._traces: Any = None
        if render_mode is not None:
            from coax_env.env.rendering import Renderer
            from coax_env.env.scene import Traces

            self._renderer, self._traces = Renderer(), Traces(fleet)

    def moved(self) -> None:
        """The fleet has reset or flown a row: remember it, and show it on a screen now and then."""
        if self._mode is None:
            return
        from coax_env.env.rendering import HUMAN_EVERY

        self._traces.record()
        if self._mode == "human" and self._fleet.rows[0] % HUMAN_EVERY == 0:
            self._renderer.show(self._traces.view(0))

    def pictures(self, rows: Iterable[int]) -> tuple[np.ndarray, ...]:
        """One picture of each row."""
        return tuple(self._renderer.picture(self._traces.view(row)) for row in rows)

    def close(self) -> None:
        if self._renderer is not None:
            self._renderer.close()


def _start_states(options: dict[str, Any] | None, count: int) -> np.ndarray | None:
    if not options or "state" not in options:
        return None
    states = np.asarray(options["state"], dtype=float)
    if states.shape[-1:] not in ((N_STATES,), (N_FULL,)) or states.ndim > 2:
        raise InputError(f"options['state'] must be ({N_STATES},) or ({N_FULL},) per helicopter")
    return np.broadcast_to(states, (count, states.shape[-1]))
