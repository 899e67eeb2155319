"""What projective and affine invariants of LED groups, and a verified match, can tell under a dome.

AFIT's SimSat under its measured dome with Poisson-disk LEDs, in AFIT's field and one four times as wide. The invariants
are those of `tests.helpers.group_invariants`. Rows, for random fields with the errors of CASES:

- bits: log2 of the groups of LEDs, in all orders, over those with the invariants of a group of lights by chance, within
  GATE_SIGMA of its errors, which are those of light and map and, where the pupil's place is unknown within the field,
  of the parallax;
- needed: log2 of the groups in all orders that are in any field, what a group must tell to be recognized alone;
- parallax, px: root mean square, for each axis, of what the best transform leaves of the images of the lights in two
  attitudes that see them, which have the pupil at two places; for the affine family perspective too;
- evidence, dex: what the fit of the whole field is worth if every light is matched: 1 / (2 pi sigma^2 rho) for each
  light beyond those that fix the transform, with the variance of its prediction, less the number of hypotheses tried:
  all LED groups that fix the transform, in all orders, for one group of lights. An identification takes ACCEPT_DEX;
- attitude, deg: the Cramer-Rao bound of the cross-boresight error, root mean square of the two axes, of a right match
  with only the focal length unknown, and with all of the calibration: focal lengths along x and y, skew and principal
  point (for both families; an affine image has no attitude of its own).
"""

from __future__ import annotations

from math import comb, factorial, log2, log10, pi
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.dome_identify import attitude, leds_m
from benchmarks.timing import figure
from estimator.attitude.dome_map import Lever, project
from estimator.core.camera import Camera
from estimator.core.checks import Floats, Ints
from estimator.identification.chance import ACCEPT_DEX, GATE_SIGMA
from skysim.scene import loader
from skysim.simulation.lab import build_lab
from skysim.sources.dome.surface import build_surface
from skysim.tracking.onboard_model import calibration
from tests.helpers.group_invariants import TRANSFORMS, invariants, predicted

# LEDs, focal length relative to AFIT's, error of an LED in the map along each axis, m, and of a light, pixels
CASES = (
    (1400, 1.0, 0.2e-3, 0.2),
    (1400, 1.0, 0.0, 0.1),
    (1400, 1.0, 1e-3, 0.2),
    (700, 1.0, 0.2e-3, 0.2),
    (400, 0.24, 0.2e-3, 0.2),
    (400, 0.24, 1e-2, 0.2),
)
FIELDS = 100
DRAWS = 40  # of the errors of a group's invariants
CHANCE_GROUPS = 60_000  # of other LEDs, compared with a group of lights


class Bench:
    """AFIT's camera and dome with LEDs, and the fields of random attitudes."""

    def __init__(self, leds: int, zoom: float, map_m: float, seed: int) -> None:
        lab = build_lab(loader.load("afit_simsat"))
        self.rng = np.random.default_rng(seed)
        self.map_m = map_m
        self.lens: Camera = calibration(lab.scene.camera).zoomed(zoom)
        self.lever = Lever(
            np.array(lab.camera.mount.camera_body_m), lab.camera.mount.cam_from_body
        )
        self.place_m = leds_m(
            "poisson_disk", leds, build_surface(lab.scene.light.surface), self.rng
        )

    def field(self) -> tuple[Floats, Floats, Ints, Rotation]:
        """(K, 2) true pixels of the LEDs in a random field, (K, 2) those if the pupil is where another attitude has it
        that sees them too, which LEDs they are, and the attitude."""
        body_from_lab = attitude(self.rng)
        xy = project(body_from_lab, self.place_m, self.lever, self.lens)
        seen = np.flatnonzero(self.lens.contains(np.nan_to_num(xy, nan=-1e9), 12))
        # A group's invariants in the map belong to one place of the pupil; the group may be anywhere in the field.
        half_rad = np.arctan(self.lens.height_px / 2 / self.lens.focal_px)
        x, y = half_rad * self.rng.uniform(-1, 1, 2)
        other = Rotation.from_rotvec([x, y, 0.0]) * body_from_lab
        in_other = other.apply(self.place_m[seen]) - self.lever.camera_body_m
        return (
            xy[seen],
            self.lens.pixels(self.lever.cam_from_body.apply(in_other)),
            seen,
            body_from_lab,
        )

    def sigma_px(self, noise_px: float) -> float:
        """Error of a light against the map, pixels."""
        range_m = float(np.linalg.norm(self.place_m, axis=1).mean()) - float(
            np.linalg.norm(self.lever.camera_body_m)
        )
        return float(np.hypot(noise_px, self.map_m / range_m * self.lens.focal_px))


