"""tetra3rs (github.com/ssmichael1/tetra3rs, MIT) as a star tracker: its own catalog (Gaia), centroids and solver.

It is the entry point `tetra3rs`; the package comes with the extra `oracle`. Options in `tracker.options`:

fast
    Single-pass centroiding instead of the full one
sigma
    Detection threshold
brightest
    Greatest number of centroids
limit_mag
    Limiting magnitude of its catalog; if left out, it takes as many stars as the field needs
"""

import datetime
from typing import Any

import numpy as np

from skysim.core.constants import JULIAN_YEAR_DAY
from skysim.core.time import in_utc
from skysim.tracking.tracker_interface import SOLVED, Answer, Picture, Setup

FIELD_MARGIN = 1.1  # field of the pattern database, relative to that of the camera
OPTIONS = ("fast", "sigma", "brightest", "limit_mag")


class Tetra3rs:
    """Lost-in-space solution of every frame. It assumes a calibrated camera and an observer on Earth."""

    def __init__(self, setup: Setup) -> None:
        """Raises ValueError for a set-up that it cannot use, ImportError if tetra3rs is not installed."""
        if setup.reference != "icrs":
            raise ValueError(
                "tetra3rs solves star fields only; allowed: scenes with light.kind: stars"
            )
        unknown = [name for name in setup.options if name not in OPTIONS]
        if unknown:
            raise ValueError(
                f"tracker.options: unknown option {unknown[0]!r}; allowed: {', '.join(OPTIONS)}"
            )
        try:
            import tetra3rs
        except ImportError:
            raise ImportError(
                "tetra3rs is not installed; allowed: pip install 'skysim[oracle]'"
            ) from None
        self.options = setup.options
        fast = setup.options.get("fast", False)
        self.extract = tetra3rs.extract_centroids_fast if fast else tetra3rs.extract_centroids
        self.camera = camera_model(tetra3rs, setup)
        self.image_center_px = image_center_px(setup)
        moment = in_utc(datetime.datetime.fromisoformat(setup.time_utc))
        self.velocity_km_s = tetra3rs.earth_barycentric_velocity(moment)
        self.database: Any = tetra3rs.SolverDatabase.generate_from_gaia(
            max_fov_deg=self.camera.fov_deg * FIELD_MARGIN,
            star_max_magnitude=setup.options.get("limit_mag"),
            epoch_proper_motion_year=moment.year
            + moment.timetuple().tm_yday / JULIAN_YEAR_DAY,
        )

    def solve(self, picture: Picture) -> Answer:
        """The solution of one frame.

        tetra3rs's quaternion is scalar first, ICRS to camera. Its covariance is of other angles and is left out.
        """
        extraction = self.extract(
            picture.image_dn,
            sigma_threshold=self.options.get("sigma", 5.0),
            max_centroids=self.options.get("brightest", 40),
            threads=1,
        )
        solution = self.database.solve_from_centroids(
            extraction.centroids,
            camera_model=self.camera,
            observer_velocity_km_s=self.velocity_km_s,
        )
        centered_px = np.array(
            [(centroid.x, centroid.y) for centroid in extraction.centroids]
        )
        xy_px = centered_px.reshape(-1, 2) + self.image_center_px
        if not solution:
            return Answer(str(solution.status).replace("_", " "), centroids_px=xy_px)
        w, x, y, z = solution.quaternion
        return Answer(SOLVED, [x, y, z, w], centroids_px=xy_px)


def image_center_px(setup: Setup) -> Any:
    """(2,) center of the image, the origin of tetra3rs's pixel coordinates."""
    return np.array([(setup.width_px - 1) / 2, (setup.height_px - 1) / 2])


def camera_model(tetra3rs: Any, setup: Setup) -> Any:
    """tetra3rs's camera model.

    Its distortion polynomial is in pixels, so the coefficients are divided by powers of the focal length.
    """
    f = setup.focal_px
    k1, k2, p1, p2, k3 = setup.distortion
    distortion = tetra3rs.RadialDistortion(
        k1=k1 / f**2, k2=k2 / f**4, k3=k3 / f**6, p1=p1 / f, p2=p2 / f
    )
    return tetra3rs.CameraModel(
        f,
        setup.width_px,
        setup.height_px,
        crpix=(np.array(setup.center_px) - image_center_px(setup)).tolist(),
        distortion=distortion if any(setup.distortion) else None,
    )
