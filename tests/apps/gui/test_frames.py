"""Frames sent to the browser are reduced to the screen's pixels while frames follow one another."""

from __future__ import annotations

import asyncio
import json
import pickle
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import pytest
from astropy.visualization import ZScaleInterval

from tests.helpers.labpage import (
    CHROMIUM,
    NARROW,
    Server,
    come,
    exported,
    opened,
    panel,
    source,
)

pytest.importorskip("nicegui", reason="the extra `gui` is not installed")

import httpx
from astropy.io import fits

from skysim.apps.gui.messages import ALL_PIXELS, LIGHT, LIMITS, Display, Pixels
from skysim.apps.gui.server import Guard
from skysim.apps.gui.views import overlay as served_module
from skysim.apps.gui.views.overlay import (
    FRAMES,
    KEPT_FRAMES,
    ServedFrame,
    TabFrames,
    display_of,
)
from skysim.apps.gui.views.widgets import Contents
from skysim.apps.gui.worker.pixels import (
    BINS,
    SATURATED,
    SHADES,
    levels_of,
    limits_of,
    pixels_for,
    shades,
)
from skysim.apps.gui.worker.session import WorkerLost
from skysim.apps.gui.worker.tasks import Worker
from skysim.results import plots

HEADER_BYTES = 16  # offset and step before the pixels
SCREEN = (77, 200)  # narrower than the frames


def sky(seed: int, shape: tuple[int, int] = (120, 160)) -> np.ndarray:
    """Pixels of a sky with some bright stars."""
    random = np.random.default_rng(seed)
    image = random.poisson(100, shape).astype(np.uint16)
    image.ravel()[random.integers(0, image.size, 60)] += 3000
    return image


def decoded(data: bytes) -> tuple[dict[str, Any], np.ndarray]:
    """Fields and pixels of a response, by its description in pixels.js."""
    length = int.from_bytes(data[-4:], "little")
    fields = json.loads(data[-4 - length : -4])
    kind = np.uint8 if fields["shaded"] else np.uint16
    return fields, np.frombuffer(data[HEADER_BYTES : -4 - length], kind).reshape(
        fields["grid"][::-1]
    )


class Source:
    """Substitute for a session: the worker shows an image of number 1, or has ended (None)."""

    def __init__(self, image: np.ndarray | None) -> None:
        self.image = image
        self.display = ALL_PIXELS

    async def run(self, task: str, *arguments: Any) -> Pixels | None:
        if self.image is None:
            raise WorkerLost
        worker = Worker(shown={1: (levels_of(self.image), np.inf)}, number=1)
        return getattr(worker, task)(*arguments)


def served(
    image: np.ndarray, display: Display = ALL_PIXELS, saturation_dn: float = np.inf
) -> ServedFrame:
    pixels = pixels_for(display, levels_of(image), saturation_dn, 1)
    return ServedFrame(pixels, {"label": "sky"}, Source(image))


def response(
    frame: ServedFrame, display: Display, whole: bool = False
) -> tuple[dict[str, Any], np.ndarray]:
    return decoded(asyncio.run(frame.response(display, whole)))


def test_all_pixels_arrive_unchanged_with_the_frame_s_fields() -> None:
    image = sky(1)
    fields, levels = response(served(image, saturation_dn=4095.0), ALL_PIXELS)
    np.testing.assert_array_equal(levels, image)
    assert fields["size"] == [160, 120]
    assert (fields["label"], fields["saturation"]) == ("sky", 4095)
    assert response(served(image), ALL_PIXELS)[0]["saturation"] is None


@pytest.mark.parametrize("limits", [*LIMITS, (90.0, 300.0)])
def test_fewer_pixels_have_the_same_limits_and_histogram(
    limits: str | tuple[float, float],
) -> None:
    display = Display(SCREEN, limits)
    frame = served(sky(2), display)
    fewer, whole = (response(frame, display, whole) for whole in (False, True))
    np.testing.assert_array_equal(whole[1], sky(2))
    assert fewer[1].shape == (58, 77)
    assert [fewer[0][name] for name in ("limits", "histogram")] == [
        whole[0][name] for name in ("limits", "histogram")
    ]


def test_all_pixels_are_served_while_the_worker_keeps_them() -> None:
    display = Display(SCREEN)
    image = sky(2)
    frame = served(image, display)
    zoomed = Display()
    np.testing.assert_array_equal(response(frame, zoomed)[1], image)
    assert frame.source.display == zoomed  # the worker makes the next frame so
    pixels = pixels_for(display, levels_of(image), np.inf, 2)
    for worker in (Source(image), Source(None)):  # it shows another one, and it has ended
        assert (
            asyncio.run(ServedFrame(pixels, {}, worker).response(display, whole=True)) is None
        )


