"""Real camera over the simulation: its newest frame, the rendered one, both in turn, their difference and overlay."""

from nicegui import ui

from skysim.apps.gui.messages import REAL_VIEWS
from skysim.apps.gui.views import context, widgets
from skysim.apps.gui.worker.photo import Photo

BLINK_S = 0.7
BLINK = "blink"


class RealPanel:
    """The controls and the attitudes of a real frame and of the simulation.

    Attributes
    ----------
    shown
        The picture on the page, one of REAL_VIEWS
    name
        Name of the newest real frame; "" if there is none of the scene
    """

    shown = REAL_VIEWS[0]
    name = ""

    def __init__(self, page: context.PageContext) -> None:
        self.page = page
        with widgets.row(3):
            self.compares = widgets.checkbox("as the scene's camera")
            self.follows = widgets.checkbox("simulate at its attitude", value=True)
        self.follows.bind_visibility_from(self.compares, "value")
        with ui.column().classes("w-full gap-1") as self.results:
            self.views = ui.toggle(
                [*REAL_VIEWS, BLINK], value=self.shown, on_change=self.choose
            )
            self.views.props("dense no-caps unelevated size=sm")
            self.text = ui.label().style("white-space: pre-line")
            widgets.button("Explain the residuals", self.explain)
            self.answer = ui.label()
        self.empty()
        page.derive(lambda view: view.opened, self.empty)

    def empty(self) -> None:
        """Forget the real frames of a scene that is no longer there."""
        self.name = ""
        self.answer.set_text("")
        self.results.set_visibility(False)

    def show(self, photo: Photo) -> None:
        """Show a solved real frame, its attitude, that of the simulation, and their difference."""
        self.name = photo.name
        self.shown = REAL_VIEWS[0]
        self.page.show_photo(photo, kind="photo", photo=photo.name)
        row = photo.result.row
        self.text.set_text(
            f"{photo.name}: {row.status}, {row.matched} of {row.detected} lights identified, residuals"
            f" {row.rms_px:.3f} px rms\nreal minus simulated: cross {row.cross_arcsec:.1f}″,"
            f" roll {row.roll_arcsec:+.1f}″"
        )
        self.results.set_visibility(True)

    async def choose(self) -> None:
        """Show the chosen picture."""
        if self.views.value != BLINK:
            await self.show_view(str(self.views.value))

    async def blink(self) -> None:
        """Timer: change between the real frame and the simulated one."""
        state = self.page.state
        if self.views.value == BLINK and state.kind == "photo" and state.photo == self.name:
            await self.show_view(REAL_VIEWS[self.shown == REAL_VIEWS[0]])

    async def show_view(self, view: str) -> None:
        photo: Photo | None = await self.page.ask("real_view", view)
        if photo is not None:
            self.shown = view
            self.page.show_photo(photo, kind="photo", photo=photo.name)

    async def explain(self) -> None:
        """Say what a survey by the real frames finds."""
        text = await self.page.run_task("explain", activity="adjusting to the real frames …")
        if text is not None:
            self.answer.set_text(text)
            self.page.log(text)
