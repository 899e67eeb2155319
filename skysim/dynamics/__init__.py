"""Torques to attitude: guidance, control, actuators, disturbances and the IMU. Only `multibody` imports MuJoCo."""

import lazy_loader

# Loaded on first use: importing one module of the package does not import the others.
__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__,
    submod_attrs={
        "disturbances": ["DisturbanceModel"],
        "flight_computer": ["FlightComputer"],
        "imu": ["Imu"],
        "jitter": ["Vibration"],
    },
)
