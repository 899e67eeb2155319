"""Input checks: input is converted or refused in one line, and compiled code gets one type of array."""

from __future__ import annotations

import datetime
import itertools
import math
import tempfile
from dataclasses import FrozenInstanceError
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as some
from hypothesis.extra.numpy import array_shapes, arrays
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from estimator.attitude import dome_map
from estimator.attitude.dome_map import LedMap, Lever
from estimator.catalog import catalog
from estimator.catalog.catalog import StarCatalog
from estimator.core import checks, errors
from estimator.core.errors import ImageError
from estimator.core.types import Centroids
from estimator.core.vectors import lengths, rms, rotation_of
from estimator.detection import detect
from estimator.trackers import pipeline
from estimator.trackers.pipeline import Settings
from tests.helpers.laws import ANY, NUMBERS, SEEDS, answered, drawn, law, turn, units

WORDS = some.text(max_size=8)


@checks.frozen
class Frozen:
    x: float


@law(checks.frozen)
@given(x=some.floats(allow_nan=False))
def test_a_frozen_object_keeps_its_fields_and_takes_no_others(x: float) -> None:
    one = Frozen(x)
    assert one == Frozen(x)
    with pytest.raises(FrozenInstanceError):
        one.x = x  # type: ignore[misc]
    assert not hasattr(one, "__dict__")


THINGS: Any = (
    some.none()
    | some.booleans()
    | some.integers()
    | ANY
    | WORDS
    | some.lists(ANY, max_size=3)
    | NUMBERS
)
DTYPES = some.sampled_from(["u1", "?", "u2", ">u2", "i2", ">i4", "i8", "f4", ">f8", "f8"])
MATRICES = DTYPES.flatmap(
    lambda kind: arrays(kind, array_shapes(min_dims=2, max_dims=2, min_side=2, max_side=30))
)


def disguises(array: NDArray) -> list[NDArray]:
    """The same numbers in every layout that a library may produce: column-major, flipped, read-only, strided."""
    spread = np.empty((2 * len(array), *array.shape[1:]), array.dtype)[::2]
    spread[...] = array
    locked = array.copy()
    locked.flags.writeable = False
    unaligned = np.frombuffer(b"\0" + array.tobytes(), array.dtype, offset=1).reshape(
        array.shape
    )
    return [
        np.asfortranarray(array),
        np.ascontiguousarray(array[::-1])[::-1],
        locked,
        spread,
        unaligned,
    ]


def is_plain(array: NDArray, dtype: Any) -> bool:
    """Whether an array has the one type and layout that compiled code accepts."""
    flags = array.flags
    return (
        type(array) is np.ndarray
        and array.dtype == dtype
        and flags.c_contiguous
        and flags.aligned
        and flags.writeable
    )


@law(
    checks.native,
    checks.floats,
    detect.to_native,
    detect.in_row_order,
    detect.check_pixel_type,
)
@given(array=MATRICES)
def test_an_array_of_any_type_or_layout_gives_the_plain_array_s_result(
    array: NDArray,
) -> None:
    for one in disguises(array):
        plain = checks.floats("x", one, (None, array.shape[1]))
        assert is_plain(plain, np.float64)
        np.testing.assert_array_equal(plain, array.astype(float))
        ordered = detect.in_row_order(one)
        assert is_plain(ordered, array.dtype.newbyteorder("="))
        looped = detect.to_native(one)
        assert any(is_plain(looped, kind) for kind in (np.uint16, np.int32, np.float64))
        np.testing.assert_array_equal(looped, array.astype(looped.dtype))
    plain = np.ascontiguousarray(array, dtype=float)
    assert checks.floats("x", plain, (None, None)) is plain
    assert (
        answered(lambda: detect.check_pixel_type(array.astype(complex)), ImageError) is None
    )
    with pytest.raises(ImageError, match="a list; allowed: a numpy array"):
        detect.check_pixel_type(array.tolist())


