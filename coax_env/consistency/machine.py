"""What the relations know of a vehicle: its linearisation about hover, by the kernel that flies."""

import numpy as np

from coax_env.consistency.relations import Machine, rev_per_min
from coax_env.model.dynamics import hover_trim
from coax_env.model.layout import FLYBAR, LOWER_FLAP, RATE, RPM_PER_RAD_S
from coax_env.model.linear import hover_matrices
from coax_env.model.vehicle import Vehicle


def machine_of(vehicle: Vehicle) -> Machine:
    """A vehicle's hover."""
    A, B = hover_matrices(vehicle)
    flaps = np.r_[LOWER_FLAP, FLYBAR]
    p, q, r = range(RATE.start, RATE.stop)
    return Machine(
        gravity=vehicle["gravity"].value,
        hover=rev_per_min(hover_trim(vehicle)[1][:2]),
        yaw=(B[r, 0] / RPM_PER_RAD_S, B[r, 1] / RPM_PER_RAD_S),
        flap=A[np.ix_(flaps, flaps)],
        flap_rates=A[np.ix_(flaps, [p, q])],
        flap_swash=B[flaps, 2:],
        turned=A[np.ix_([p, q], flaps)],
        crossed=A[np.ix_([p, q], [p, q])],
    )
