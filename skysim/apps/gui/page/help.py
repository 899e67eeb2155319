"""Help of the page: what it is for, and its keys."""

from __future__ import annotations

from nicegui import ui

from skysim.apps.gui.shared import keys


def help_dialog() -> ui.dialog:
    with ui.dialog() as dialog, ui.card().style("max-width: 600px; padding: 20px 24px; gap: 12px"):
        ui.label("skysim gui").style("font-weight: 600; font-size: 15px")
        ui.label(
            "Point the star sensor, view its frame, and compare the tracker's attitude with the true one. Under a"
            " dome the angles are the vehicle's (roll, pitch, yaw); under the stars the camera's (RA, Dec, roll)."
        )
        with ui.element("div").style("display: grid; grid-template-columns: 110px 1fr; gap: 4px 12px"):
            for key in keys.KEYS:
                label = f'<span class="lab-keys" style="padding: 0; border: 0"><kbd>{key.label}</kbd></span>'
                ui.html(label, sanitize=False)
                ui.label(key.help)
    return dialog
