"""Labels of a frame against independent laws, and masks against frames without the masked effect."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

from estimator.core.camera import Camera
from skysim.camera import detector
from skysim.camera.detector import PARTICLES, SMEAR, AddedCharge
from skysim.camera.render import Window
from skysim.core.types import SourceTruth, taken
from skysim.core.yaml_reader import parse_yaml
from skysim.experiments import dataset_shards
from skysim.experiments.study.execution import trials
from skysim.experiments.study.execution.trials import TrialSetup, prepared_setup
from skysim.experiments.study.plan import TrialSpec
from skysim.scene.sections.camera import InterlineConfig
from skysim.tracking.onboard_model import assumed_camera
from tests.helpers.small_dataset import HEIGHT, SMALL, WIDTH

PARTICLE = {
    "camera.detector.particles": [{"per_cm2_s": 2000, "depth": "20 um", "electrons_um": 80}]
}


def setup_with(
    settings: dict[str, object] | None = None, trial: dict[str, object] | None = None
) -> TrialSetup:
    base = {key: parse_yaml(value)[1] for key, value in SMALL.items()}
    spec = TrialSpec(
        "shefex2",
        ".",
        1,
        {**base, **(settings or {})},
        {"kind": "frames", **(trial or {})},
        True,
    )
    return prepared_setup(spec, {})


def decoded(counts: list[int], shape: tuple[int, int]) -> np.ndarray:
    """A mask from run lengths down its columns, by a loop."""
    flat = np.concatenate([np.full(count, bool(n % 2)) for n, count in enumerate(counts)])
    return flat.reshape(shape[::-1]).T


def test_run_lengths_encode_the_mask_by_columns() -> None:
    rng = np.random.default_rng(2)
    masks = [rng.random((7, 5)) < share for share in (0.1, 0.5, 0.9) for _ in range(20)]
    masks += [np.zeros((3, 4), bool), np.ones((3, 4), bool)]
    for mask in masks:
        counts = dataset_shards.run_lengths(mask)
        assert sum(counts) == mask.size
        assert min(counts[1:], default=1) > 0
        np.testing.assert_array_equal(decoded(counts, mask.shape), mask)


@pytest.mark.parametrize(
    ("sigma_px", "streak_px"), [(0.8, 0.0), (1.0, 1.5), (1.0, 3.0), (1.0, 6.0), (0.8, 25.0)]
)
def test_the_width_of_a_streak_is_its_blur(sigma_px: float, streak_px: float) -> None:
    """Drawn five times finer: a line of light, blurred."""
    fine = 5
    shape = (150, 400)
    light = np.zeros(shape)
    light[75, 200 - round(fine * streak_px / 2) : 201 + round(fine * streak_px / 2)] = 1
    light = gaussian_filter(light, fine * sigma_px)
    area_px = light.sum() ** 2 / (light**2).sum() / fine**2
    found = dataset_shards.across_sigma_px(np.array([area_px]), np.array([streak_px]))[0]
    assert found == pytest.approx(sigma_px, rel=0.08)


def test_streak_vectors_match_the_rotating_camera() -> None:
    """Stars' directions from mid-exposure pixels by the estimator's camera, turned by the rate over the exposure."""
    setup = setup_with(trial={"rate_deg_s": 3.0})
    one = dataset_shards.label_frame(setup, 5)
    camera: Camera = assumed_camera(setup.lab.scene)
    rows = one.sources
    rate = one.truth.rate_cam_rad_s
    half_s = one.frame.exposure_s / 2
    assert len(rows) > 5
    middle = camera.rays(np.column_stack([rows["x_px"], rows["y_px"]]))
    # Directions at rest turn against the camera: v(t) = exp(-w t) v.
    begin, end = (
        camera.pixels(Rotation.from_rotvec(-rate * t).apply(middle))
        for t in (-half_s, half_s)
    )
    found = np.column_stack([rows["streak_x_px"], rows["streak_y_px"]])
    np.testing.assert_allclose(found, end - begin, atol=2e-3)
    assert np.linalg.norm(found, axis=1).min() > 1


def test_annotations_are_the_outlines_to_the_last_digit_and_none_without_sources() -> None:
    one = dataset_shards.label_frame(setup_with(), 5)
    seen = one.sources["snr"] >= dataset_shards.COCO_SNR
    boxes, corners = dataset_shards.outlines(taken(one.extents, seen))
    text = dataset_shards.coco_annotations(one, 7)
    found = [each for each in json.loads(b"[%b]" % text) if each["category_id"] == 1]
    assert len(found) > 5
    assert [each["bbox"] for each in found] == boxes.tolist()
    assert [each["segmentation"] for each in found] == corners[:, None].tolist()
    none = one._replace(
        sources=one.sources[:0], extents=taken(one.extents, slice(0)), masks={}
    )
    assert dataset_shards.coco_annotations(none, 7) == b""


def test_bright_sources_are_detected_where_their_light_is() -> None:
    """Alone within 12 px and 6 px from the border: a tracker may take two images that touch for one."""
    setup = setup_with()
    checked = 0
    for seed in (5, 6, 9):
        rows = dataset_shards.label_frame(setup, seed).sources
        xy = np.column_stack([rows["flux_x_px"], rows["flux_y_px"]])
        inside = ((xy > 6) & (xy < np.array([WIDTH, HEIGHT]) - 7)).all(axis=1)
        near = (np.linalg.norm(xy[:, None] - xy, axis=2) < 12) & (rows["snr"] > 3)
        bright = inside & (near.sum(axis=1) == 1) & (rows["snr"] > 30) & ~rows["saturated"]
        assert rows["detected"][bright].all()
        found = np.column_stack([rows["detected_x_px"], rows["detected_y_px"]])
        assert np.abs(found - xy)[bright].max() < 0.2
        assert not rows["detected"][rows["snr"] < 1].any()
        assert (np.diff(rows["electrons"]) <= 0).all()
        checked += int(bright.sum())
    assert checked >= 6


def test_the_box_of_a_still_star_is_a_square_about_it() -> None:
    """This holds even if rounding gives a streak of 1e-14 pixels."""
    rows = np.zeros(3, dataset_shards.SOURCE)
    rows["flux_x_px"] = 10
    rows["flux_y_px"] = 20
    rows["streak_x_px"] = [0, 1e-14, -1e-14]
    rows["sigma_px"] = 0.7
    for box, outline in zip(
        *dataset_shards.outlines(dataset_shards.image_extents(rows, Window(0, 1))),
        strict=True,
    ):
        assert box == pytest.approx([10.5 - 2.1, 20.5 - 2.1, 4.2, 4.2])
        assert sorted(outline) == pytest.approx(
            [8.4, 8.4, 12.6, 12.6, 18.4, 18.4, 22.6, 22.6]
        )


MOON: dict[str, object] = {
    "light.bodies": {},
    "start_time": "2012-06-27T03:30:00",
    "camera.focal_length": "60 mm",
    "camera.detector.anti_blooming": 1.0,
    "camera.detector.full_well_e": 1000,
    "exposure.time": "20 ms",
}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("shutter", "slack_px"),
    [({}, 4.5), ({"camera.shutter": {"kind": "rolling", "row_time": "0.1 ms"}}, 9)],
)
def test_the_outline_of_the_moon_is_about_its_saturated_disc(
    shutter: dict[str, object], slack_px: float
) -> None:
    """Half of it is lit; the lit limb is close to the outline, with no light beyond."""
    setup = setup_with(
        MOON | shutter, {"near": {"body": "moon", "off_deg": [0, 0.3]}, "rate_deg_s": 10}
    )
    for seed in (1, 2, 5):  # both limbs, far from the middle row
        one = dataset_shards.label_frame(setup, seed)
        moon = one.sources["radius_px"] > dataset_shards.DISC_PX
        assert moon.sum() == 1
        corner = dataset_shards.outlines(taken(one.extents, moon))[1].reshape(4, 2) - 0.5
        sides = corner[1] - corner[0], corner[3] - corner[0]
        y, x = np.nonzero(decoded(one.masks[dataset_shards.SATURATED], (HEIGHT, WIDTH)))
        near = np.hypot(x - one.sources["x_px"][moon], y - one.sources["y_px"][moon]) < 80
        inside = np.column_stack([x, y])[near] - corner[0]
        for side in sides:
            along = inside @ side / (side @ side)
            assert along.min() > 0
            assert along.max() < 1
            assert min(along.min(), 1 - along.max()) * np.linalg.norm(side) < slack_px


def test_a_detection_belongs_to_the_brightest_nearby_source_alone() -> None:
    xy = np.array([[10.0, 10], [11, 10], [50, 50]])
    one = np.ones(3)
    truth = SourceTruth(
        np.arange(3), xy, xy, np.array([1.0, 9, 4]), one, 0 * one, one, np.rint(xy).astype(int), one > 2, one,
        np.zeros((3, 2)),
    )  # fmt: skip
    rows, unmatched = dataset_shards.source_rows(truth, np.array([[10.2, 10.0], [80, 80]]))
    assert rows["id"].tolist() == [1, 2, 0]
    assert rows["detected"].tolist() == [True, False, False]
    np.testing.assert_array_equal(unmatched, [[80, 80]])


@pytest.mark.slow
def test_particles_are_masked_where_a_frame_without_them_differs() -> None:
    """Both frames have the same photons and the same noise; a count is 10 electrons, and the threshold 15."""
    with_, without = (
        dataset_shards.label_frame(setup_with(more), 4) for more in (PARTICLE, {})
    )
    assert PARTICLES not in without.masks
    mask = decoded(with_.masks[PARTICLES], (HEIGHT, WIDTH))
    config = setup_with().lab.scene.camera.detector
    added_e = (with_.frame.image_dn.astype(float) - without.frame.image_dn) * config.gain_e_dn
    free = with_.frame.image_dn < with_.frame.saturation_dn
    assert 20 < mask.sum() < 4000
    loss_e = 2 + 0.02 * np.abs(
        added_e
    )  # transfer loss moves a little charge to the next pixels
    assert (
        added_e[mask & free] > config.read_noise_e - config.gain_e_dn - loss_e[mask & free]
    ).all()
    assert (
        added_e[~mask & free] < config.read_noise_e + config.gain_e_dn + loss_e[~mask & free]
    ).all()


def test_labels_do_not_change_the_frame_of_the_trial() -> None:
    setup = setup_with(PARTICLE)
    frame, truth, _ = trials.render_trial_frame(setup, 4)
    image = frame.image_dn.copy()
    one = dataset_shards.label_frame(setup, 4)
    np.testing.assert_array_equal(one.frame.image_dn, image)
    np.testing.assert_array_equal(np.sort(one.sources["id"]), np.sort(truth.sources.id))


def test_saturated_pixels_are_those_whose_charge_exceeds_the_well() -> None:
    """Against the same photons in a deep well. Charge stays in its pixel; a count is 10 electrons."""
    base = dict.fromkeys(("camera.detector.cti_parallel", "camera.detector.cti_serial"), 0.0)
    base |= {"camera.detector.blooming": "none"}
    well_e = 1500
    shallow = dataset_shards.label_frame(
        setup_with(base | {"camera.detector.full_well_e": well_e}), 5
    )
    deep = setup_with(base)
    mask = decoded(shallow.masks[dataset_shards.SATURATED], (HEIGHT, WIDTH))
    config = deep.lab.scene.camera.detector
    charge_e = (
        dataset_shards.label_frame(deep, 5).frame.image_dn.astype(float) - config.offset_dn
    ) * config.gain_e_dn
    noise_e = config.read_noise_e
    assert mask.sum() > 3
    # The least saturated value is 3 sigma of the read-out noise below the well.
    assert mask[charge_e > well_e + 6 * noise_e].all()
    assert not mask[charge_e < well_e - 3 * noise_e - config.gain_e_dn].any()
    assert (shallow.sources["saturated"] == (shallow.sources["peak_e"] > well_e)).all()


def test_smear_is_masked_in_the_columns_that_get_more_than_the_threshold() -> None:
    """A pixel gets leak row_time / exposure of the light of all others of its column."""
    light = np.zeros((40, 6), np.float32)
    light[20, 1] = 1000
    light[20, 3] = 3000
    light[5, 5] = 9000
    added = AddedCharge(1.5)
    shutter = InterlineConfig(kind="interline", row_time="1 ms", leak=1.0)
    detector.smear(light.copy(), 1.0, shutter, added)
    share = 1e-3 * (light.sum(axis=0) - light)
    np.testing.assert_array_equal(added.masks[SMEAR], share > 1.5)
    assert 0 < added.masks[SMEAR].sum() < 120
