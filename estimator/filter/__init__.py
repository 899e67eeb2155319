"""Attitude filter (MEKF): attitude and gyro bias from gyro and star tracker."""

from estimator.core.lazy import attach

# Loaded on first use: importing one module of the package does not import the others.
__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        "mekf": ["AttitudeFilter", "GyroModel"],
    },
)
