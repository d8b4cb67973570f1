"""Figures and their PNG encoding, with matplotlib."""

from __future__ import annotations

from io import BytesIO
from typing import TYPE_CHECKING

from devices.errors import require_extra

if TYPE_CHECKING:
    from matplotlib.figure import Figure

DPI = 120


def create_figure(width_in: float, height_in: float) -> Figure:
    """Create an empty figure of a size in inches.

    Raises:
        MissingExtraError: matplotlib is not installed.
    """
    with require_extra("plot", "a plot"):
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    figure = Figure(figsize=(width_in, height_in), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def render_png(figure: Figure) -> bytes:
    """Render a figure as a PNG."""
    png = BytesIO()
    figure.savefig(png, dpi=DPI, format="png")
    return png.getvalue()
