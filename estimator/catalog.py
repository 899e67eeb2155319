"""The on-board star catalogue: from a star list to apparent unit vectors, prepared apart from the simulator's."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from estimator.types import BadImage, Floats, Ints

SPEED_OF_LIGHT_M_S = 299_792_458.0
EPOCH_YR = 1991.25


@dataclass(frozen=True, slots=True)
class StarList:
    """Stars as the file gives them, brightest first, at the epoch J1991.25 in the ICRS.

    id : (N,); vectors : (N, 3) unit; drift_rad_yr : (N, 3) proper motion, tangent; v_mag : (N,)
    """

    id: Ints
    vectors: Floats
    drift_rad_yr: Floats
    v_mag: Floats

    def __len__(self) -> int:
        return len(self.id)

    def take(self, which: NDArray[Any]) -> StarList:
        """The chosen stars, by mask or index."""
        return StarList(self.id[which], self.vectors[which], self.drift_rad_yr[which], self.v_mag[which])


def read(path: Path) -> StarList:
    """Read a catalogue file: ECSV with hip, ra_deg, dec_deg, pm_ra_mas_yr, pm_dec_mas_yr, v_mag.

    Raises BadImage with one line if it cannot be read.
    """
    names = ("hip", "ra_deg", "dec_deg", "pm_ra_mas_yr", "pm_dec_mas_yr", "v_mag")
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
        body = [line for line in lines if line and not line.startswith("#")]
        delimiter = "," if "," in body[0] else None
        header = body[0].replace('"', "").split(delimiter)
        columns = [header.index(name) for name in names]
        table = np.loadtxt(body[1:], delimiter=delimiter, usecols=columns, ndmin=2)
    except (OSError, ValueError, IndexError) as error:
        raise BadImage(f"{path}: not a star catalogue ({error}); allowed: ECSV with {', '.join(names)}") from None
    hip, ra_deg, dec_deg, pm_ra, pm_dec, v_mag = table.T
    stars = from_columns(hip.astype(np.int64), np.radians(ra_deg), np.radians(dec_deg), pm_ra, pm_dec, v_mag)
    return stars.take(np.argsort(v_mag, kind="stable"))


def from_columns(
    hip: Ints, ra_rad: Floats, dec_rad: Floats, pm_ra_mas_yr: Floats, pm_dec_mas_yr: Floats, v_mag: Floats
) -> StarList:
    """Directions and their drift from spherical coordinates; pm_ra includes cos(dec)."""
    sa, ca, sd, cd = np.sin(ra_rad), np.cos(ra_rad), np.sin(dec_rad), np.cos(dec_rad)
    vectors = np.column_stack([cd * ca, cd * sa, sd])
    east = np.column_stack([-sa, ca, np.zeros_like(sa)])
    north = np.column_stack([-sd * ca, -sd * sa, cd])
    mas = np.pi / 180 / 3.6e6
    drift = mas * (pm_ra_mas_yr[:, None] * east + pm_dec_mas_yr[:, None] * north)
    return StarList(hip, vectors, drift, v_mag)


def at_epoch(stars: StarList, epoch_yr: float, velocity_m_s: Floats | None = None) -> Floats:
    """(N, 3) unit vectors as seen at an epoch (Julian years) by an observer moving at velocity_m_s (ICRS).

    Proper motion is a straight line in space: R + (t - t0) dR/dt, renormalised. Aberration is PTASE's eq. 4,
    (R + v/c) / |R + v/c|: the classical law, at most 0.5 mas from the relativistic one at Earth's speed.
    """
    vectors = stars.vectors + (epoch_yr - EPOCH_YR) * stars.drift_rad_yr
    vectors = vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
    if velocity_m_s is not None:
        vectors = vectors + np.asarray(velocity_m_s) / SPEED_OF_LIGHT_M_S
        vectors = vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
    return vectors


def merge_doubles(stars: StarList, closer_than_rad: float) -> StarList:
    """Replace stars too close to be told apart by one at their centre of light, as bright as all together."""
    groups = _groups(stars.vectors, closer_than_rad)
    light = 10 ** (-0.4 * stars.v_mag)
    total = np.bincount(groups, light)
    merged = [
        np.column_stack([np.bincount(groups, light * column) / total for column in array.T])
        for array in (stars.vectors, stars.drift_rad_yr)
    ]
    vectors = merged[0] / np.linalg.norm(merged[0], axis=1, keepdims=True)
    # The brightest of each group comes first and gives the name.
    _, first = np.unique(groups, return_index=True)
    result = StarList(stars.id[first], vectors, merged[1], -2.5 * np.log10(total))
    return result.take(np.argsort(result.v_mag, kind="stable"))


def _groups(vectors: Floats, closer_than_rad: float) -> Ints:
    """Label of each star's group, where groups are joined through pairs closer than an angle."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    pairs = cKDTree(vectors).query_pairs(2 * np.sin(closer_than_rad / 2), output_type="ndarray")
    ones = np.ones(len(pairs))
    graph = coo_array((ones, (pairs[:, 0], pairs[:, 1])), shape=(len(vectors), len(vectors)))
    return connected_components(graph, directed=False)[1].astype(np.int64)


def brighter(stars: StarList, limit_mag: float) -> StarList:
    """Stars to a limiting V magnitude."""
    return stars.take(stars.v_mag <= limit_mag)


def limit_for_density(stars: StarList, field_sr: float, wanted: float) -> float:
    """The magnitude to which a field of so many steradians holds `wanted` stars on average."""
    count = int(np.clip(wanted * 4 * np.pi / field_sr, 1, len(stars)))
    return float(np.sort(stars.v_mag)[count - 1])
