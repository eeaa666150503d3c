"""Vehicles as a diagnosis leaves them, which several tests fly."""

import coax_env

LAMA = coax_env.load_vehicle("lama400d")
FOUR = (
    LAMA.with_effect("motor_lag", upper=0.07, lower=0.05)
    .with_effect("wind", north=-1.0, east=1.2)
    .with_effect("rotor_drag", coefficient=3.5e-4)
    .with_effect("gyro_bias", x=0.004, y=-0.012, z=0.002)
)
"""What is hidden in the bundled flight."""
NINE = (
    LAMA.with_effect("command_delay", time=0.068)
    .with_effect("hub_stiffness", upper=0.2, lower=0.1)
    .with_effect("swash_phase", angle=0.2)
    .with_effect("yaw_damping", coefficient=0.003)
    .with_effect("motor_droop", upper=0.2, lower=0.15)
    .with_effect("flap_blowback", gain=0.006)
    .with_effect("swash_offset", lon=0.01, lat=-0.01)
    .with_effect("marker_offset", y=0.18)
    .with_effect("vibration", tilt=2.1e-3, heave=3.3e-4)
)
"""What the diagnosis of the real CoaX names."""
ASKEW = LAMA.with_effect("swash_offset", lon=0.03, lat=-0.02)
LATE_AND_ASKEW = ASKEW.with_effect("servo_delay", time=0.03)
"""A machine that hovers with its plate tilted, and one whose servo comes late besides."""
