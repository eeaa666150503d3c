"""The helicopter: state vector, parameters, effects, dynamics, sensors, actuators, vehicle files."""