@law(
    checks.number,
    checks.store_numbers,
    checks.of_type,
    checks.each_of_type,
    checks.pixel_step,
    checks.one_rotation,
    checks.known,
    checks.excerpt,
)
@given(thing=THINGS)
def test_any_value_is_converted_or_refused_in_one_line(thing: Any) -> None:
    number = answered(lambda: checks.number("x", thing, 0.0, 5.0, "0 to 5"), ImageError)
    assert number is None or (type(number) is float and 0 <= number <= 5)
    whole = answered(lambda: checks.number("x", thing, 0, 5, "0 to 5", True), ImageError)
    assert whole is None or (type(whole) is int and 0 <= whole <= 5)
    owner = SimpleNamespace(x=thing, y=None)
    allowed = checks.Allowed(0, 5, "0 to 5", True)
    may_lack = {"x": allowed, "y": allowed._replace(optional=True)}
    answered(lambda: checks.store_numbers(owner, "", may_lack), ImageError)
    assert owner.y is None
    assert whole is None or (type(owner.x) is int and owner.x == whole)
    step = answered(lambda: checks.pixel_step("x", thing), ImageError)
    assert step is None or (
        len(step) == 2 and np.isfinite(step).all() and {type(one) for one in step} == {float}
    )
    with pytest.raises(ImageError, match="allowed: Rotation"):
        checks.one_rotation("x", thing)
    with pytest.raises(ImageError, match="allowed: Centroids or Lever"):
        checks.of_type("x", thing, Centroids, Lever)
    checks.each_of_type("x", [thing, thing], object)
    with pytest.raises(
        ImageError, match=r"x: number 1 is .*allowed: Lever|x is .*allowed: list or tuple"
    ):
        checks.each_of_type("x", [dome_map.Lever(None, None), thing], Lever)  # type: ignore[arg-type]
    with pytest.raises(
        ImageError, match="'abd' is unknown; did you mean abc\\?; allowed: abc, xyz"
    ):
        checks.known("x", "abd", {"xyz", "abc"})
    assert len(checks.excerpt(thing).splitlines()) <= 1
    assert len(checks.excerpt(thing)) <= 60


def test_a_rotation_is_valid_and_finite() -> None:
    checks.one_rotation("x", Rotation.identity())
    with pytest.raises(ImageError, match="a stack of 3 rotations"):
        checks.one_rotation("x", Rotation.identity(3))
    with pytest.raises(ImageError, match="x is NaN"):
        checks.one_rotation("x", Rotation.from_rotvec([np.nan, 0, 0]))


@law(
    checks.rows,
    checks.unit_rows,
    checks.row_numbers,
    checks.first_bad,
)
@given(rng=SEEDS, thing=THINGS)
def test_rows_have_their_length_and_are_finite_and_present(
    rng: np.random.Generator, thing: Any
) -> None:
    for call in (checks.rows, checks.unit_rows):
        found = answered(
            lambda call=call: call("x", thing, *([None, 3][: 1 + (call is checks.rows)])),
            ImageError,
        )  # type: ignore[misc]
        assert found is None or (found.shape[1] == 3 and np.isfinite(found).all())
    count = int(rng.integers(2, 9))
    bad = units(rng, 9)
    row = int(rng.integers(0, count))
    checks.unit_rows("x", bad[:count], count)
    bad[row] *= 1.01
    with pytest.raises(
        ImageError, match=rf"x: row {row} has length 1\.01; allowed: unit vectors"
    ):
        checks.unit_rows("x", bad[:count], count)
    bad[row, 1] = np.inf
    with pytest.raises(ImageError, match=f"in row {row}"):
        checks.rows("x", bad[:count], count, 3)
    assert checks.first_bad(np.arange(count) != row) == row
    assert checks.row_numbers("x", np.arange(count), count).dtype == np.int64
    for wrong in ([count], [-1], [0.0], [[0]], ["a"]):
        with pytest.raises(ImageError):
            checks.row_numbers("x", wrong, count)


def lights(rng: np.random.Generator, count: int) -> dict[str, NDArray]:
    spread = rng.normal(size=(count, 2, 2))
    spread = spread @ spread.transpose(0, 2, 1) + np.eye(2)
    xy_px = rng.uniform(0, 99, (count, 2))
    sigma_px = rng.uniform(0.1, 1, count)
    return {
        "xy_px": xy_px,
        "sigma_px": sigma_px,
        "flux": rng.uniform(1, 9, count),
        "covariance_px2": spread,
    }