def test_limits_of_a_reduced_frame_are_those_of_all_pixels() -> None:
    frame = served(sky(2))
    for screen_px in ((0, 0), (999, 999)):
        found = response(frame, Display(screen_px, "min to max"))[0]["limits"]
        assert found == [sky(2).min(), sky(2).max()]


def reduced(image: np.ndarray, columns: int) -> np.ndarray:
    """Means over areas, from their shades between 0 and 2540 without rounding in between."""
    found = shades(image, columns, (0.0, 2540.0), np.inf, "linear")
    return np.where(found == SATURATED, np.inf, found * 10.0)


def test_a_shade_is_the_mean_over_its_area() -> None:
    image = np.random.default_rng(3).integers(0, 2541, (120, 160)).astype(np.uint16)
    np.testing.assert_allclose(
        reduced(image, 40), image.reshape(30, 4, 40, 4).mean(axis=(1, 3)), atol=5.6
    )
    shares = [
        overlaps(length, count) for length, count in zip(image.shape, (58, 77), strict=True)
    ]
    means = shares[0] @ image @ shares[1].T  # areas that share pixels
    np.testing.assert_allclose(reduced(image, 77), means, atol=5.6)
    assert reduced(image.astype(np.uint8), 40).shape == (30, 40)


def overlaps(length: int, count: int) -> np.ndarray:
    """(count, length) share of each pixel of a row in each of as many equal areas, by their ends."""
    ends = np.arange(count + 1) * length / count
    edges = np.arange(length)
    shared = np.minimum(ends[1:, None], edges + 1) - np.maximum(ends[:-1, None], edges)
    return np.clip(shared, 0, None) * count / length


@pytest.mark.parametrize("curve", plots.CURVES)
def test_shades_follow_the_curve_between_the_limits(curve: str) -> None:
    image = np.repeat(np.arange(0, 500, dtype=np.uint16)[None], 2, axis=0).repeat(2, axis=1)
    found = shades(image, 500, (100.0, 400.0), np.inf, curve)[0]
    fraction = np.clip((np.arange(500) - 100) / 300, 0, 1)
    np.testing.assert_array_equal(
        found, np.rint((SHADES - 1) * plots.CURVES[curve](fraction))
    )


def test_a_single_saturated_pixel_is_seen_in_the_reduced_frame() -> None:
    image = sky(4)
    # the second is on the edge of two areas
    image[51, 80] = 4095
    image[90, 83] = 4095
    found = shades(image, 61, (0.0, 100.0), 4095.0, "linear")
    assert np.argwhere(found == SATURATED).tolist() == [[19, 30], [34, 31], [34, 32]]


@pytest.mark.parametrize(
    ("query", "display"),
    [
        ({}, Display()),
        (
            {"screen": "640,480", "limits": "zscale", "curve": "linear", "near": "5,6"},
            Display((640, 480), "zscale", "linear", (5, 6)),
        ),
        ({"limits": "-1.5,2e3", "near": ""}, Display((0, 0), (-1.5, 2000.0))),
        *[({"screen": screen}, None) for screen in ("x", "5", "-4,5", "1.5,2", "1000000,5")],
        *[
            ({"limits": limits}, None)
            for limits in ("other", "2,1", "1", "nan,2", "1,inf", "1,2,3", "")
        ],
        *[({"near": near}, None) for near in ("5", "5,6,7", "-1,3", "x,y")],
        ({"curve": "other"}, None),
    ],
)
def test_a_query_gives_display_settings_or_is_refused(
    query: dict[str, str], display: Display | None
) -> None:
    assert display_of(query) == display


@pytest.mark.parametrize("seed", range(4))
def test_zscale_matches_astropy_and_other_limits_match_pictures(seed: int) -> None:
    image = sky(seed, (70, 90 + seed))
    levels = levels_of(image)
    np.testing.assert_allclose(
        limits_of(levels, "zscale"), ZScaleInterval().get_limits(image), rtol=1e-12
    )
    assert limits_of(levels, "automatic") == plots.display_levels(image)
    assert limits_of(levels, "min to max") == (image.min(), image.max())
    assert limits_of(levels._replace(offset=-50.0, step=0.5), (100.0, 120.0)) == (
        300.0,
        340.0,
    )


