"""CoaxHeli-v0, many at once: one compiled batch behind Gymnasium's vector interface."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from coax_env.env import tasks
from coax_env.env.actions import Nominal
from coax_env.env.fleet import Fleet
from coax_env.env.gym_env import CoaxEnv, start_states
from coax_env.env.randomisation import Randomize, Wind
from coax_env.env.screen import Screen, checked_render_mode
from coax_env.env.spaces import action_space, observation_space, observed
from coax_env.errors import InputError
from coax_env.model.sensors import BASE_RATE
from coax_env.model.vehicle import Vehicle


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
    them: ``info["state"]`` is (num_envs, 29) and read-only, ``info["reward_terms"]`` and
    ``info["vehicle"]`` (where rows have started anew) are dicts of (num_envs,). ``render`` gives one
    picture per row.
    """

    def __init__(
        self,
        num_envs: int = 1,
        vehicle: str | Vehicle = "lama400d",
        nominal: Nominal = None,
        sensors: str = "onboard",
        wind: Wind = None,
        gusts: tuple[float, float] | None = None,
        randomize: Randomize = None,
        render_mode: str | None = None,
        max_episode_steps: int | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        threads: int | None = None,
        turbulence: float | str | None = None,
        task: str = "hover",
        target: Any = None,
        control_rate: float = BASE_RATE,
    ) -> None:
        if num_envs < 1:
            raise InputError(f"num_envs must be at least 1, found {num_envs}")
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        self.metadata = {**CoaxEnv.metadata, "autoreset_mode": self.autoreset_mode}
        self.render_mode = checked_render_mode(render_mode)
        self.num_envs = num_envs
        self.max_episode_steps = max_episode_steps
        self.fleet = Fleet(
            num_envs, vehicle, nominal, sensors, wind, gusts, randomize, threads,
            turbulence, task, target, control_rate,
        )  # fmt: skip
        entries = observed(self.fleet)
        self.single_observation_space = observation_space(entries)
        self.single_action_space = action_space()
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.observation_names = tuple(entry.name for entry in entries)
        self.observation_units = tuple(entry.unit for entry in entries)
        terms = self.fleet.task.terms
        self._of_terms = (*terms, *(f"_{name}" for name in terms))
        self._ended = np.zeros(num_envs, dtype=np.bool_)
        self._every = np.ones(num_envs, dtype=np.bool_)
        self._seeded = False
        self._screen = Screen(self.fleet, render_mode)

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
        observations = self.fleet.restart(which, start_states(options, self.num_envs))
        self._screen.update()
        return observations, self._info(which.copy()) | self._vehicles(which)

    def step(
        self, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """One control period of every row; ended rows as `autoreset_mode` says."""
        fleet, ended = self.fleet, self._ended
        waiting = ended.any()
        active = ~ended if waiting else self._every
        anew = ended if waiting and self.autoreset_mode == AutoresetMode.NEXT_STEP else None
        own = np.asarray(actions).reshape(self.num_envs, 4)
        outcome = fleet.fly_held(own, active, anew)
        terminated = outcome.over
        if self.max_episode_steps is None:
            truncated = np.zeros(self.num_envs, dtype=np.bool_)
        else:
            truncated = fleet.rows >= self.max_episode_steps * fleet.periods
            truncated &= active
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
        self._screen.update()
        return observations, outcome.rewards, terminated, truncated, info

    def render(self) -> tuple[np.ndarray, ...] | None:
        """One picture per row in mode ``rgb_array``; ``human`` shows the first row's."""
        rows = range(self.num_envs)
        return self._screen.pictures(rows) if self.render_mode == "rgb_array" else None

    def close_extras(self, **kwargs: Any) -> None:
        """Close the window, if there is one."""
        self._screen.close()

    def _step_info(self, terms: np.ndarray) -> dict[str, Any]:
        every = self._every.copy()
        by_name = dict(zip(self._of_terms, (*terms.T, *[every] * terms.shape[1]), strict=True))
        return {**self._info(every), "reward_terms": by_name, "_reward_terms": every}

    def _info(self, which: np.ndarray) -> dict[str, Any]:
        fleet = self.fleet
        state = fleet.x.view()
        state.flags.writeable = False
        info: dict[str, np.ndarray] = {"state": state}
        if fleet.task.shows_target:
            info["target"] = fleet.targets.copy()
        if fleet.task.follows_path:
            info["target_rates"] = fleet.target_rates
        if fleet.task.moves_on:
            info["reached"] = fleet.progress[:, tasks.REACHED].copy()
        return _masked(info, which)

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
