"""Near-field attitude: a camera on a lever arm about the bearing center, under LEDs at known positions.

Under a dome the direction from the camera to an LED depends on the attitude in two ways: the camera rotates, and its
lever arm c moves it. The measured ray is that of q = A P - c in body axes, with A = R_body_from_lab, P the LED's
position in the lab frame and c the camera's position in the body frame. The methods differ in how they treat c:

- `infinity` ignores it and solves Wahba's problem for the rays.
- `thesis`, `tappe` and `ray_on_surface` estimate the distance of each LED along its ray, which gives points about the
  bearing center, and solve Wahba's problem for their directions from there. The latter two iterate.
- `rotation_only` fits A to the rays by Gauss-Newton with the exact model, c known (`rotation_fit`).
- `pnp` fits A and the camera's position, six degrees of freedom, as if c were unknown.

All have the same signature. Each takes

- `rays_cam`: (N, 3) unit vectors in camera axes;
- `sigma_rad`: (N,) standard deviation of each ray per axis; for the methods in TANGENT_SOLVERS, that of its tangents;
- `position_m`: (N, 3) position of each ray's LED in the lab frame;
- `leds`, `lever`: the believed surface, and the believed position and orientation of the camera;
- `body_from_lab`: the initial attitude; `infinity` and `thesis` do not use it;

and returns body_from_lab with its (3, 3) covariance in body axes, rad^2. The covariance includes the noise of the rays
only. It includes neither errors of the believed positions nor the bias of the method, which noise-free rays reveal. All
raise ValueError if the rays do not determine an attitude.
"""

from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import Rotation

from estimator.attitude.dome_map import LedMap, Lever, on_surface
from estimator.attitude.rotation_fit import (
    in_body_axes,
    rotation_only,
    tangent_gradients,
    tangent_jacobian,
)
from estimator.attitude.solvers import quest
from estimator.core.checks import Floats
from estimator.core.vectors import lengths, normalized

# Largest number of iterations of the methods that place points, and the rotation below which they stop.
MAX_UPDATES = 20
CONVERGED_RAD = 1e-13

# (N, 3) points from the bearing center, in body axes; the (N,) distance of each from the camera; by_ray, (N, 3, 3)
# dp/du, the derivative of a point with respect to its ray u; and by_rotation, (N, 3) derivative of the point's distance
# along u with respect to the attitude, 0 where the method does not use the attitude to place the point
Points = tuple[Floats, Floats, Floats, Floats | float]
# body_from_lab, and its (3, 3) covariance in body axes, rad^2.
Solution = tuple[Rotation, Floats]


