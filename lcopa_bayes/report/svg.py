"""Figures as SVG, the same bytes every time, with their captions."""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar, final
from zlib import crc32

from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure

from lcopa_bayes.plot.theme import BAND, HELD_OUT, INK, NOISE, OUTSIDE

T = TypeVar("T")
_COORDINATES = re.compile(r'\s(?:d|x|y)="[^"]*"')
_LONG_DECIMALS = re.compile(r"(\.\d\d)\d+")
COLOURS = {
    INK: ("ink", "#e6e6e6"),
    BAND: ("band", "#56b4e9"),
    HELD_OUT: ("held", "#ff9a5c"),
    NOISE: ("noise", "#a0a0a0"),
    "#000000": ("black", "#ffffff"),
    "#ffffff": ("paper", "#15181c"),
    "#009e73": ("green", "#2fc79a"),
    "#7a6a00": ("olive", "#c9b53a"),
    "#56b4e9": ("sky", "#2f7dd1"),
    OUTSIDE: ("outside", "#2f261f"),
}
"""Colours of figures that a page replaces by a variable: its name and what it is on a dark ground."""
_LONGEST = 110
"""Letters of a file name from which the rest becomes a checksum."""
_NO_METADATA = dict.fromkeys(("Date", "Creator", "Format", "Type"))


def svg_of(figure: Figure) -> str:
    """The figure as SVG without dates or links to software, its coordinates to a hundredth of a point."""
    figure.set_facecolor("none")
    out = io.StringIO()
    # not `savefig`, which draws all of a figure with a layout once more, unseen
    FigureCanvasSVG(figure).print_svg(out, metadata=_NO_METADATA)  # type: ignore[no-untyped-call]
    return _COORDINATES.sub(lambda match: _LONG_DECIMALS.sub(r"\1", match[0]), out.getvalue())


def inlined(svg: str, prefix: str) -> str:
    """The `<svg>` element alone, with `prefix` before its ids to keep them unique within an HTML page."""
    element = svg[svg.index("<svg") :]
    element = re.sub(r'\sxmlns(:\w+)?="[^"]*"', "", element)
    element = re.sub(r"<metadata>.*?</metadata>|<!--.*?-->", "", element, flags=re.DOTALL)
    for colour, (name, _) in COLOURS.items():
        element = element.replace(colour, f"var(--{name})")
    element = re.sub(r'\bid="', f'id="{prefix}-', element)
    element = element.replace('href="#', f'href="#{prefix}-').replace("url(#", f"url(#{prefix}-")
    return element.strip()


@final
@dataclass(frozen=True)
class Drawing:
    """A figure as SVG, with the stem of its file name and its caption."""

    stem: str
    svg: str
    caption: str
    mark: str = ""
    """A word set before the caption that must not be overlooked, such as "held out"."""
    data: str = ""
    """File of the run folder with the numbers that are drawn."""
    series: Mapping[str, Any] | None = None
    """Curves whose values the page shows under the cursor, in panels over time."""


def drawing(
    stem: str,
    figure: Figure,
    caption: str,
    mark: str = "",
    data: str = "",
    series: Mapping[str, Any] | None = None,
) -> Drawing:
    """A figure as a drawing; names of axes are as long as people like, those of files are not, and two that
    begin alike stay two files."""
    if len(stem) > _LONGEST:
        stem = f"{stem[:_LONGEST]}_{crc32(stem.encode()):08x}"
    return Drawing(stem, svg_of(figure), caption, mark, data, series)


def paged(
    stem: str,
    names: Sequence[T],
    most: int,
    draw: Callable[[Sequence[T]], Figure],
    caption: str,
    data: str = "",
) -> tuple[Drawing, ...]:
    """Figures `<stem>_01` and so on, each of up to `most` of the `names`, as `draw` gives them."""
    parts = [names[k : k + most] for k in range(0, len(names), most)]
    return tuple(
        drawing(f"{stem}_{k:02d}", draw(part), caption, data=data) for k, part in enumerate(parts, start=1)
    )
