"""One self-contained HTML page from blocks: prose, tables, figures, callouts, cards.

The HTML stands in templates/ (Jinja2, everything escaped that is not HTML already); here is what is
computed for it. Figures travel as JSON and are drawn by one script with plotly.js, which is in the
page once, packed; without figures it is left out. Readable on a phone and on paper, light and dark.
A number that a file holds too can be marked with its place there (`datum`).
"""

import base64
import gzip
import json
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from html import escape
from importlib import resources
from typing import Any

from coax_env.errors import require
from coax_env.report.plot_style import Figure, plotly_template


class Markup(str):
    """Text that is HTML already."""

    def __html__(self) -> str:
        """As Jinja2 asks for it."""
        return self


@dataclass(frozen=True)
class Section:
    """A heading and the blocks under it, HTML each."""

    title: str
    blocks: Sequence[str]


def page(
    title: str, lead: Sequence[str], sections: Iterable[Section], kicker: str = "", top: str = ""
) -> str:
    """The whole page as HTML text.

    Args:
        title: of the page, the verdict if there is one.
        lead: sentences that summarise it; plain text.
        sections: in order; each gets an entry in the page's navigation.
        kicker: a short line above the title: what this is about.
        top: a block under the lead.
    """
    sections = list(sections)
    body = "".join(block for section in sections for block in section.blocks)
    template = _templates().get_template("page.html")
    text = template.render(
        title=title, lead=lead, sections=sections, kicker=kicker, top=top,
        style=_file("page.css"), scripts=_scripts(body),
    )  # fmt: skip
    return f"{text}\n"


# --- text -----------------------------------------------------------------------------------------


def inline(text: str) -> Markup:
    """Plain text as HTML; ``**words**`` become bold, ```words``` code. Markup stays as it is."""
    if isinstance(text, Markup):
        return text
    safe = _NUMBER_AND_UNIT.sub("\\1\u00a0\\2", escape(text))
    safe = re.sub(r"\*\*(.+?)\*\*", r"<strong>\1</strong>", safe)
    safe = re.sub(r"·10\^(−?\d+)", r"·10<sup>\1</sup>", safe)
    return Markup(re.sub(r"`(.+?)`", r"<code>\1</code>", safe))


_NUMBER_AND_UNIT = re.compile(r"(\d) ((?:%|m/s²?|mm|ms|mN|N|rpm|nats|deg|kg|g|s|m|cm|rad)(?![\w]))")
"""Not to be parted at the end of a line."""


def prose(text: str) -> Markup:
    """Paragraphs, parted by empty lines."""
    return _block("prose", [" ".join(p.split()) for p in text.split("\n\n") if p.strip()])


def bullets(items: Iterable[str]) -> Markup:
    """A list."""
    return _block("bullets", items)


def datum(text: str, place: str, value: float | None, factor: float = 1.0) -> Markup:
    """A number in words, marked with its exact value and its place in findings.json.

    Args:
        text: the number as it is read.
        place: ``gain/channels/h/after``; parts of lists by their position.
        value: the number as it is in the file; None leaves the text unmarked.
        factor: of the number as it is read: 57.3 where an angle is read in degrees.
    """
    if value is None:
        return inline(text)
    return _block("datum", text, place, repr(value), repr(factor))


def command(text: str) -> Markup:
    """A command line to copy."""
    return _block("command", text)


def callout(text: str, kind: str = "note") -> Markup:
    """A framed remark; kind is ``note``, ``good`` or ``warning``."""
    return _block("callout", text, kind)


def banner(heading: str, lines: Sequence[str], kind: str = "note") -> Markup:
    """A framed list under a heading; kind as of `callout`.

    Args:
        heading: in bold. lines: plain text, one bullet each. kind: of the frame.
    """
    return _block("banner", heading, lines, kind)


# --- tables and cards -----------------------------------------------------------------------------


def table(header: Sequence[str], rows: Iterable[Sequence[str]], caption: str = "") -> Markup:
    """A table.

    Args:
        header: one heading per column.
        rows: as many cells each; the first is the row's heading, the others numbers or words.
        caption: a line above it.
    """
    rows = list(rows)
    for row in rows:
        if len(row) != len(header):
            raise ValueError(f"{len(header)} columns, but a row has {len(row)} cells: {row}")
    return _block("table", header, rows, caption)