@law(Centroids.check_values)
@given(
    rng=SEEDS,
    value=some.sampled_from([np.nan, np.inf, -np.inf, -1.0, 0.0]),
    longer=some.sampled_from([-1, 1, 7]),
)
def test_centroids_have_equal_lengths_and_valid_numbers(
    rng: np.random.Generator, value: float, longer: int
) -> None:
    count = int(rng.integers(2, 20))
    good = lights(rng, count)
    row = int(rng.integers(0, count))
    Centroids(**good).check_values()  # type: ignore[arg-type]
    Centroids(**good | {"covariance_px2": None}).check_values()  # type: ignore[arg-type]
    for name, array in good.items():
        with pytest.raises(ImageError, match=r"centroids: .* has shape .*; allowed: "):
            Centroids(**good | {name: np.resize(array, (count + longer, *array.shape[1:]))})  # type: ignore[arg-type]
        bad = array.copy()
        bad[row] = value
        if name == "xy_px" and np.isfinite(value):
            continue
        with pytest.raises(
            ImageError, match=f"centroids: {name} of row {row} is .*; allowed: "
        ):
            Centroids(**good | {name: bad}).check_values()  # type: ignore[arg-type]
    for change in disguises(good["xy_px"]):
        assert is_plain(Centroids(**good | {"xy_px": change}).xy_px, np.float64)  # type: ignore[arg-type]


@law(StarCatalog.from_radec, catalog.checked)
@given(rng=SEEDS)
def test_a_catalog_from_arrays_equals_that_from_vectors(rng: np.random.Generator) -> None:
    stars = drawn(rng)
    x, y, z = stars.vectors.T
    ra_deg = np.degrees(np.arctan2(y, x))
    dec_deg = np.degrees(np.arcsin(z))
    east = np.column_stack([-y, x, 0 * x]) / np.hypot(x, y)[:, None]
    motion = np.einsum("ij,ij->i", stars.drift_rad_yr, east) / catalog.MAS_RAD
    order = rng.permutation(len(stars))
    made = StarCatalog.from_radec(
        ra_deg[order],
        dec_deg[order],
        stars.v_mag[order],
        motion[order],
        epoch_yr=1991,
        id=stars.id[order],
    )
    assert np.array_equal(made.id, stars.id)  # brightest first again
    np.testing.assert_allclose(made.vectors, stars.vectors, rtol=0, atol=1e-12)
    drift = np.einsum("ij,ij->i", made.drift_rad_yr, east)
    np.testing.assert_allclose(drift, motion * catalog.MAS_RAD, rtol=1e-9, atol=0)
    assert catalog.checked(made) is made
    whole_sky = np.radians(np.mod(ra_deg, 360)), np.radians(dec_deg)
    if whole_sky[0].max() > 5 and np.ptp(whole_sky[1]) > 1.2:
        with pytest.raises(ImageError, match="radians\\?"):
            StarCatalog.from_radec(*whole_sky, stars.v_mag)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"dec_deg": [91.0, 0, 0]}, r"dec_deg is 91 in a row; allowed: -90 to 90 degrees"),
        ({"ra_deg": [400.0, 0, 0]}, r"ra_deg is 400 in a row"),
        ({"dec_deg": [1.0, 2.0]}, r"dec_deg has shape \(2,\); allowed: \(3,\)"),
        ({"v_mag": [1.0, np.nan, 3]}, r"v_mag has a NaN or infinity in row 1"),
        ({"v_mag": None}, r"v_mag: not an array of real numbers"),
        ({"pm_ra_mas_yr": [1.0]}, r"pm_ra_mas_yr has shape \(1,\)"),
        ({"epoch_yr": 91}, r"epoch_yr is 91; allowed: a Julian year"),
        ({"id": [1, 2]}, r"id has 2 numbers; allowed: 3"),
    ],
)
def test_a_catalog_of_wrong_arrays_is_refused(change: dict[str, Any], message: str) -> None:
    good = {"ra_deg": [10.0, 20, 30], "dec_deg": [1.0, 2, 3], "v_mag": [3.0, 4, 5]}
    StarCatalog.from_radec(**good)  # type: ignore[arg-type]
    with pytest.raises(ImageError, match=message):
        StarCatalog.from_radec(**good | change)  # type: ignore[arg-type]


