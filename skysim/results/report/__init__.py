"""What skysim writes for people: a report of blocks, as HTML, Markdown, JSON or on a terminal.

`blocks` are what a report is made of, `document` is the report, and `as_html`, `as_markdown` and `as_text` write it.
"""

from skysim.results.report_blocks import Block as Block
from skysim.results.report_blocks import Cell as Cell
from skysim.results.report_blocks import Code as Code
from skysim.results.report_blocks import Column as Column
from skysim.results.report_blocks import Facts as Facts
from skysim.results.report_blocks import Figure as Figure
from skysim.results.report_blocks import Items as Items
from skysim.results.report_blocks import Section as Section
from skysim.results.report_blocks import Table as Table
from skysim.results.report_blocks import Text as Text
from skysim.results.report_blocks import Tone as Tone
from skysim.results.report_blocks import Verdict as Verdict
from skysim.results.report import Report as Report