def folded_table(summary: str, header: Sequence[str], rows: Iterable[Sequence[str]]) -> Markup:
    """A table to be opened; on paper it is open.

    Args:
        summary: the line that opens it.
        header: as in `table`.
        rows: as in `table`.
    """
    return _block("folded_table", summary, header, list(rows))


def tiles(items: Iterable[tuple[str, str, str]]) -> Markup:
    """Key numbers: (number, its meaning, a remark)."""
    return _block("tiles", items)


def card(title: str, size: str, lines: Iterable[str], badge: str = "", kind: str = "") -> Markup:
    """One finding.

    Args:
        title: its name.
        size: how large it is, in words.
        lines: what else to know about it.
        badge: a few words beside the title.
        kind: ``warning``, or empty.
    """
    return _block("card", title, size, lines, badge, kind)


def cards(items: Iterable[str]) -> Markup:
    """Cards side by side where there is room."""
    return _block("cards", items)


def side_by_side(blocks: Iterable[str]) -> Markup:
    """Blocks next to each other where there is room."""
    return _block("side_by_side", blocks)


def details(summary: str, *blocks: str) -> Markup:
    """Blocks that are folded away under a summary."""
    return _block("details", summary, blocks)


# --- figures --------------------------------------------------------------------------------------


def figure(content: Figure, caption: str = "", label: str = "") -> Markup:
    """A plotly figure.

    Args:
        content: the figure, see plot_style.py; its layout has a height [px].
        caption: a line below it.
        label: describes it to those who cannot see it (default: the caption).
    """
    return _block("figure", content, caption, label)


def chooser(
    options: Mapping[tuple[str, str], Figure],
    caption: str = "",
    names: tuple[str, str] = ("run", "channel"),
) -> str:
    """Figures of which one is shown, chosen by two lists; nothing where there is none.

    Args:
        options: (first, second) -> figure; the first entry is shown.
        caption: a line below it.
        names: of the two lists.
    """
    return _block("chooser", options, caption, names) if options else ""


def data_script(content: Any) -> Markup:
    """Data for a script of the page, as JSON that cannot end the script."""
    text = json.dumps(content, separators=(",", ":"), allow_nan=False).replace("</", "<\\/")
    return Markup(f'<script type="application/json">{text}</script>')


# --- templates and scripts ------------------------------------------------------------------------


def rendered(name: str, **values: Any) -> Markup:
    """A file of templates/, filled in."""
    return Markup(_templates().get_template(name).render(**values))


def _block(name: str, *values: Any) -> Markup:
    """A macro of templates/blocks.html, filled in."""
    return Markup(getattr(_templates().get_template("blocks.html").module, name)(*values).strip())


@cache
def _templates() -> Any:
    """The templates' environment; Jinja2 is needed only where a page is made."""
    jinja2 = require("jinja2", "report")
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("coax_env.report"),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )
    environment.filters |= {"anchor": _anchor, "data_script": data_script, "inline": inline}
    return environment


def _anchor(title: str) -> str:
    """A section's title as the name that a link points to."""
    return re.sub(r"[^a-z0-9]+", "-", title.lower()).strip("-")


def _file(name: str) -> str:
    return (resources.files("coax_env.report") / name).read_text(encoding="utf-8")


def _scripts(body: str) -> str:
    """What draws the figures and replays the flights that a page has; nothing for others."""
    plots, flights = 'class="plot"' in body, 'class="flight"' in body
    if not (plots or flights):
        return ""
    themes = json.dumps({"light": plotly_template(False), "dark": plotly_template(True)})
    code = f"const THEMES={themes};{_file('page.js')}" + (
        _file("flight_view.js") if flights else ""
    )
    return (_packed_plotly() if plots else "") + f"<script>{code}</script>"


@cache
def _packed_plotly() -> str:
    """plotly.js, gzipped: 2 MB instead of 5. The page's script unpacks it."""
    library = require("plotly.offline", "report").get_plotlyjs().encode()
    packed = base64.b64encode(gzip.compress(library, mtime=0)).decode()
    return f'<script type="text/plain" id="plotly">{packed}</script>'