def _from_points(
    place: Callable[[Rotation], Points],
    rays_body: Floats,
    sigma_rad: Floats,
    position_m: Floats,
    body_from_lab: Rotation,
) -> Solution:
    """Return body_from_lab and its (3, 3) covariance in body axes, rad^2, from points on the rays, by their directions.

    Until the attitude converges (at once, where the points do not depend on it):

    a. Place a point p on each ray, at the last attitude.
    b. Solve Wahba's problem for the points' directions d from the bearing center. A ray error of sigma at the camera
       displaces a point by sigma * distance, and its direction by sigma * distance / radius, which sets the weights k.

    The covariance is from the noise of the rays. At the minimum of Wahba's loss its gradient vanishes:
    sum(k a x d) = 0, with a = A P / |P|, d = p / |p|. To first order, ray noise du causes the rotation w that keeps the
    gradient zero (derived here):

        sum(k [(a.d) I - a d^T]) w = sum(k a x (I - d d^T) dp / |p|),    dp = by_ray du + u (by_rotation . w).

    1. Compute the gradient's derivative G_i by a shift dp_i of each point: the columns of k a x (I - d d^T) / |p|.
    2. Compute the Hessian H: the bracket on the left minus the part of dp that depends on w.
    3. Map ray noise of sigma across the ray to the rotation: w_i = H^-1 G_i by_ray (I - u u^T) sigma_i.
    4. Sum over the independent rays: P = sum(w_i w_i^T).

    Parameters
    ----------
    place
        Function of an attitude that returns the Points
    rays_body, position_m
        (N, 3) unit vectors u in body axes, and (N, 3) the same points in the lab frame
    """
    target = normalized(position_m)
    for _ in range(MAX_UPDATES):
        # a. Points. They change little with the attitude, so a few updates converge.
        point_m, distance_m, by_ray_m, by_rotation_m = place(body_from_lab)
        radius = lengths(point_m)
        d = point_m / radius[:, None]
        # b. Attitude
        previous = body_from_lab
        body_from_lab = quest(d, target, sigma_rad * distance_m / radius)
        if (body_from_lab * previous.inv()).magnitude() < CONVERGED_RAD:
            break
    a = body_from_lab.apply(target)
    weight = (radius / (sigma_rad * distance_m)) ** 2  # k
    # 1. Columns of G: derivative of a point's term k a x d by a shift along each axis.
    across_point = np.eye(3) - np.einsum("ni,nj->nij", d, d)
    gradient = np.cross(a[:, None, :], across_point.mT).mT
    gradient *= (weight / radius)[:, None, None]
    # 2. Hessian
    gradient_along_ray = np.einsum("nij,nj->ni", gradient, rays_body)
    hessian = np.eye(3) * (weight * np.sum(a * d, axis=1)).sum() - (weight[:, None] * a).T @ d
    hessian -= gradient_along_ray.T @ (by_rotation_m * np.ones_like(gradient_along_ray))
    # 3. Rotation by a ray's noise; a unit vector has noise only across itself.
    across_ray = np.eye(3) - np.einsum("ni,nj->nij", rays_body, rays_body)
    response = np.linalg.solve(hessian, gradient @ by_ray_m @ across_ray)
    response *= sigma_rad[:, None, None]
    # 4. Covariance
    return body_from_lab, np.einsum("nij,nkj->ik", response, response)


def infinity(
    rays_cam: Floats,
    sigma_rad: Floats,
    position_m: Floats,
    leds: LedMap,
    lever: Lever,
    body_from_lab: Rotation,
) -> Solution:
    """Take the LEDs as infinitely far: solve Wahba's problem with the rays as directions from the bearing center.

    This is what a flight tracker does under a dome. The camera is closer to the dome by M, so the pattern appears
    larger by R / (R - M). The solution aligns the center of the pattern, whose own direction is wrong in proportion
    to its angle off the boresight. The bias on AFIT's dome with five LEDs is .52 degrees cross-boresight at every tilt
    (reference, section 5).
    """
    rays = lever.body_from_cam.apply(rays_cam)
    # Equal radius and distance: the weights are those of the rays.
    points = rays, np.ones(len(rays)), np.tile(np.eye(3), (len(rays), 1, 1)), 0.0
    return _from_points(lambda _: points, rays, sigma_rad, position_m, body_from_lab)


def thesis_points(rays_cam: Floats, leds: LedMap, lever: Lever) -> tuple[Floats, float]:
    """Return AFIT's vectors to the LEDs (Padro 2012, eqs 43-44): (N, 3) points in camera axes, m, and R - M, m.

    R is the height of the believed surface above the bearing, M the camera's distance from the bearing along the
    boresight. With the angle a of a ray off the boresight,

        (x, y) = (R - M) tan a (eq. 43),    z = sqrt((R - M)^2 - x^2 - y^2) (eq. 44).

    With the sine in eq. 43 the point would be on its ray, R - M from the camera (reference 1.2, item 11).

    Raises
    ------
    ValueError
        If eq. 44 has no root.
    """
    boresight_body = lever.body_from_cam.apply([0.0, 0.0, 1.0])
    height_m = on_surface(np.array([[0.0, 0.0, 1.0]]), np.zeros(3), leds)[0, 2]  # R
    distance_m = float(height_m - lever.camera_body_m @ boresight_body)  # R - M
    # Eq. 43: across the boresight
    across_m = distance_m * rays_cam[:, :2] / rays_cam[:, 2:]
    # Eq. 44: along the boresight
    along2_m2 = distance_m**2 - np.sum(across_m**2, axis=1)
    if not (distance_m > 0 and np.all(along2_m2 > 0)):
        raise ValueError(
            f"eq. 44 has no root: a ray is 45 deg off the boresight, or R - M is {distance_m:.3f} m"
        )
    return np.column_stack([across_m, np.sqrt(along2_m2)]), distance_m


