"""Figures as SVG inside a page, in the colours of the page, so that they suit light and dark."""

import io
import re
from collections.abc import Callable
from typing import Any

import matplotlib as mpl
from matplotlib.figure import Figure

from jaxguide.plotting import COLOURS, STYLE

# Stand-ins, which are replaced by the colours of the page; no figure uses them otherwise.
INK, FAINT, PAPER = "#010203", "#0a0b0c", "#0d0e0f"
_COLOURS = {
    INK: "currentColor",
    FAINT: "var(--grid)",
    PAPER: "var(--paper)",
    COLOURS[1].lower(): "var(--blue)",
    COLOURS[2].lower(): "var(--red)",
}
PAGE_STYLE: dict[Any, Any] = STYLE | {
    "text.color": INK,
    "axes.labelcolor": INK,
    "axes.edgecolor": INK,
    "xtick.color": INK,
    "ytick.color": INK,
    "grid.color": FAINT,
    "axes.facecolor": "none",
    "figure.facecolor": "none",
    "savefig.facecolor": "none",
    "legend.facecolor": PAPER,
    "legend.edgecolor": FAINT,
    "legend.labelcolor": INK,
}


def drawn(draw: Callable[..., Figure | None], *args: Any, title: str) -> str:
    """The figure that `draw(*args)` makes, as inline SVG; "" if it makes None.

    **Arguments:** `title`: for readers who cannot see the figure; also makes the SVG's ids unique.
    """
    settings: dict[Any, Any] = PAGE_STYLE | {"svg.hashsalt": title}  # ids of one page must differ
    with mpl.rc_context(settings):
        figure = draw(*args)
        if figure is None:
            return ""
        stream = io.StringIO()
        figure.savefig(stream, format="svg", dpi=150, metadata={"Date": None})
    text = stream.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.S)
    for stand_in, colour in _COLOURS.items():
        text = text.replace(stand_in, colour)
    ids = re.sub(r"\W+", "-", title)
    text = re.sub(r'\b(id="|xlink:href="#|url\(#)', rf"\g<1>{ids}-", text)
    return text.replace("<svg ", f'<svg role="img" aria-label="{title}" ', 1)