def test_the_histogram_s_axis_is_linear_in_the_sky_and_holds_all_pixels() -> None:
    """Half of the counts are below the sky's median; the axis ends at the extremes of all pixels."""
    image = sky(5, (640, 640))
    found = response(served(image), ALL_PIXELS)[0]["histogram"]
    counts = np.array(found["counts"])
    (low, high) = found["range"]
    assert (len(counts), low, high) == (BINS, image.min(), image.max())
    assert counts.sum() == 40 * 80
    assert found["sky"] == np.median(image[::16, ::8])
    assert found["scatter"] == pytest.approx(10, rel=0.2)  # Poisson, mean 100
    first, last = np.arcsinh((np.array([low, high]) - found["sky"]) / found["scatter"])
    edges = np.linspace(first - 0.3, last + 0.3, BINS + 1)
    assert counts[edges[1:] < 0].sum() == pytest.approx(counts.sum() / 2, rel=0.2)


def test_the_loupe_s_pixels_come_unchanged_with_a_reduced_frame() -> None:
    image = sky(6)
    display = Display(SCREEN, near_px=(155, 40))
    near = response(served(image, display), display)[0]["near"]
    assert (near["x"], near["y"]) == (155, 40)
    assert near["levels"] == image[40:51, 155:].tolist()  # as far as the frame reaches