def thesis(
    rays_cam: Floats,
    sigma_rad: Floats,
    position_m: Floats,
    leds: LedMap,
    lever: Lever,
    body_from_lab: Rotation,
) -> Solution:
    """Solve by AFIT's method: place each LED on a sphere of radius R - M about the camera (Padro 2012, eqs 43-45).

    1. Place each LED in camera axes by `thesis_points`.
    2. Add the camera's position, which gives points from the bearing (eq. 45).
    3. Solve Wahba's problem for their directions.

    The thesis's axes x, y, z are z, x, y here. Its eq. 43 has tan where sin is right (reference 1.2, item 11). That
    causes the bias: .0036 degrees cross-boresight on AFIT's dome, .07 under a flat ceiling at 30 degrees.
    """
    # 1. Points in camera axes
    point_cam, distance_m = thesis_points(rays_cam, leds, lever)
    # 2. Points from the bearing, in body axes
    R_body_from_cam = lever.body_from_cam.as_matrix()
    point = point_cam @ R_body_from_cam.T + lever.camera_body_m
    distances_m = np.full(len(rays_cam), distance_m)
    # dp/du by the chain rule: of the point by the tangents (eqs 43-44), then of the tangents by the ray.
    by_tangent = np.zeros((len(rays_cam), 3, 2))
    by_tangent[:, [0, 1], [0, 1]] = distance_m
    by_tangent[:, 2, :] = -distance_m * point_cam[:, :2] / point_cam[:, 2:]
    by_ray_m = R_body_from_cam @ by_tangent @ tangent_gradients(rays_cam) @ R_body_from_cam.T
    # 3. Wahba's problem
    points = point, distances_m, by_ray_m, 0.0
    rays = rays_cam @ R_body_from_cam.T
    return _from_points(lambda _: points, rays, sigma_rad, position_m, body_from_lab)


def tappe(
    rays_cam: Floats,
    sigma_rad: Floats,
    position_m: Floats,
    leds: LedMap,
    lever: Lever,
    body_from_lab: Rotation,
) -> Solution:
    """Solve by NPS's method: compute the LEDs' distances at the last attitude, solve Wahba's problem, and iterate.

    The geometry is R_0 + alpha_i b_i = A beta_i r_i with the camera at R_0, the ray b_i, the LED at beta_i r_i and the
    distance alpha_i = |A P_i - R_0| (Tappe, cited by Padro 2012, eq. 33). Until the attitude converges:

    1. Compute the distances alpha_i at the last attitude.
    2. Place each LED on its ray at that distance.
    3. Solve Wahba's problem for the directions from the bearing.

    Tappe stopped after one update, or five; here the method iterates to convergence. An error of a distance moves the
    point along its ray, which is almost its direction from the bearing, so an update reduces the error by a factor of
    about M / R times the square of the field's half-angle. The true attitude is the fixed point: there is no bias.
    """
    rays = lever.body_from_cam.apply(rays_cam)

    def place(last: Rotation) -> Points:
        # 1. Distances
        distance_m = lengths(last.apply(position_m) - lever.camera_body_m)
        # 2. Points from the bearing
        point = lever.camera_body_m + distance_m[:, None] * rays
        # p = c + alpha u, alpha = |b - c|: dp/du = alpha I, and a rotation w changes alpha by u.(w x p) = w.(p x u).
        by_ray_m = distance_m[:, None, None] * np.eye(3)
        return point, distance_m, by_ray_m, np.cross(point, rays)

    # 3. Attitude
    return _from_points(place, rays, sigma_rad, position_m, body_from_lab)