def homogeneous(xy: Floats, lens: Camera) -> Floats:
    """(..., 3) rays (x, y, 1) of pixels; the invariants do not depend on the scale and the origin."""
    x = (xy - [(lens.width_px - 1) / 2, (lens.height_px - 1) / 2]) / lens.focal_px
    return np.concatenate([x, np.ones((*x.shape[:-1], 1))], axis=-1)


def group_bits(
    bench: Bench, name: str, xy: Floats, other: Floats, sigma_px: float, pool: Floats
) -> tuple[float, float]:
    """log2 of all groups over those that agree by chance with the lights' best group: with the pupil known, and not."""
    count = TRANSFORMS[name].lights
    rng = bench.rng
    best = [0.0, 0.0]
    for _ in range(6):
        row = rng.choice(len(xy), count, replace=False)
        errors = sigma_px * rng.standard_normal((DRAWS, count, 2))
        truth = invariants(homogeneous(xy[row], bench.lens), name)
        noise = invariants(homogeneous(xy[row] + errors, bench.lens), name) - truth
        parallax = invariants(homogeneous(other[row], bench.lens), name) - truth
        covariance = np.cov(noise.T) if np.isfinite(noise).all() else np.eye(2) * 1e9
        for n, total in enumerate((covariance, covariance + np.outer(parallax, parallax))):
            offset = pool - truth
            distance2 = np.einsum("ni,ni->n", offset @ np.linalg.pinv(total), offset)
            share = (np.sum(distance2 < GATE_SIGMA**2) + 0.5) / len(pool)
            best[n] = max(best[n], -log2(share))
    return best[0], best[1]


def evidence_dex(
    bench: Bench, name: str, xy: Floats, sigma_px: float, hypotheses: float
) -> float:
    """Power of ten of the match of all lights, by the fit to the lights that spread most, less the hypotheses tried."""
    family = TRANSFORMS[name]
    lens = bench.lens
    density = len(xy) / (lens.width_px * lens.height_px)
    x = homogeneous(xy, lens)
    best = -np.inf
    for _ in range(30):
        row = bench.rng.choice(len(xy), family.fixed_by, replace=False)
        rest = np.setdiff1d(np.arange(len(xy)), row)
        # Prediction of a light from those that fix the transform, by propagated draws of their errors.
        draws = np.array([predicted(name, x[row], moved(x[row], sigma_px / lens.focal_px, bench.rng), x[rest])
                          for _ in range(8)])  # fmt: skip
        variance = ((draws - x[rest, :2]) ** 2).mean(
            axis=(0, 2)
        ) * lens.focal_px**2 + sigma_px**2
        best = max(
            best, float(np.maximum(-np.log10(2 * pi * variance * density) - 0.43, 0).sum())
        )
    return best - log10(hypotheses)


def bounds_deg(
    bench: Bench, body_from_lab: Rotation, seen: Ints, sigma_px: float
) -> tuple[float, float]:
    """Cross-boresight bound, deg, of a match with the focal length unknown, and with the whole calibration unknown."""
    lens = bench.lens
    place_m = bench.place_m[seen]
    steps = np.full(8, 1e-6)

    def image(unknown: Floats) -> Floats:
        turned = Rotation.from_rotvec(unknown[:3]) * body_from_lab
        rays = bench.lever.cam_from_body.apply(
            turned.apply(place_m) - bench.lever.camera_body_m
        )
        x, y = (rays[:, :2] / rays[:, 2:]).T
        scale, aspect, skew, *center = unknown[3:]
        u = (1 + scale) * x + skew * y + center[0]
        v = (1 + scale + aspect) * y + center[1]
        return np.asarray(lens.focal_px * np.concatenate([u, v]))

    slopes = np.array(
        [(image(step) - image(-step)) / (2 * 1e-6) for step in np.diag(steps)]
    ).T
    across = [0, 1]
    sigmas = []
    for known in (slopes[:, :4], slopes):
        covariance = sigma_px**2 * np.linalg.pinv(known.T @ known, rcond=1e-15)
        sigmas.append(
            float(
                np.degrees(np.sqrt(np.trace(covariance[:3, :3][np.ix_(across, across)]) / 2))
            )
        )
    return sigmas[0], sigmas[1]


