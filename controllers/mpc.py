"""Linear model-predictive control, as a yardstick: LQG's problem with the ends of the actuators in it.

In every control period OSQP (Stellato et al. 2020) minimises LQG's quadratic cost over the next
HORIZON periods, and LQG's cost-to-go behind them, with every action within -1 .. 1. With u = -K x + v
about LQG's own feedback, the cost of a plan is

    x' P x + sum_k v_k' (R + B' P B) v_k

so that where LQG's actions keep within their bounds they are the optimum, v = 0, and no programme is
solved. Filter, integrals and setpoints are LQG's.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import sparse

from coax_env.errors import require
from controllers.lqr import LQG, regulator_problem

HORIZON = 30
"""Periods of 10 ms that are planned: the bar aside, whose 3 s no plan covers, the tilt has settled."""
_TOLERANCE = 1e-4  # of an action, whose range is 2
_MOST_ITERATIONS = 2000


@dataclass
class MPC(LQG):
    """LQG whose actions are planned within their bounds."""

    horizon: int = HORIZON
    solved = 0  # programmes so far

    kind = "mpc"

    def __post_init__(self) -> None:
        self._free, self._by_deviation, hessian = self._plan()
        rows = np.ones(len(hessian))
        self._solver: Any = require("osqp", "mpc").OSQP()
        self._solver.setup(
            sparse.csc_matrix(hessian), np.zeros(len(rows)), sparse.csc_matrix(self._by_deviation),
            -rows, rows, verbose=False, eps_abs=_TOLERANCE, eps_rel=_TOLERANCE,
            max_iter=_MOST_ITERATIONS,
        )  # fmt: skip

    def _plan(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """What the next actions are made of, period by period.

        Returns:
            actions of LQG by what is known (4 h, n + i); actions by deviations from LQG's, v of all
            periods (4 h, 4 h); the Hessian of the cost over these (4 h, 4 h).
        """
        cost = self.cost
        A, B, _, R = regulator_problem(self.estimator, cost["limits"], cost["weights"])
        K, h = self.gain, self.horizon
        closed = A - B @ K
        free, response = [-K], [np.eye(4)]
        moved = B
        for _ in range(h - 1):
            free.append(free[-1] @ closed)
            response.append(-K @ moved)
            moved = closed @ moved
        by_deviation = np.zeros((4 * h, 4 * h))
        for k in range(h):
            for j in range(k + 1):
                by_deviation[4 * k : 4 * k + 4, 4 * j : 4 * j + 4] = response[k - j]
        hessian = np.kron(np.eye(h), 2.0 * (R + B.T @ self.cost_to_go @ B))
        return np.vstack(free), by_deviation, hessian

    def actions_from_estimate(self, known: np.ndarray) -> np.ndarray:
        """Actions (count, 4) to estimates and integrals (count, n + i)."""
        trim = np.tile(-self.tracker.offset / self.estimator.action_scale, self.horizon)
        planned = trim + known @ self._free.T
        actions = planned[:, :4].copy()
        for row in np.flatnonzero(np.abs(planned).max(axis=1) > 1.0):
            actions[row] += self._first_deviation(planned[row])
        return actions

    def _first_deviation(self, planned: np.ndarray) -> np.ndarray:
        """v of the first period (4,), for LQG's actions over the horizon (4 h,)."""
        self._solver.update(l=-1.0 - planned, u=1.0 - planned)
        found = self._solver.solve(raise_error=False)
        self.solved += 1
        return np.nan_to_num(found.x[:4])


def design(*arguments: Any, **named: Any) -> MPC:
    """The MPC of a vehicle; arguments as of `lqr.design`."""
    from controllers import lqr

    lqg = lqr.design(*arguments, **named)
    return MPC(lqg.vehicle, lqg.estimator, lqg.gain, lqg.cost_to_go, lqg.cost)