def ray_on_surface(
    rays_cam: Floats,
    sigma_rad: Floats,
    position_m: Floats,
    leds: LedMap,
    lever: Lever,
    body_from_lab: Rotation,
) -> Solution:
    """Solve by placing each LED where its ray meets the believed ellipsoid, and iterate.

    Until the attitude converges:

    1. Intersect each ray with the ellipsoid at the last attitude (`on_surface`).
    2. Rotate the intersections to body axes: points p from the bearing.
    3. Solve Wahba's problem for their directions.

    A bias comes only from errors of the surface: LEDs off the believed ellipsoid, amplified where rays meet it
    obliquely.
    """
    rays = lever.body_from_cam.apply(rays_cam)

    def place(last: Rotation) -> Points:
        # 1. Intersections, in the lab frame
        origin = last.inv().apply(lever.camera_body_m)
        intersection_m = on_surface(last.inv().apply(rays), origin, leds)
        if np.isnan(intersection_m).any():
            raise ValueError("a ray misses the believed surface")
        # 2. Points in body axes
        point = last.apply(intersection_m)
        distance_m = lengths(point - lever.camera_body_m)
        # The gradient of |(x - center) / semi_axes|^2 / 2 is along the surface's normal; n is it over its part along u.
        normal = last.apply((intersection_m - leds.center_m) / leds.semi_axes_m**2)
        scaled_normal = normal / np.sum(normal * rays, axis=1, keepdims=True)
        # p moves on the surface by distance (du - u n.du); rotating the surface by w moves p along u by n.(w x p).
        across_normal = np.eye(3) - np.einsum("ni,nj->nij", rays, scaled_normal)
        by_ray_m = distance_m[:, None, None] * across_normal
        return point, distance_m, by_ray_m, np.cross(point, scaled_normal)

    # 3. Attitude
    return _from_points(place, rays, sigma_rad, position_m, body_from_lab)


def pnp(
    rays_cam: Floats,
    sigma_rad: Floats,
    position_m: Floats,
    leds: LedMap,
    lever: Lever,
    body_from_lab: Rotation,
) -> Solution:
    """Fit attitude and camera position (perspective-n-point), six unknowns, from N >= 4 rays; ignores the bearing.

    With the pattern's mean position as origin, q = b + t, b = A (P - mean P). The unknowns are the rotation w and the
    translation t; residuals and D(q) are those of `rotation_only`, the Jacobian is [D (-[b]x), D].

    1. Start from the believed position of the camera.
    2. Solve by OpenCV's Levenberg-Marquardt, without weights.
    3. Refine by Gauss-Newton with step halving, with weights 1 / sigma^2.

    Step 2 has a start because a small pattern seen face on fits almost as well when flipped: SQPnP, which needs no
    start, converged to the flipped solution in 5 % of noise-free trials.

    A translation of a small pattern is hard to distinguish from a rotation: knowing the bearing improves the
    cross-boresight error by a factor of about a thousand (reference, section 5). The covariance is of first order;
    where a pattern is seen face on and the noise makes the flipped solution possible, the errors are not Gaussian.

    Raises
    ------
    ValueError
        For LEDs in a line, and if the fit does not converge.
    """
    import cv2  # slow to import

    if len(rays_cam) < 4:
        raise ValueError(
            f"pnp: {len(rays_cam)} rays do not determine the camera's position; 4 are needed"
        )
    measured = rays_cam[:, :2] / rays_cam[:, 2:]
    # 1. With the pattern's mean as origin, rotation and translation are nearly uncorrelated.
    centroid_m = position_m.mean(axis=0)
    pattern_m = position_m - centroid_m
    start_rad = (lever.cam_from_body * body_from_lab).as_rotvec()[:, None]
    start_m = lever.cam_from_body.apply(body_from_lab.apply(centroid_m) - lever.camera_body_m)
    # 2. Unweighted solution
    start = start_rad, start_m[:, None]
    try:
        converged, rotvec, shift = cv2.solvePnP(
            pattern_m, measured, np.eye(3), None, *start, True, cv2.SOLVEPNP_ITERATIVE
        )
    except cv2.error as error:
        raise ValueError(f"pnp: OpenCV found no camera position: {error.err}") from None
    if not converged:
        raise ValueError("pnp: OpenCV found no camera position")
    # 3. Weighted solution: residuals are divided by their standard deviations.
    weight = np.repeat(1 / sigma_rad, 2)
    cam_from_lab = Rotation.from_rotvec(np.ravel(rotvec))
    cam_from_lab, covariance_cam = _gauss_newton(
        pattern_m, measured, cam_from_lab, np.ravel(shift), weight
    )
    return lever.body_from_cam * cam_from_lab, in_body_axes(covariance_cam, lever)