def test_frames_are_served_only_to_logged_in_browsers(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    async def nothing(*_: object) -> None:
        raise AssertionError("not a frame")

    guard = Guard(nothing, "0.0.0.0", "right", 1)
    image = sky(8)
    frames = {3: served(image), 4: served(image, Display((40, 40), near_px=(5, 6)))}
    monkeypatch.setitem(FRAMES, "tab", TabFrames(print, frames))

    async def answers(paths: Sequence[str], token: str) -> list[httpx.Response]:
        async def inside(scope: Any, receive: Any, send: Any) -> None:
            """The guard within an application, which lets a router raise what it has no answer for."""
            await guard(scope | {"app": guard}, receive, send)

        transport = httpx.ASGITransport(app=inside)
        cookies = {"skysim_gui_1": token}
        async with httpx.AsyncClient(
            transport=transport, base_url="http://lab", cookies=cookies
        ) as client:
            return [await client.get(path) for path in paths]

    assert asyncio.run(answers(["/frame/tab/3"], "wrong"))[0].status_code == 401
    paths = [
        "3?limits=zscale",
        "4?screen=40,40&limits=automatic&near=5,6",
        "4?screen=40,40&whole=1",
    ]
    whole, fewer, rest = asyncio.run(
        answers([f"/frame/tab/{path}" for path in paths], "right")
    )
    for answer in (whole, rest):
        np.testing.assert_array_equal(decoded(answer.content)[1], image)
    assert whole.headers["cache-control"] == "no-store"
    fields, levels = decoded(fewer.content)
    assert (levels.shape, fields["near"]["x"]) == ((30, 40), 5)
    wrong = [
        "tab/5",
        "tab/3?near=5,6,7",
        "other/3",
        "tab/x",
        "tab",
        "tab/3/4",
        "tab/3?screen=x",
        "tab/3?screen=-4,5",
    ]
    assert {
        answer.status_code
        for answer in asyncio.run(answers([f"/frame/{path}" for path in wrong], "right"))
    } == {404}


# Over a stream.


def split(message: bytes) -> tuple[int, np.ndarray]:
    """Image number and pixels of a message."""
    length, number = np.frombuffer(message, "<u4", 2)
    assert len(message) == 8 + length
    return int(number), decoded(message[8:])[1]


def test_a_frame_is_sent_over_the_stream_or_announced() -> None:
    async def story() -> tuple[list[int], list[bytes]]:
        announced = list[int]()
        got = list[bytes]()
        frames = TabFrames(announced.append)
        frames.add(1, served(sky(1)), alone=False)  # no stream yet
        stream = frames.stream(ALL_PIXELS)
        first = asyncio.ensure_future(anext(stream))
        await asyncio.sleep(0)
        frames.add(2, served(sky(2)), alone=False)
        got.append(await first)
        frames.add(3, served(sky(3)), alone=True)  # with a message that belongs to it
        frames.add(4, served(sky(4)), alone=False)  # which this one must not overtake
        frames.drawn = 4
        frames.add(5, served(sky(5)), alone=False)
        got.append(await anext(stream))
        return [*announced], got  # what comes when the loop closes is of no interest

    announced, got = asyncio.run(story())
    assert announced == [1, 3, 4]
    assert [split(message)[0] for message in got] == [2, 5]
    for number, image in map(split, got):
        np.testing.assert_array_equal(image, sky(number))


def test_a_stream_ends_without_frames_and_gives_way_to_a_newer_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(served_module, "IDLE_S", 0.02)

    async def story() -> tuple[list[int], list[bytes]]:
        announced = list[int]()
        got = list[bytes]()
        frames = TabFrames(announced.append)
        former, newer = (
            asyncio.ensure_future(anext(frames.stream(ALL_PIXELS), None)) for _ in range(2)
        )
        await asyncio.sleep(0)
        frames.add(1, served(sky(1)), alone=False)
        assert await former is None
        got.append(await newer)
        frames.drawn = 1
        # Idle from the start.
        await asyncio.gather(*[one async for one in frames.stream(ALL_PIXELS)])
        frames.add(2, served(sky(2)), alone=False)
        return [*announced], got  # what comes when the loop closes is of no interest

    announced, got = asyncio.run(story())
    assert ([split(message)[0] for message in got], announced) == ([1], [2])


def test_a_frame_of_a_lost_stream_is_announced() -> None:
    async def story() -> list[int]:
        announced = list[int]()
        frames = TabFrames(announced.append)
        stream = frames.stream(ALL_PIXELS)
        first = asyncio.ensure_future(anext(stream))
        await asyncio.sleep(0)
        for number in range(1, KEPT_FRAMES + 3):
            frames.add(number, served(sky(number)), alone=False)
        await first
        await stream.aclose()
        assert sorted(frames.newest) == list(range(3, KEPT_FRAMES + 3))
        return announced

    assert asyncio.run(story()) == [KEPT_FRAMES + 2]


def test_an_idle_stream_announces_undrawn_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    """The connection was lost, and the server has not noticed."""
    monkeypatch.setattr(served_module, "IDLE_S", 0.02)

    async def story(drawn: int) -> list[int]:
        announced = list[int]()
        frames = TabFrames(announced.append)
        stream = frames.stream(ALL_PIXELS)
        first = asyncio.ensure_future(anext(stream))
        await asyncio.sleep(0)
        frames.add(1, served(sky(1)), alone=False)
        await first
        frames.drawn = drawn
        assert await anext(stream, None) is None
        return announced

    assert [asyncio.run(story(drawn)) for drawn in (0, 1)] == [[1], []]


def test_a_worker_keeps_the_pixels_of_its_newest_images() -> None:
    worker = Worker(display=Display(SCREEN))
    for number in range(1, 5):
        assert worker.show(levels_of(sky(number)), np.inf).number == number
    kept = [worker.all_pixels(number, ALL_PIXELS) for number in range(1, 6)]
    assert [pixels is not None for pixels in kept] == [False, True, True, True, False]
    assert kept[1].data[HEADER_BYTES:] == sky(2).tobytes()


def test_lights_are_a_sequence_that_is_sent_as_columns() -> None:
    count = 500
    random = np.random.default_rng(7)
    lights = np.rec.fromarrays(
        [
            np.arange(count),
            random.uniform(0, 1000, (count, 2)),
            random.random(count),
            random.random(count),
            random.random(count),
            random.random(count) > 0.5,
        ],
        LIGHT,
    )
    again = pickle.loads(pickle.dumps(lights))
    assert len(pickle.dumps(lights)) < 50 * count + 1000  # eight bytes a number
    assert len(again) == count
    assert again[3] == lights[3]
    assert [light.id for light in again[5:8]] == [5, 6, 7]
    assert again[3].xy_px[0] == lights.xy_px[3, 0]


def test_page_contents_are_sent_with_the_next_frame_or_separately() -> None:
    async def story() -> list[dict[int, dict[str, str]]]:
        contents = Contents()
        sent = []
        contents.send = sent.append
        contents.set(1, {"text": "a"})
        assert contents.take() == {1: {"text": "a"}}  # a frame takes them
        await asyncio.sleep(0)
        assert sent == []
        contents.set(1, {"text": "a"})  # no change
        await asyncio.sleep(0)
        assert sent == []
        contents.set(1, {"text": "b"})
        contents.set(2, {"text": "c"})
        await asyncio.sleep(0)
        return sent

    assert asyncio.run(story()) == [{1: {"text": "b"}, 2: {"text": "c"}}]


# In the browser.

SQUARE = """schema: 1
base: shefex2
title: SHEFEX-2 with a square megapixel
camera: {width_px: 1024, height_px: 1024}
exposure: {time: "20 ms", rate_hz: 10, frames: 12, first: "0.1 s"}
"""
DRAWINGS = """() => { const canvas = document.querySelector('.lab-frame canvas'); window.drawings = [];
  new MutationObserver(() => window.drawings.push([canvas.dataset.frame, canvas.dataset.whole])).observe(
    canvas, {attributeFilter: ['data-frame', 'data-whole']}); }"""


@pytest.fixture(scope="module")
def square(browser: Any, server: Server) -> Iterator[Any]:
    (server.folder / "square.yaml").write_text(SQUARE)
    with opened(browser, server.login, NARROW) as page:
        page.get_by_role("combobox", name="Scene").click()
        before = source(page)
        page.get_by_role("option", name="square.yaml").click()
        assert come(lambda: source(page) != before)
        yield page


def is_whole(page: Any) -> bool:
    return bool(page.locator(".lab-frame canvas").get_attribute("data-whole") == "true")


@pytest.mark.browser
@pytest.mark.skipif(not CHROMIUM, reason="no Chromium")
def test_a_key_shows_a_reduced_frame_at_once_and_all_pixels_at_rest(
    square: Any, tmp_path: Any
) -> None:
    assert come(lambda: is_whole(square))
    square.evaluate(DRAWINGS)
    square.keyboard.press("ArrowLeft")
    assert come(
        lambda: square.evaluate("window.drawings.some(([, whole]) => whole === 'false')")
    )
    assert come(lambda: is_whole(square))
    frame = fits.getdata(exported(square, "frame, FITS", tmp_path))
    box = square.locator(".lab-frame canvas").bounding_box()
    square.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    text = square.locator(".lab-loupe").get_attribute("aria-label")
    x, y = (int(word) for word in text.split(",")[0].split()[2:4])
    values = [float(word) for word in text.partition(": ")[2].split()]
    np.testing.assert_array_equal(values, frame[y : y + 7, x : x + 11].ravel())
    square.keyboard.press(
        "ArrowLeft"
    )  # the loupe follows at once, before all pixels are there
    assert come(
        lambda: square.locator(".lab-loupe").get_attribute("aria-label") not in (text, "")
    )


@pytest.mark.browser
@pytest.mark.skipif(not CHROMIUM, reason="no Chromium")
def test_successive_frames_are_sent_over_one_request(square: Any) -> None:
    square.mouse.move(5, 5)
    asked = list[str]()
    square.on("request", lambda request: asked.append(request.url))
    square.wait_for_timeout(2500)  # the last stream has ended
    for _ in range(6):
        before = source(square)
        square.keyboard.press("ArrowLeft")
        assert come(lambda before=before: source(square) != before)
    for _ in range(3):  # one after the other comes to rest
        assert come(lambda: is_whole(square))
    frames = [url for url in asked if "/frame/" in url]
    assert sum("/next" in url for url in frames) == 1
    assert not [url for url in frames if "/next" not in url and "whole=1" not in url]


@pytest.mark.browser
@pytest.mark.skipif(not CHROMIUM, reason="no Chromium")
def test_a_zoomed_frame_has_all_pixels_at_once(square: Any) -> None:
    square.keyboard.press("ArrowLeft")
    box = square.locator(".lab-frame canvas").bounding_box()
    square.mouse.move(box["x"] + 200, box["y"] + 200)
    square.mouse.wheel(0, -600)
    assert come(lambda: is_whole(square))
    square.evaluate(DRAWINGS)
    before = source(square)
    square.keyboard.press("ArrowLeft")
    assert come(lambda: source(square) != before)
    square.wait_for_timeout(300)
    assert {whole for _, whole in square.evaluate("window.drawings")} <= {"true"}
    square.get_by_role("button", name="fit", exact=True).click()


@pytest.mark.browser
@pytest.mark.skipif(not CHROMIUM, reason="no Chromium")
def test_playing_a_flight_does_not_rebuild_the_page(square: Any) -> None:
    """The texts change with the frames, and NiceGUI's updates, each of which renders the whole page, do not come."""
    panel(square, "Run")
    square.get_by_role("button", name="Simulate").click()
    clock = square.locator("[data-state]", has_text="12/12")
    clock.wait_for()
    square.wait_for_timeout(500)
    square.evaluate("""() => { window.updates = 0;
      window.socket.on("update", () => { window.updates += 1; }); }""")
    square.get_by_role("button", name="Play").click()
    assert come(lambda: not clock.is_visible())
    assert come(clock.is_visible)
    assert square.evaluate("window.updates") <= 4  # play and pause
    assert square.get_by_label("Frame of the flight").input_value() == "11"
