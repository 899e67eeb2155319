"""Multibody dynamics of the vehicle on its bearing by MuJoCo. The only package that imports MuJoCo."""

from skysim.dynamics.multibody.integrator import Flight as Flight
from skysim.dynamics.multibody.integrator import fly as fly
from skysim.dynamics.multibody.integrator import tilt_deg as tilt_deg
from skysim.dynamics.multibody.model import CAM_FROM_MJCAM as CAM_FROM_MJCAM
from skysim.dynamics.multibody.model import World as World
from skysim.dynamics.multibody.model import build as build
from skysim.dynamics.multibody.model import imu_place_m as imu_place_m
from skysim.dynamics.multibody.model import mount as mount
from skysim.dynamics.multibody.occlusion import Obstacles as Obstacles
from skysim.dynamics.multibody.occlusion import hidden as hidden
from skysim.dynamics.multibody.occlusion import obstacles as obstacles
from skysim.dynamics.multibody.view.shapes import Shape as Shape
from skysim.dynamics.multibody.view.shapes import shapes as shapes