def _gauss_newton(
    pattern_m: Floats,
    measured: Floats,
    cam_from_lab: Rotation,
    shift_m: Floats,
    weight: Floats,
) -> tuple[Rotation, np.ndarray]:
    """Refine the six unknowns by Gauss-Newton with step halving; return cam_from_lab and its (3, 3) covariance, rad^2.

    The covariance is the rotation's block of (J^T J)^-1, with the weights in J.
    """
    residual, jacobian = _six_dof_residual(pattern_m, measured, cam_from_lab, shift_m, weight)
    for _ in range(100):
        step, _, rank, _ = np.linalg.lstsq(jacobian, residual, rcond=None)
        if rank < 6:
            raise ValueError(
                "pnp: the LEDs do not determine the camera's position: they are collinear"
            )
        # Halve the step until the sum of squares does not rise.
        before = residual @ residual
        for _ in range(12):
            updated = Rotation.from_rotvec(step[:3]) * cam_from_lab, shift_m + step[3:]
            residual, jacobian = _six_dof_residual(pattern_m, measured, *updated, weight)
            if residual @ residual <= before:
                break
            step = step / 2
        cam_from_lab, shift_m = updated
        if np.linalg.norm(step) < 1e-12:
            break
    if not np.linalg.norm(step) < 1e-6:
        raise ValueError(
            f"pnp: not converged, last step {np.linalg.norm(step):.1e} rad and m"
        )
    return cam_from_lab, np.linalg.inv(jacobian.T @ jacobian)[:3, :3]


def _six_dof_residual(
    pattern_m: Floats,
    measured: Floats,
    cam_from_lab: Rotation,
    shift_m: Floats,
    weight: Floats,
) -> tuple[Floats, Floats]:
    """Return the weighted residuals of the tangents, (2 N,), and their Jacobian (2 N, 6) by rotation and shift."""
    b = cam_from_lab.apply(pattern_m)
    q = b + shift_m
    jacobian = np.hstack([tangent_jacobian(b, q), tangent_gradients(q).reshape(-1, 3)])
    return (measured - q[:, :2] / q[:, 2:]).ravel() * weight, jacobian * weight[:, None]


NearFieldSolver = Callable[..., Solution]
SOLVERS: dict[str, NearFieldSolver] = {
    "rotation_only": rotation_only,
    "ray_on_surface": ray_on_surface,
    "infinity": infinity,
    "thesis": thesis,
    "tappe": tappe,
    "pnp": pnp,
}
# Methods that fit tangents (x/z, y/z), in which a pixel has the same size everywhere.
TANGENT_SOLVERS = ("rotation_only", "pnp")


def fitted_sigma_rad(solver: str, rays_cam: Floats, pixel_rad: Floats) -> Floats:
    """Return the (N,) standard deviation per axis of the quantity that a solver fits: tangents or unit vectors.

    At an angle a off the boresight, a change dt of the tangent rotates the ray by cos^2(a) dt in the radial direction
    and by cos(a) dt across it. The ray's error is the rms of both, dt sqrt((cos^2 a + cos^4 a) / 2).

    Parameters
    ----------
    pixel_rad
        (N,) centroid error over the focal length
    """
    if solver in TANGENT_SOLVERS:
        return pixel_rad
    cosine = rays_cam[:, 2]
    return pixel_rad * np.sqrt((cosine**2 + cosine**4) / 2)
