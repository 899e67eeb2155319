"""The vehicle on its bearing, moved by MuJoCo. The only package that knows MuJoCo."""

from skysim.world.flight import Flight as Flight
from skysim.world.flight import fly as fly
from skysim.world.flight import tilt_deg as tilt_deg
from skysim.world.occlusion import Obstacles as Obstacles
from skysim.world.occlusion import hidden as hidden
from skysim.world.occlusion import obstacles as obstacles
from skysim.world.shapes import Shape as Shape
from skysim.world.shapes import shapes as shapes
from skysim.world.vehicle import CAM_FROM_MJCAM as CAM_FROM_MJCAM
from skysim.world.vehicle import World as World
from skysim.world.vehicle import build as build
from skysim.world.vehicle import imu_place_m as imu_place_m
from skysim.world.vehicle import mount as mount
