"""Torques to attitude: guidance, control, actuators, disturbances and the IMU. Only `multibody` imports MuJoCo."""
