"""NAME: a star tracker of one's own, as a program that skysim starts.

#   skysim run scoreboard --program NAME='python NAME.py' --tracker NAME --frames 4
#   skysim compare scoreboard --program NAME='python NAME.py' --tracker own --tracker NAME --frames 6

In Python the class works as it is: `skysim.simulate(scene, tracker=Tracker)`.
"""

import numpy as np
from scipy.spatial.transform import Rotation

from estimator import Camera, DomeTracker, LedMap, Lever, Settings, StarCatalog, StarTracker
from skysim.tracking.tracker_host import serve_tracker
from skysim.tracking.tracker_interface import Answer


class Tracker:
    """Put your own detection and identification here; this one uses skysim's estimator."""

    def __init__(self, setup):
        """What comes once; raise an exception for a set-up that the tracker cannot use.

        setup.width_px, height_px, focal_px, center_px, distortion   the camera, as it is calibrated
        setup.gain_e_dn, saturation_dn, time_utc, options            detector, date, `tracker.options` of the scene
        setup.stars: id, direction, magnitude                        the sky, apparent at the date; None under a dome
        setup.leds: id, position_m, camera_body_m, cam_from_body_xyzw    the dome and the camera's place; else None
        """
        camera = Camera(
            setup.width_px, setup.height_px, setup.focal_px, setup.center_px, setup.distortion
        )
        settings = Settings(gain_e_dn=setup.gain_e_dn, saturation=setup.saturation_dn)
        if setup.leds:
            leds = setup.leds
            lever = Lever(leds.camera_body_m, Rotation.from_quat(leds.cam_from_body_xyzw))
            radius_m = np.full(3, np.linalg.norm(leds.position_m, axis=1).mean())
            known = LedMap(leds.id, leds.position_m, np.zeros(3), radius_m)
            self.tracker = DomeTracker(camera, known, lever, settings)
        else:
            stars = setup.stars
            still = 0 * stars.direction
            known = StarCatalog(
                stars.id, stars.direction, still, still[:, 0], stars.magnitude, 2000.0
            )
            self.tracker = StarTracker(camera, known, stars.direction, settings)

    def solve(self, picture):
        """The attitude of one frame, from the reference frame (ICRS or lab) to camera axes (x right, y down).

        picture.image_dn      (height, width) digital numbers
        picture.frame, t_s    number, and time of mid-exposure from the scene's start
        picture.exposure_s, streak_px    exposure, and motion (dx, dy) of the images in it if a gyro measures it

        Returns a Rotation, a unit quaternion (scalar last), a matrix, None, or an `Answer` with reason and covariance.
        """
        found = self.tracker.solve(picture.image_dn).attitude
        if not found.solved:
            return Answer(found.status)
        return Answer("solved", found.cam_from_ref.as_quat(), found.covariance_rad2)


if __name__ == "__main__":
    serve_tracker(Tracker)
