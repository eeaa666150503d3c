"""The readings' places by name: ``z[Z.AX]``. Units and order: layout.CHANNEL_UNITS."""

from coax_env.model.layout import N_CHANNELS

(
    RPM_UPPER, RPM_LOWER,
    P, Q, R,
    AX, AY, AZ,
    PHI, THETA, PSI,
    H, VN, VE, VD, PN, PE,
    V,
) = range(N_CHANNELS)  # fmt: skip