def moved(x: Floats, sigma: float, rng: np.random.Generator) -> Floats:
    return x + np.pad(sigma * rng.standard_normal((len(x), 2)), ((0, 0), (0, 1)))


def pool_of(bench: Bench, name: str) -> Floats:
    """(CHANCE_GROUPS, 2) invariants of random groups, in random order, of LEDs that share a field."""
    found = []
    while len(found) < CHANCE_GROUPS:
        xy = bench.field()[0]
        if len(xy) < TRANSFORMS[name].lights:
            continue
        rows = np.argsort(bench.rng.random((500, len(xy))), axis=1)[
            :, : TRANSFORMS[name].lights
        ]
        found += list(invariants(homogeneous(xy[rows], bench.lens), name))
    return np.array(found[:CHANCE_GROUPS])


def measure(count: int = FIELDS, seed: int = 1) -> list[dict[str, Any]]:
    """All cases, `count` random fields each."""
    return [row for case in CASES for row in measure_case(*case, count, seed)]


def measure_case(
    leds: int, zoom: float, map_m: float, noise_px: float, fields: int, seed: int
) -> list[dict[str, Any]]:
    """The rows of each family of transforms; medians over the fields."""
    found = []
    for name, family in TRANSFORMS.items():
        bench = Bench(leds, zoom, map_m, seed)
        sigma_px = bench.sigma_px(noise_px)
        pool = pool_of(bench, name)
        rows = []
        parallax = []
        for _ in range(fields):
            xy, other, seen, body_from_lab = bench.field()
            if len(xy) <= family.lights:
                rows.append((len(xy), 0.0, 0.0, 0.0, -np.inf))
                continue
            # Groups of LEDs that share a field: each LED with its neighbors in it, in all orders.
            sets = leds / family.lights * comb(len(xy) - 1, family.lights - 1)
            bases = (
                leds
                / family.fixed_by
                * comb(len(xy) - 1, family.fixed_by - 1)
                * factorial(family.fixed_by)
            )
            bits = group_bits(bench, name, xy, other, sigma_px, pool)
            shift_px = float(np.sqrt(np.mean(residual(name, xy, other, bench.lens) ** 2)))
            dex = evidence_dex(bench, name, xy, float(np.hypot(sigma_px, shift_px)), bases)
            rows.append((len(xy), *bits, log2(sets * factorial(family.lights)), dex))
            parallax.append((shift_px, *bounds_deg(bench, body_from_lab, seen, sigma_px)))
        lights, known, unknown, needed, dex = np.array(rows).T
        case = f"{leds} LEDs to {1e3 * map_m:g} mm, {noise_px} px, zoom {zoom:g}, {name}"
        what = f"{fields} fields"
        found += [
            figure(f"{case}: lights, mean", lights.mean(), "", what),
            figure(f"{case}: bits of a group", np.median(known), "", what),
            figure(f"{case}: bits with parallax", np.median(unknown), "", what),
            figure(f"{case}: bits needed", np.median(needed), "", what),
            figure(f"{case}: evidence", np.median(dex), "dex", what),
            figure(
                f"{case}: fields with enough", 100 * np.mean(dex >= ACCEPT_DEX), "%", what
            ),
        ]
        if parallax:
            shift_px, focal_deg, all_deg = np.median(parallax, axis=0)
            found += [
                figure(f"{case}: parallax", shift_px, "px", what),
                figure(f"{case}: attitude, focal length unknown", focal_deg, "deg", what),
                figure(f"{case}: attitude, all unknown", all_deg, "deg", what),
            ]
    return found


def residual(name: str, xy: Floats, other: Floats, lens: Camera) -> Floats:
    """(K, 2) residual, pixels, of the best transform of the other image of the lights to this one."""
    x = homogeneous(other, lens)
    y = homogeneous(xy, lens)
    if name == "affine":
        return np.asarray(
            (x @ np.linalg.lstsq(x, y, rcond=None)[0] - y)[:, :2] * lens.focal_px
        )
    zero = np.zeros_like(x)
    rows = np.concatenate(
        [np.hstack([x, zero, -y[:, :1] * x]), np.hstack([zero, x, -y[:, 1:2] * x])]
    )
    matrix = np.linalg.svd(rows)[2][-1].reshape(3, 3)
    image = x @ matrix.T
    return np.asarray((image[:, :2] / image[:, 2:] - y[:, :2]) * lens.focal_px)