def test_a_catalog_whose_columns_do_not_match_is_refused() -> None:
    stars = drawn(np.random.default_rng(3))
    for name in ("vectors", "drift_rad_yr", "parallax_rad", "v_mag"):
        with pytest.raises(ImageError, match=f"{name} has shape"):
            catalog.checked(
                stars.__class__(**fields(stars) | {name: getattr(stars, name)[:-1]})
            )
    with pytest.raises(ImageError, match="the catalog is empty"):
        catalog.checked(stars.take(np.empty(0, int)))
    with pytest.raises(ImageError, match="stars is None"):
        catalog.checked(None)


def fields(one: StarCatalog) -> dict[str, Any]:
    return {name: getattr(one, name) for name in one.__slots__}


@law(catalog.utc, StarCatalog.read)
@given(thing=THINGS, when=some.datetimes())
def test_a_date_is_valid_or_refused(thing: Any, when: datetime.datetime) -> None:
    for date in (when, when.isoformat()):
        found = answered(lambda date=date: catalog.utc(date), ImageError)  # type: ignore[misc]
        assert found == (when if 1800 <= when.year < 2200 else None)
    answered(lambda: catalog.utc(thing), ImageError)
    if thing is None or isinstance(thing, float):
        answered(lambda: StarCatalog.read(thing), ImageError)


def test_the_class_reads_a_file_as_the_function_does() -> None:
    path = catalog.Path(catalog.__file__).parents[2] / "data/catalogs/hipparcos_hp6.5.ecsv"
    assert np.array_equal(StarCatalog.read(path).vectors, catalog.read(path).vectors)


@law(dome_map.check_map)
@given(rng=SEEDS)
def test_a_map_of_other_lengths_is_refused(rng: np.random.Generator) -> None:
    count = int(rng.integers(3, 9))
    good = {
        "id": np.arange(count),
        "position_m": 2 * units(rng, count),
        "center_m": np.zeros(3),
        "semi_axes_m": np.full(3, 2.0),
        "board": np.zeros(count, int),
        "covariance_m2": np.zeros((count, 3, 3)),
        "common_m": np.zeros((2, count, 3)),
    }
    dome_map.check_map(LedMap(**good))
    for name, array in good.items():
        shorter = array[:, :-1] if name == "common_m" else array[:-1]
        with pytest.raises(ImageError, match=r"leds: \w+ has shape .*allowed: "):
            dome_map.check_map(LedMap(**good | {name: shorter}))
    for name, wrong in (("sigma_m", -1.0), ("position_m", None), ("sigma_m", np.nan)):
        with pytest.raises(ImageError, match=f"leds: {name}"):
            dome_map.check_map(LedMap(**good | {name: wrong}))
    with pytest.raises(ImageError, match="leds is 5 of type int; allowed: LedMap"):
        dome_map.check_map(5)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"camera_body_m": [0, 0]}, r"camera_body_m has shape \(2,\); allowed: \(3,\)"),
        ({"camera_body_m": [0, 0, np.nan]}, "camera_body_m has a NaN"),
        ({"cam_from_body": np.eye(3)}, "cam_from_body is .*allowed: Rotation"),
        ({"cam_from_body": Rotation.identity(2)}, "a stack of 2 rotations"),
        ({"sigma_m": -1}, "sigma_m is -1; allowed: finite, 0 or more"),
    ],
)
def test_a_wrong_lever_is_refused(change: dict[str, Any], message: str) -> None:
    leds = LedMap(np.arange(3), 2 * np.eye(3), np.zeros(3), np.full(3, 2.0))
    good = {
        "camera_body_m": np.array([0, 0, 0.5]),
        "cam_from_body": turn(np.random.default_rng(1)),
    }
    dome_map.check_lever(leds, Lever(**good))  # type: ignore[arg-type]
    with pytest.raises(ImageError, match=f"lever: {message}|{message}"):
        dome_map.check_lever(leds, Lever(**good | change))  # type: ignore[arg-type]


