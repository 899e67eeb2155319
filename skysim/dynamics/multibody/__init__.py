"""Multibody dynamics of the vehicle on its bearing, by MuJoCo. No other package imports MuJoCo."""

from skysim.dynamics.multibody.integrator import PrescribedMotion as PrescribedMotion
from skysim.dynamics.multibody.integrator import Simulation as Simulation
from skysim.dynamics.multibody.integrator import simulate as simulate
from skysim.dynamics.multibody.integrator import tilt_deg as tilt_deg
from skysim.dynamics.multibody.model import VehicleModel as VehicleModel
from skysim.dynamics.multibody.model import build as build
from skysim.dynamics.multibody.model import camera_mount as camera_mount
from skysim.dynamics.multibody.model import imu_position_m as imu_position_m
from skysim.dynamics.multibody.occlusion import Obstacles as Obstacles
from skysim.dynamics.multibody.occlusion import occluded as occluded
from skysim.dynamics.multibody.scene_shapes import Laboratory as Laboratory
from skysim.dynamics.multibody.scene_shapes import Shape as Shape
