"""The warm-up's frames: every compiled pixel type, with spots at their positions."""

from __future__ import annotations

import numba
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as some

from estimator.core.camera import Camera
from estimator.core.errors import ImageError
from estimator.core.jit import compiled_s
from estimator.detection.detect import to_native
from estimator.trackers import pipeline
from tests.helpers.laws import law


@law(compiled_s, slow=True)
@given(added=some.integers(1, 9))
def test_the_time_of_a_stage_is_without_compilation(added: int) -> None:
    numba.njit(lambda x: x - 1)(1)  # loads the compiler
    before_s = compiled_s()
    clock = pipeline.Clock()
    assert numba.njit(lambda x: x + added)(1) == 1 + added
    clock.lap("stage")
    assert 0 < 4 * clock.seconds["stage"] < compiled_s() - before_s


@law(pipeline.loop_type)
@given(
    array=some.sampled_from(
        ["u1", "u2", ">u2", "?", "i1", "i2", ">i4", "i8", "f2", "f4", ">f8"]
    )
)
def test_a_frame_is_converted_to_the_type_of_its_compiled_loop(array: str) -> None:
    assert to_native(np.ones((3, 3), array)).dtype == pipeline.loop_type(array)


@pytest.mark.parametrize(
    ("dtype", "loops"),
    [("u1", "u2"), (">u2", "u2"), ("?", "u2"), ("i2", "i4"), ("i8", "i4"), (">f4", "f8")],
)
def test_three_types_of_pixels_are_compiled(dtype: str, loops: str) -> None:
    assert pipeline.loop_type(dtype) == np.dtype(loops)


@pytest.mark.parametrize("dtype", ["c16", "U3", "no type", object])
def test_pixels_that_are_not_numbers_are_refused(dtype: object) -> None:
    with pytest.raises(
        ImageError, match=r"warm_up: dtype is .*; allowed: the type of the frames' pixels"
    ):
        pipeline.loop_type(dtype)  # type: ignore[arg-type]


@law(pipeline.draw, pipeline.run_all_stages)
@given(x_px=some.floats(12, 50), y_px=some.floats(12, 40))
def test_warm_up_spots_are_drawn_at_their_positions(x_px: float, y_px: float) -> None:
    camera = Camera.from_fov(64, 48, fov_deg=5)
    image = pipeline.draw(
        camera, np.array([[x_px, y_px], [1.0, 47.0]]), np.array([1e7, 1e6]), np.dtype("f8")
    )
    y, x = np.mgrid[:48, :64]
    light = np.where(np.hypot(x - x_px, y - y_px) < 6, image - pipeline.SKY, 0)
    assert [
        np.sum(light * x) / np.sum(light),
        np.sum(light * y) / np.sum(light),
    ] == pytest.approx([x_px, y_px], abs=1e-3)
    assert image[47, 1] == pytest.approx(1e6, rel=1e-3)
    kinds = []
    pipeline.run_all_stages(
        camera,
        np.array([[20.0, 30.0], [40.0, 9.0]]),
        np.ones(2),
        "u1",
        lambda *one: kinds.append(one),
    )
    assert {image.dtype for image, _ in kinds} == {np.dtype("u2")}
    assert (
        max(image.max() for image, _ in kinds) > 4096 > min(image.max() for image, _ in kinds)
    )
    assert {streak for _, streak in kinds} == {None, (0.0, 0.0), pipeline.STREAK_PX}
