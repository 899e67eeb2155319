"""Colors and CSS of the page. Sizes are fixed where changing content would otherwise shift the layout."""

import cv2
import numpy as np

from skysim.core.types import Floats

# Color-blind people can also distinguish the colors of states, marks and curves: tests/apps/gui/test_shell.py.
DARK = {
    "ground": "#0d1015",
    "panel": "#141922",
    "line": "#252c38",
    "text": "#d7dce4",
    "quiet": "#8b95a5",
    "accent": "#5aa9ff",
    "good": "#4fdcc0",
    "warn": "#d9b400",
    "bad": "#e2567f",
}
LIGHT = {
    "ground": "#f4f6f9",
    "panel": "#ffffff",
    "line": "#d3d9e2",
    "text": "#1b2330",
    "quiet": "#56606f",
    "accent": "#1463b8",
    "good": "#007f78",
    "warn": "#b05400",
    "bad": "#8a1040",
}
COLORS = {name: f"var(--lab-{name})" for name in DARK}  # CSS values, which follow the theme
CURVE_COLORS = ["#3aa6f2", "#e0a82a", "#0d7b84", "#d02f28"]  # for both themes


def chart_color(name: str) -> str:
    """JavaScript of a theme's color for ECharts; the name of its option must begin with a colon."""
    return f'getComputedStyle(document.body).getPropertyValue("--lab-{name}").trim()'


def variables(colors: dict[str, str]) -> str:
    return "; ".join(f"--lab-{name}: {color}" for name, color in colors.items())


RULE = {"lineStyle": {":color": chart_color("line")}}  # of a chart's grid
TOOLTIP = {
    "trigger": "axis",
    "confine": True,
    ":backgroundColor": chart_color("panel"),
    "borderWidth": 1,
    ":borderColor": chart_color("line"),
    "textStyle": {":color": chart_color("text"), "fontSize": 11},
}


def color_scale(values: Floats) -> Floats:
    """(N, 3) sRGB, 0 to 1, of values from 0 to 1: the map cividis, which looks the same to color-blind people.

    Its darkest third is left out, because it cannot be seen on the dark background.
    """
    levels = np.rint(85 + 170 * np.clip(values, 0, 1)).astype(np.uint8)
    return np.asarray(
        cv2.applyColorMap(levels[:, None], cv2.COLORMAP_CIVIDIS)[:, 0, ::-1] / 255
    )


