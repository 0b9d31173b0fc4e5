"""The drawing basics under `graphnav.plots`: a `Drawing` says what is to be seen, once.

`still` turns it into a matplotlib figure to write in any format and into an SVG element of a page, `interactive` into a
plotly figure to zoom and hover.
"""

from graphnav.panels import interactive
from graphnav.panels.colours import PALETTE, colour, css_colours
from graphnav.panels.drawing import LEFT, RIGHT, WIDTH, Drawing, Item, Label, Panel
from graphnav.panels.still import svg
from graphnav.panels.thinning import BINS, chosen_rows, thin, with_breaks
from graphnav.panels.ticks import limits, log_ticks, ticks

__all__ = [
    "BINS", "LEFT", "PALETTE", "RIGHT", "WIDTH", "Drawing", "Item", "Label", "Panel", "chosen_rows", "colour",
    "css_colours", "interactive", "limits", "log_ticks", "svg", "thin", "ticks", "with_breaks",
]  # fmt: skip
