"""A signal held from each row to the next, as commands are: its integral, and means over rows."""

from collections.abc import Callable

import numpy as np


def integral_of_held(t: np.ndarray, values: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    """Integral from the first row on; before it the first value, after the last row the last one.

    Args:
        t: (n,) time [s], increasing.
        values: (n,) held.
    """
    area = np.concatenate([[0.0], np.cumsum(values[:-1] * np.diff(t))])

    def integral(at: np.ndarray) -> np.ndarray:
        beyond = np.maximum(at - t[-1], 0.0) * values[-1]
        before = np.minimum(at - t[0], 0.0) * values[0]
        return np.interp(at, t, area) + beyond + before

    return integral


def row_means(t: np.ndarray, values: np.ndarray, sooner: float | np.ndarray) -> np.ndarray:
    """Mean over each row of what is held, (n,), had it come sooner.

    Args:
        t: (n,) time [s], increasing.
        values: (n,) held.
        sooner: by how much it comes before it is written [s], one or each row's; negative: later.
    """
    integral, ends = integral_of_held(t, values), np.append(t[1:], 2.0 * t[-1] - t[-2])
    return (integral(ends + sooner) - integral(t + sooner)) / (ends - t)
