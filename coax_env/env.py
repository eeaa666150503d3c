"""CoaxHeli-v0: the hover task for Gymnasium, one helicopter or many.

Both envs are thin shells over the same batch kernel (fleet.py); `CoaxEnv` is a fleet of one.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from coax_env import hover, tasks
from coax_env.errors import InputError
from coax_env.fleet import Fleet, Nominal
from coax_env.layout import N_FULL, N_STATES
from coax_env.randomisation import Randomize
from coax_env.vehicle import Vehicle

_FPS = round(1.0 / hover.CONTROL_PERIOD)
_ALL = np.ones(1, dtype=np.bool_)


class CoaxEnv(gymnasium.Env[np.ndarray, np.ndarray]):
    """Hover a micro coaxial helicopter on its own noisy sensors.

    ## Description
    The nonlinear model of Huynh et al. (2012), eqs (1)-(44), with whatever effects the vehicle file
    has, at a control rate of 100 Hz. The machine shall stay at 1.5 m over its start, heading north.

    ## Action Space
    ``Box(-1, 1, (4,), float32)``, about the hover trim of the *nominal* vehicle; larger actions are
    clipped. Servo and rotor rates are limited only where the vehicle has `servo_lag`, `motor_lag`.

    | number | action | -1 .. 1 |
    |---|---|---|
    | 0 | speed of the upper rotor | trim -15 % .. trim +15 % |
    | 1 | speed of the lower rotor | trim -15 % .. trim +15 % |
    | 2 | swash tilt, longitudinal (positive tilts the thrust back) | trim -0.2 .. trim +0.2 rad |
    | 3 | swash tilt, lateral (positive tilts the thrust right) | trim -0.2 .. trim +0.2 rad |

    ## Observation Space
    ``Box(low, high, (n,), float32)``, SI units and rev/min, with the bounds of `coax_env.sensors`.
    ``env.unwrapped.observation_names`` names every entry. ``onboard``, n = 18:

    | numbers | reading | noise | rate |
    |---|---|---|---|
    | 0-1 | rpm_upper, rpm_lower | 2 rev/min | 100 Hz |
    | 2-4 | p, q, r | 2 deg/s | 100 Hz |
    | 5-7 | ax, ay, az | 0.1 m/s2 | 100 Hz |
    | 8-10 | phi, theta, psi (wrapped) | 0.5 deg | 40 Hz |
    | 11 | h | 0.05 m | 20 Hz |
    | 12-14 | vn, ve, vd | 0.2 m/s | 10 Hz |
    | 15-17 | compass, sonar, velocity: 1 where new, else the last value is held | | |

    ``paper``: p q r ax ay az h v, all at 100 Hz. ``mocap``: ``onboard`` with pn, pe (2 mm, 100 Hz)
    before the flags. ``state``: the sixteen states, rotor speeds and swash tilt, exact. The
    previous action is not observed: whoever gave it knows it.

    ## Rewards
    A weighted sum in (0, 1] of terms 1/(1 + |error|/scale): alive (1), height, position, speed,
    heading, rates, effort (of the action); scales and weights in `coax_env.hover`.
    ``info["reward_terms"]`` has the weighted terms.

    ## Starting State
    Uniform: tilt +-5 deg, heading +-20 deg, rates +-10 deg/s, velocity +-0.3 m/s per axis, height
    1.5 +- 0.3 m; rotors at the nominal trim. ``reset(options={"state": x})`` starts from a state
    (16,) or (26,) instead.

    ## Episode End
    Terminated: height under 0.05 or over 6 m, tilt over 60 deg, 25 m from the start, 15 m/s, or a
    state that is not a number (as after an action that is not). Truncated after 2000 steps, 20 s
    (the TimeLimit of `gymnasium.make`).

    ## Arguments
    - ``vehicle``: shipped name, path, or Vehicle: what flies.
    - ``nominal``: the vehicle whose trim centres the action; default the shipped bare one of the
      same name, else `vehicle` without its effects. Or (trim, scale), as controllers store it.
    - ``sensors``: ``"onboard"``, ``"paper"``, ``"mocap"`` or ``"state"``.
    - ``wind``: None, (north, east) in m/s, or a speed whose direction is drawn at each reset. The
      wind acts only on a vehicle with a drag or blow-back.
    - ``gusts``: None, or the std of gust force [N] and moment [N m], memory 0.5 s.
    - ``randomize``: None, or ``"posterior"``: every flight draws a vehicle from the file's spread
      (``info["vehicle"]``).

    ``info["state"]`` is the true full state (26,), `coax_env.layout.FULL_STATES`.

    ## Version History
    - v0: first.
    """

    metadata = {"render_modes": [], "render_fps": _FPS}  # noqa: RUF012 - Gymnasium's form

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
        _check_render_mode(render_mode)
        self.render_mode = render_mode
        self.fleet = Fleet(
            1, vehicle, nominal, sensors, wind, gusts, randomize,
            turbulence=turbulence, task=task, target=target,
        )  # fmt: skip
        self.observation_space = observation_space(self.fleet)
        self.action_space = action_space()
        self.observation_names = observation_names(self.fleet)
        self._terms = tuple(enumerate(self.fleet.task.terms))

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
        info = self._told()
        if self.fleet.draws.random:
            drawn = self.fleet.drawn[0].tolist()
            info["vehicle"] = dict(zip(self.fleet.draws.names, drawn, strict=True))
        return observation, info

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """One control period of 0.01 s."""
        outcome = self.fleet.fly(np.array(action, dtype=np.float64).reshape(1, 4), _ALL)
        terms = outcome.terms[0].tolist()
        info = self._told()
        info["reward_terms"] = {name: terms[k] for k, name in self._terms}
        reward = float(outcome.rewards[0])
        return outcome.observations[0], reward, bool(outcome.over[0]), False, info

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

    ``info["state"]`` is (num_envs, 26), ``info["reward_terms"]`` a dict of (num_envs,).
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
        _check_render_mode(render_mode)
        if num_envs < 1:
            raise InputError(f"num_envs must be at least 1, found {num_envs}")
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        self.metadata = {**CoaxEnv.metadata, "autoreset_mode": self.autoreset_mode}
        self.render_mode = render_mode
        self.num_envs = num_envs
        self.max_episode_steps = max_episode_steps
        self.fleet = Fleet(
            num_envs, vehicle, nominal, sensors, wind, gusts, randomize, threads,
            turbulence, task, target,
        )  # fmt: skip
        self.single_observation_space = observation_space(self.fleet)
        self.single_action_space = action_space()
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.observation_names = observation_names(self.fleet)
        self._ended = np.zeros(num_envs, dtype=np.bool_)
        self._every = np.ones(num_envs, dtype=np.bool_)
        self._seeded = False

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
        if seed is None and first is None:
            seeds: list[int | None] = [None] * self.num_envs
        elif first is not None:
            seeds = [int(first) + i for i in range(self.num_envs)]
        else:
            seeds = list(seed)  # type: ignore[arg-type]
            if len(seeds) != self.num_envs:
                raise InputError(f"seed must be one number or {self.num_envs}, found {len(seeds)}")
        for i, row_seed in enumerate(seeds):
            if row_seed is not None and which[i]:
                self.fleet.seed(i, row_seed)
        self._seeded = True
        self._ended &= ~which
        observations = self.fleet.restart(which, _start_states(options, self.num_envs))
        return observations, self._told(which) | self._vehicles(which)

    def step(
        self, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """One control period of every row; ended rows as `autoreset_mode` says."""
        fleet, ended = self.fleet, self._ended
        waiting = ended.any()
        active = ~ended if waiting else self._every
        outcome = fleet.fly(np.array(actions, dtype=np.float64).reshape(self.num_envs, 4), active)
        terminated = outcome.over
        truncated = np.zeros(self.num_envs, dtype=np.bool_)
        if self.max_episode_steps is not None:
            truncated = (fleet.rows >= self.max_episode_steps) & active
        observations = outcome.observations
        info: dict[str, Any] = {}
        done = terminated | truncated
        if self.autoreset_mode == AutoresetMode.NEXT_STEP:
            if waiting:
                fleet.restart(ended, observations=observations)
                info |= self._vehicles(ended)
            self._ended = done
        elif self.autoreset_mode == AutoresetMode.DISABLED:
            terminated = terminated | ended
            self._ended = ended | done
        elif done.any():
            info["final_obs"] = observations.copy()
            info["final_info"] = self._step_info(outcome.terms)
            info["_final_obs"] = info["_final_info"] = done
            fleet.restart(done, observations=observations)
            info |= self._vehicles(done)
        info |= self._step_info(outcome.terms)
        return observations, outcome.rewards, terminated, truncated, info

    def _step_info(self, terms: np.ndarray) -> dict[str, Any]:
        named = {name: terms[:, k] for k, name in enumerate(self.fleet.task.terms)}
        every = self._every.copy()
        return self._told(every) | {"reward_terms": _masked(named, every), "_reward_terms": every}

    def _told(self, which: np.ndarray) -> dict[str, Any]:
        fleet = self.fleet
        info: dict[str, np.ndarray] = {"state": fleet.x.copy()}
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


def action_space() -> Box:
    """Four commands in [-1, 1] about the nominal hover trim."""
    return Box(-1.0, 1.0, (4,), np.float32)


def observation_space(fleet: Fleet) -> Box:
    """Readings within their sensors' bounds, one flag per slow instrument, the way to the target."""
    return Box(fleet.low.astype(np.float32), fleet.high.astype(np.float32), dtype=np.float32)


def observation_names(fleet: Fleet) -> tuple[str, ...]:
    """Name of every entry of the observation: readings, ``new_INSTRUMENT`` flags, tasks.AIM."""
    aim = [name for name, *_ in tasks.AIM] if fleet.task.aims else []
    return (*(s.name for s in fleet.sensors), *(f"new_{flag}" for flag in fleet.flags), *aim)


def _check_render_mode(render_mode: str | None) -> None:
    if render_mode is not None:
        raise InputError(f"render_mode must be None: CoaxHeli-v0 cannot draw, not {render_mode!r}")


def _start_states(options: dict[str, Any] | None, count: int) -> np.ndarray | None:
    if not options or "state" not in options:
        return None
    states = np.asarray(options["state"], dtype=float)
    if states.shape[-1:] not in ((N_STATES,), (N_FULL,)) or states.ndim > 2:
        raise InputError(f"options['state'] must be ({N_STATES},) or ({N_FULL},) per helicopter")
    return np.broadcast_to(states, (count, states.shape[-1]))