@law(pipeline.check_algorithms)
@given(word=WORDS, value=THINGS)
def test_settings_are_known_and_usable(word: str, value: Any) -> None:
    names = set(Settings.__slots__)
    stages = ("detector", "centroider", "identifier", "solver")
    for stage in stages:
        named = Settings(**{stage: word})  # type: ignore[arg-type]
        if word not in {"default", *pipeline.DETECTORS, *pipeline.CENTROIDERS}:
            with pytest.raises(
                ImageError, match=f"settings: {stage}: .* is unknown.*; allowed: .*default"
            ):
                pipeline.check_algorithms(named, ["default"], ["default"])
    pipeline.check_algorithms(Settings(), ["default"], ["default"])
    if word not in names:
        with pytest.raises(
            ImageError, match=r"settings: .* is unknown.*; allowed: .*centroid_sigma_px"
        ):
            Settings(**{word: value})
    optional = {"bad_px", "zero_point_mag", "assumed_deg", "bayer", "centroid_sigma_px"}
    for name, kind in itertools.product(names - set(stages) - optional, [value]):
        made = answered(lambda name=name, kind=kind: Settings(**{name: kind}), ImageError)  # type: ignore[misc]
        assert made is None or type(getattr(made, name)) is type(getattr(Settings(), name))


def test_a_misspelled_setting_is_answered_with_the_nearest_name() -> None:
    with pytest.raises(
        ImageError, match="'centroid_sigma' is unknown; did you mean centroid_sigma_px"
    ):
        Settings(centroid_sigma=0.1)  # type: ignore[call-arg]
    with pytest.raises(ImageError, match=r"bad_px has shape \(2,\)"):
        Settings(bad_px=[1, 2])  # type: ignore[arg-type]
    with pytest.raises(ImageError, match="zero_point_mag is nan"):
        Settings(zero_point_mag=np.nan)
    assert Settings(saturation=4095).saturation == 4095.0


@law(rotation_of)
@given(rng=SEEDS)
def test_a_rotation_without_scipy_s_checks_is_the_same(rng: np.random.Generator) -> None:
    known = turn(rng)
    made = rotation_of(known.as_quat())
    assert made.single
    place = rng.standard_normal((3, 3))
    np.testing.assert_array_equal(made.apply(place), known.apply(place))
    np.testing.assert_array_equal((made * known.inv()).as_quat()[:3], np.zeros(3))


@law(lengths, rms)
@given(rng=SEEDS, scale=some.floats(1e-3, 1e3))
def test_a_length_and_a_root_mean_square_follow_their_definitions(
    rng: np.random.Generator, scale: float
) -> None:
    vectors = scale * rng.standard_normal((4, 5, 3))
    wanted = [[math.hypot(*vector) for vector in row] for row in vectors]
    np.testing.assert_allclose(lengths(vectors), wanted, rtol=1e-14)
    # The mean square of vectors is three times that of their components.
    assert rms(lengths(vectors)) == pytest.approx(math.sqrt(3) * rms(vectors), rel=1e-12)
    assert rms(np.full(3, -scale)) == pytest.approx(scale, rel=1e-12)


@law(errors.file_bytes, errors.reason)
@given(content=some.binary(max_size=30))
def test_a_file_is_read_whole_and_text_in_another_encoding_is_named_by_its_byte(
    content: bytes,
) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "file"
        path.write_bytes(content)
        assert errors.file_bytes(path) == content
        with pytest.raises(OSError, match="no such file"):
            errors.file_bytes(folder)
    try:
        content.decode()
    except UnicodeDecodeError as error:
        place = int(errors.reason(error).rpartition(" ")[2])
        # All before it is text, and with it not.
        content[: place - 1].decode()
        assert content[: place - 1].decode().encode() + content[place - 1 :] == content
    assert errors.reason(OSError(28, "No space left on device")) == "No space left on device"
    assert errors.reason(ValueError("a word")) == "a word"