CSS = f"""
body.body--dark {{ {variables(DARK)} }}
body.body--light {{ {variables(LIGHT)}; --q-primary: {LIGHT["accent"]} !important }}
body.body--light .lab-bar .q-checkbox__label {{ filter: brightness(.5) }}
:root {{ --nicegui-default-padding: 0; --nicegui-default-gap: 0 }}
body {{ background: {COLORS["ground"]} !important; color: {COLORS["text"]};
  font: 13px/1.45 Inter, system-ui, sans-serif }}
.nicegui-content {{ padding: 0; gap: 0; height: 100vh; overflow: hidden }}
.lab {{ display: grid; width: 100%; height: 100vh; grid-template-rows: 44px minmax(0, 1fr) 30px;
  grid-template-columns: minmax(0, 1fr) min(var(--lab-side, clamp(430px, 36vw, 660px)), 70vw);
  grid-template-areas: "head head" "sensor side" "keys keys" }}
.lab-head {{ grid-area: head }} .lab-sensor {{ grid-area: sensor }} .lab-side {{ grid-area: side }}
.lab-keys {{ grid-area: keys }}
.lab-head, .lab-keys {{ display: flex; align-items: center; gap: 14px; padding: 0 14px; background: {COLORS["panel"]};
  border: 0 solid {COLORS["line"]} }}
.lab-name {{ font-weight: 600; letter-spacing: .02em; white-space: nowrap }}
.lab-banner {{ flex: none; padding: 1px 8px; border-radius: 9px; font-size: 12px; max-width: 30ch; overflow: hidden;
  text-overflow: ellipsis; white-space: nowrap; border: 1px solid {COLORS["line"]}; color: {COLORS["quiet"]} }}
.lab-banner:is([data-state=flight], [data-state=replay], [data-state=photo]) {{
  border-color: {COLORS["warn"]}; color: {COLORS["warn"]} }}
.lab-scene {{ flex: 0 1 330px; min-width: 0 }} .lab-rate {{ width: 56px; text-align: right }}
.lab-said {{ flex: 1 1 0; min-width: 0; text-align: right; line-height: 1.3; max-height: 2.6em; overflow: hidden;
  display: -webkit-box; -webkit-box-orient: vertical; -webkit-line-clamp: 2; overflow-wrap: anywhere }}
.lab-busy, .lab-rate, .lab-head .q-btn, .lab-head .q-toggle {{ flex: none }}
.lab-busy.hidden {{ display: inline-flex; visibility: hidden }}
.lab-head {{ border-bottom-width: 1px }} .lab-keys {{ border-top-width: 1px; gap: 18px; overflow: hidden;
  white-space: nowrap; color: {COLORS["quiet"]}; font-size: 12px }}
.lab-keys kbd, .lab-command kbd {{ background: {COLORS["line"]}; color: {COLORS["text"]}; border-radius: 3px;
  padding: 1px 5px; font: 11px ui-monospace, monospace; margin-right: 5px }}
.lab-sensor {{ display: grid; grid-template-rows: auto minmax(0, 1fr); min-width: 0; min-height: 0 }}
.lab-bar {{ display: flex; flex-wrap: wrap; align-items: center; gap: 0 4px; padding: 2px 14px; min-width: 0 }}
.lab-bar .q-checkbox__label {{ font-size: 12.5px }}
.lab-view {{ display: grid; grid-template: minmax(0, 1fr) 24px 176px / minmax(0, 1fr); min-width: 0; min-height: 0 }}
.lab-frame {{ position: relative; min-height: 0; min-width: 0; margin: 0 14px; overflow: hidden }}
.lab-frame > canvas {{ position: absolute; inset: 0; width: 100%; height: 100%; touch-action: none; cursor: crosshair }}
.lab-frame > canvas:focus-visible {{ outline-offset: -2px }}
.lab-wait {{ position: absolute; inset: 0; display: flex; flex-direction: column; align-items: center; gap: 16px;
  justify-content: center; white-space: pre-line; text-align: center; line-height: 1.8; color: {COLORS["quiet"]};
  background: {COLORS["ground"]} }}
.lab-view {{ container-type: inline-size }}
.lab-readout {{ display: flex; align-items: center; gap: 6px; padding: 2px 14px; color: {COLORS["quiet"]} }}
.lab-readout > span {{ flex: 1 1 0; min-width: 0; overflow: hidden; text-overflow: ellipsis }}
.lab-readout > button {{ background: {COLORS["line"]}; color: {COLORS["text"]}; border: 0; border-radius: 3px;
  padding: 0 7px; font: 11px/18px ui-monospace, monospace; cursor: pointer }}
.lab-under {{ display: grid; grid-template: minmax(0, 1fr) / 252px minmax(0, 1fr) minmax(120px, 22%); gap: 14px;
  padding: 4px 14px 8px; min-height: 0 }}
.lab-under .mono {{ font-size: 11.5px }}
@container (max-width: 700px) {{
  .lab-under {{ grid-template: minmax(0, 1fr) 60px / 176px minmax(0, 1fr); gap: 4px 14px }}
  .lab-under > .lab-loupe {{ grid-row: span 2; width: 176px; height: 112px }} .lab-under > .lab-plot {{ height: 60px }}
  .lab-under .mono {{ white-space: pre-wrap; font-size: 11px; line-height: 1.35 }} }}
.lab-under > * {{ min-width: 0; overflow: hidden }}
.lab-loupe {{ width: 252px; height: 160px; outline: 1px dashed {COLORS["line"]} }}
.lab-plot {{ width: 100%; height: 160px; touch-action: none; cursor: ew-resize; background: {DARK["ground"]} }}
.lab-unseen {{ position: absolute; width: 1px; height: 1px; overflow: hidden; clip-path: inset(50%) }}
.lab-facts {{ display: grid; grid-template-columns: 128px minmax(0, 1fr); gap: 4px 12px }}
.lab-stops {{ display: grid; grid-template-columns: 40px repeat(4, minmax(0, 1fr)); gap: 0 10px; align-items: center }}
.lab-stops .num {{ text-align: right }}
.lab-run {{ display: flex; flex-direction: column; gap: 2px }} .lab-panels .q-tab-panel > * {{ flex: none }}
.lab-moment {{ position: absolute; left: 0; top: 0; bottom: 0; width: 1.5px; pointer-events: none;
  background: {CURVE_COLORS[0]} }} .lab-moment[hidden] {{ display: none }}
.lab-strips {{ position: relative; width: 100% }}
.lab-compared {{ width: 100%; padding: 4px 0 8px; border-top: 1px solid {COLORS["line"]} }}
.lab-compared > .mono {{ white-space: pre-wrap; overflow-wrap: anywhere; padding-left: 20px; text-indent: -20px }}
.lab-compared > [data-run=own]::before {{ content: "● "; color: {CURVE_COLORS[0]} }}
.lab-compared > [data-run=reference]::before {{ content: "◇ " }}
.lab-timeline {{ width: 100% }} .lab-timeline .lane {{ position: relative; height: 26px;
  border-bottom: 1px solid {COLORS["line"]} }}
.lab-timeline span {{ position: absolute; left: 0; font-size: 11px; line-height: 14px; pointer-events: none }}
.lab-timeline button {{ position: absolute; top: 15px; height: 9px; min-width: 5px; padding: 0; border: 0;
  transform: translateX(-2px); cursor: pointer }}
.lab-coverage > svg {{ display: block; width: 100%; max-width: 380px }} .lab-coverage p {{ margin: 2px 0 }}
.lab-coverage [role=button] {{ cursor: pointer }} .lab-coverage path {{ fill-opacity: .25; stroke-width: 2 }}
.lab-coverage text {{ fill: {COLORS["text"]}; font-size: 11px; text-anchor: middle; pointer-events: none }}
.lab-coverage .ring circle {{ fill: none; stroke: {COLORS["line"]} }}
.lab-coverage .ring text {{ fill: {COLORS["quiet"]}; font-size: 9px }}
.lab-coverage .legend {{ display: flex; flex-wrap: wrap; gap: 2px 12px; align-items: center }}
.lab-coverage .legend svg {{ display: inline; width: 16px; vertical-align: -3px; margin-right: 4px }}
.lab-dots {{ position: absolute; left: 0; top: 0; pointer-events: none }}
.mono.lab-log {{ white-space: pre-wrap; overflow-wrap: anywhere }}
.q-uploader__subtitle {{ display: none }} .q-uploader__title {{ font-size: 13px; font-weight: 500 }}
.lab-space {{ position: relative; overflow: hidden }}
.lab-space > canvas {{ position: absolute; inset: 0; width: 100%; height: 100%; touch-action: none }}
.lab-space > .lab-names {{ pointer-events: none }}
.lab-tag {{ position: absolute; left: 0; top: 0; pointer-events: none; color: #fff; background: #0d1015b0 }}
.lab-looks {{ position: absolute; right: 8px; top: 8px; display: flex; flex-direction: column; gap: 3px; z-index: 1 }}
.lab-looks > .q-btn {{ color: #9cc4ff; background: #0d1015 }}
.lab-push {{ position: absolute; left: 10px; top: 8px; display: flex; gap: 10px; align-items: center;
  color: #d7dce4; background: #0d1015b0 }} .lab-push > .q-btn {{ color: #9cc4ff }}
.lab-lights {{ width: 100%; border-collapse: collapse; cursor: default; text-align: right }}
.lab-lights th {{ position: sticky; top: -10px; font-weight: normal; color: {COLORS["quiet"]};
  background: {COLORS["panel"]} }}
.lab-lights.mono {{ font-size: 11px }} .lab-lights th {{ white-space: normal }}
.lab-lights tr > * {{ padding-left: 5px }} .lab-lights tr > :is(:first-child, :last-child) {{ width: 17%; max-width: 0;
  overflow: hidden; text-overflow: ellipsis }}
.lab-lights tr > :first-child {{ text-align: left }} .lab-lights tr.ringed {{ background: {COLORS["line"]} }}
.lab-turn {{ position: absolute; left: 8px; bottom: 6px; font-size: 11px; pointer-events: none; color: #aab3c2;
  background: #0d1015b0; padding: 0 4px }}
.lab-side {{ display: grid; grid-template: auto minmax(0, 1fr) / minmax(0, 1fr);
  border-left: 1px solid {COLORS["line"]}; min-height: 0; min-width: 0; background: {COLORS["panel"]} }}
.lab-side {{ position: relative }}
.lab-panes {{ display: grid; min-height: 0; grid-template: min(var(--lab-space, 38%), calc(100% - 60px)) 9px 34px
  minmax(0, 1fr) / minmax(0, 1fr) }}
.lab-space-pane {{ position: relative; min-height: 0; overflow: hidden; container-type: size }}
@container (max-height: 150px) {{ .lab-turn {{ display: none }} }}
.lab-split {{ touch-action: none; z-index: 5 }}
.lab-split.vertical {{ position: absolute; left: -4px; top: 0; width: 7px; height: 100%; cursor: col-resize }}
.lab-split.horizontal {{ cursor: row-resize; border: solid {COLORS["line"]}; border-width: 1px 0;
  background: radial-gradient(circle, {COLORS["quiet"]} 1px, transparent 1.5px) center / 7px 7px no-repeat,
  linear-gradient({COLORS["panel"]} 0 0) }}
.lab-split:hover, .lab-split:focus-visible {{ background: {COLORS["accent"]}; opacity: .6; outline: none }}
.lab-palette {{ width: min(560px, 94vw); max-width: none; padding: 8px 12px; gap: 4px }}
.lab-commands {{ max-height: 60vh; overflow: auto; width: 100% }}
.lab-command {{ display: flex; justify-content: space-between; gap: 12px; padding: 3px 8px; cursor: pointer;
  border-radius: 4px }}
.lab-command.chosen, .lab-command:hover {{ background: {COLORS["line"]} }}
.lab-card, .lab-head, .lab-readout, .lab-under > .mono {{ contain: content }}
.lab-card {{ padding: 10px 14px; border-bottom: 1px solid {COLORS["line"]}; width: 100% }}
.lab-panels {{ min-height: 0; overflow: hidden; background: transparent !important }}
.lab-panels .q-tab-panel {{ padding: 10px 14px; height: 100%; overflow: auto }}
.mono {{ font: 12.5px/1.6 ui-monospace, SFMono-Regular, Menlo, monospace; font-variant-numeric: tabular-nums;
  white-space: pre }}
.quiet, [data-state=quiet] {{ color: {COLORS["quiet"]} }} .good, [data-state=good] {{ color: {COLORS["good"]} }}
.bad, [data-state=bad] {{ color: {COLORS["bad"]} }} .warn, [data-state=warn] {{ color: {COLORS["warn"]} }}
.lab-grid {{ display: grid; grid-template-columns: 84px repeat(3, minmax(0, 1fr)); gap: 2px 10px; align-items: center }}
.lab-grid .num {{ text-align: right; min-height: 20px }}
.lab-status {{ margin-top: 6px; min-height: 20px }}
.lab-angle {{ width: 100%; height: 32px; padding: 0 12px; text-align: right; color: inherit; background: transparent;
  border: 1px solid color-mix(in srgb, currentColor 24%, transparent); border-radius: 4px }}
.lab-seek {{ flex: 1 1 0; min-width: 0; accent-color: {COLORS["accent"]} }}
.q-field--dense .q-field__control, .q-field--dense .q-field__marginal {{ height: 32px; min-height: 32px }}
.q-field--dense .q-field__native, .q-field--dense .q-field__input {{ min-height: 32px; padding: 2px 0;
  font-size: 12.5px }}
.q-field--labeled.q-field--dense .q-field__control, .q-field--labeled.q-field--dense .q-field__marginal {{
  height: 42px; min-height: 42px }}
.q-field--labeled.q-field--dense .q-field__native, .q-field--labeled.q-field--dense .q-field__input {{
  min-height: 42px; padding: 16px 0 2px }}
.q-select.q-field--dense.q-field--labeled .q-field__native {{ padding: 16px 0 0; min-height: 0 }}
.q-select.q-field--dense .q-field__native {{ flex-wrap: nowrap; overflow: hidden }}
.q-select.q-field--dense .q-field__native > span {{ overflow: hidden; text-overflow: ellipsis; white-space: nowrap }}
.q-select .q-select__focus-target {{ min-height: 0 !important; height: 1px; padding: 0 !important }}
.q-field__suffix {{ font-size: 12px; opacity: .7 }} .q-field__messages {{ font-size: 12px; line-height: 1.35 }}
.q-field--dense .q-field__native > span {{ font-size: 12.5px; line-height: 20px }}
.q-field--dense .q-field__label {{ font-size: 12px; top: 11px }}
.q-field--dense.q-field--float .q-field__label {{ transform: translateY(-38%) scale(.85) }}
.q-select.q-field--dense.q-field--labeled .q-field__native > span {{ margin-top: -12px }}
.lab-trial .q-field__control {{ padding: 0 4px 0 8px }} .lab-panels .q-btn {{ padding: 2px 8px }}
.lab-panels .q-uploader__header {{ background: {COLORS["line"]}; color: inherit }}
.q-field--dense .q-field__suffix {{ align-self: center; padding: 0 }}
.lab-trial {{ display: grid; width: 100%; grid-template-columns: 1fr 1.4fr 1fr 1fr .7fr 1fr; gap: 6px;
  margin: 8px 0 }}
.q-tab__content {{ min-width: 0 }} .q-tab__label {{ font-size: 13px }}
.q-tab {{ min-height: 34px; padding: 0 6px; text-transform: none }}
.q-tabs {{ min-height: 34px }}
.q-btn {{ text-transform: none }} .q-btn .q-btn__content {{ font-size: 12px; line-height: 1.5 }}
.lab-sections .q-item {{ padding: 2px 0 }} .lab-sections .given {{ font-weight: 600 }}
.lab-sections .warn::before {{ content: "* " }}
.q-field--borderless.q-field--focused, :focus-visible {{ outline: 2px solid {COLORS["accent"]}; outline-offset: 1px }}
@media (max-width: 1000px) {{
  .nicegui-content {{ overflow: auto }}
  .lab {{ height: auto; grid-template: auto auto auto auto / minmax(0, 1fr);
    grid-template-areas: "head" "sensor" "side" "keys" }}
  .lab-head {{ flex-wrap: wrap; row-gap: 0; min-height: 44px }} .lab .lab-split {{ display: none }}
  .lab-scene {{ flex: 1 1 150px }}
  .lab-said {{ text-align: left; flex-basis: 120px }} .lab-said:empty {{ flex-basis: 0 }}
  .lab-keys {{ flex-wrap: wrap; padding: 6px 14px; row-gap: 4px }}
  .lab-sensor {{ grid-template-rows: auto calc(min(70vh, 75vw) + 200px) }}
  .lab-bar {{ flex-wrap: wrap; padding: 4px 14px }}
  .lab-side {{ grid-template-rows: auto auto; border-left: 0 }}
  .lab-panes {{ grid-template-rows: 340px 34px 586px }}
  .lab-run > .row:first-child {{ flex-wrap: wrap }}
}}
@media (max-width: 600px) {{
  .lab-sensor {{ grid-template-rows: auto calc(75vw + 260px) }}
  .lab-view {{ grid-template-rows: minmax(0, 1fr) 24px 236px }}
  .lab-trial {{ grid-template-columns: repeat(2, minmax(0, 1fr)) }}
  .lab-lights tr > :is(:nth-child(6), :nth-child(7)) {{ display: none }}
  .lab-grid {{ grid-template-columns: 60px repeat(3, minmax(0, 1fr)); gap: 2px 6px }}
}}
@media (prefers-reduced-motion: reduce) {{
  *, ::before, ::after {{ animation: none !important; transition: none !important }}
}}
.empty {{ color: {COLORS["quiet"]}; padding: 28px 8px; text-align: center; line-height: 1.6 }}
"""
