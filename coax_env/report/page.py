"""One self-contained HTML page from blocks: prose, tables, figures, callouts, cards.

Blocks are HTML text. Figures travel as JSON and are drawn by one script with plotly.js, which is in
the page once, packed; without figures it is left out. Readable on a phone and on paper, light and
dark. A number that a file holds too can be marked with its place there (`datum`).
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
from coax_env.report.figures import Figure, template


@dataclass(frozen=True)
class Section:
    """A heading and the blocks under it."""

    title: str
    blocks: Sequence[str]


def page(
    title: str, lead: Sequence[str], sections: Iterable[Section], kicker: str = "", top: str = ""
) -> str:
    """The whole page as HTML text.

    Args:
        title: of the page, the verdict if there is one.
        lead: sentences that say it all; plain text.
        kicker: a short line above the title: what this is about.
        top: a block under the lead.
    """
    parts = list(sections)
    links = "".join(f'<a href="#{_anchor(s.title)}">{escape(s.title)}</a>' for s in parts)
    body = "".join(
        f'<section id="{_anchor(s.title)}"><h2>{escape(s.title)}</h2>{"".join(s.blocks)}</section>'
        for s in parts
    )
    sentences = "".join(f"<p>{inline(s)}</p>" for s in lead)
    above = f'<p class="kicker">{escape(kicker)}</p>' if kicker else ""
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(title)}</title><style>{_file('page.css')}</style></head><body><main>"
        f'<header>{above}<h1>{escape(title)}</h1><div class="lead">{sentences}</div>{top}</header>'
        f"<nav>{links}</nav>{body}</main>{_scripts(body)}</body></html>\n"
    )


def _anchor(title: str) -> str:
    return re.sub(r"[^a-z0-9]+", "-", title.lower()).strip("-")


class Markup(str):
    """Text that is HTML already."""


def inline(text: str) -> str:
    """Plain text as HTML; ``**words**`` become bold and ```words``` code. Markup stays as it is."""
    if isinstance(text, Markup):
        return text
    safe = _UNBROKEN.sub("\\1\u00a0\\2", escape(text))
    safe = re.sub(r"\*\*(.+?)\*\*", r"<strong>\1</strong>", safe)
    return re.sub(r"`(.+?)`", r"<code>\1</code>", safe)


_UNBROKEN = re.compile(r"(\d) ((?:%|m/s²?|mm|ms|mN|N|rpm|nats|deg|kg|g|s|m)(?![\w]))")


def prose(text: str) -> str:
    """Paragraphs, parted by empty lines."""
    return "".join(f"<p>{inline(' '.join(p.split()))}</p>" for p in text.split("\n\n") if p.strip())


def bullets(items: Iterable[str]) -> str:
    """A list."""
    return "<ul>" + "".join(f"<li>{inline(item)}</li>" for item in items) + "</ul>"


def datum(text: str, place: str, value: float | None) -> Markup:
    """A number in words, marked with its exact value and its place in findings.json.

    Args:
        place: ``gain/channels/h/after``; parts of lists by their position.
    """
    if value is None:
        return Markup(inline(text))
    return Markup(f'<data value="{value!r}" data-of="{escape(place)}">{inline(text)}</data>')


def command(text: str) -> str:
    """A command line to copy."""
    return f"<pre><code>{escape(text)}</code></pre>"


def callout(text: str, kind: str = "note") -> str:
    """A framed remark; kind is ``note``, ``good`` or ``warning``."""
    return f'<aside class="callout {kind}">{inline(text)}</aside>'


def table(header: Sequence[str], rows: Iterable[Sequence[str]], caption: str = "") -> str:
    """A table; the first column is a heading, the others numbers or words."""
    head = "".join(f"<th>{inline(h)}</th>" for h in header)
    body = "".join(
        "<tr>"
        + f"<th scope='row'>{inline(row[0])}</th>"
        + "".join(
            f'<td data-head="{escape(h)}">{inline(cell)}</td>'
            for h, cell in zip(header[1:], row[1:], strict=True)
        )
        + "</tr>"
        for row in rows
    )
    above = f'<p class="caption">{inline(caption)}</p>' if caption else ""
    return (
        f'{above}<div class="scroll"><table><thead><tr>{head}</tr></thead>'
        f"<tbody>{body}</tbody></table></div>"
    )


def numbers_table(summary: str, header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table to open; on paper it is open."""
    body = f"<summary>{inline(summary)}</summary>{table(header, rows)}"
    return f'<details class="numbers">{body}</details>'


def tiles(items: Sequence[tuple[str, str, str]]) -> str:
    """Key numbers: (number, what it is, a remark)."""
    return (
        '<div class="tiles">'
        + "".join(
            f'<div class="tile"><b>{inline(big)}</b><span>{inline(what)}</span>'
            f"<small>{inline(remark)}</small></div>"
            for big, what, remark in items
        )
        + "</div>"
    )


def card(title: str, big: str, lines: Iterable[str], badge: str = "", kind: str = "") -> str:
    """One finding: a title, its size in words, and what to know about it."""
    flag = f'<span class="badge">{inline(badge)}</span>' if badge else ""
    text = "".join(f"<p>{inline(line)}</p>" for line in lines if line)
    return (
        f'<article class="card {kind}"><h3>{escape(title)}{flag}</h3>'
        f'<p class="big">{inline(big)}</p>{text}</article>'
    )


def cards(items: Iterable[str]) -> str:
    """Cards side by side where there is room."""
    return f'<div class="cards">{"".join(items)}</div>'


def side_by_side(blocks: Iterable[str]) -> str:
    """Blocks next to each other where there is room."""
    return f'<div class="pair">{"".join(f"<div>{b}</div>" for b in blocks)}</div>'


def details(summary: str, *blocks: str) -> str:
    """Something to open for those who want it."""
    return f"<details><summary>{inline(summary)}</summary>{''.join(blocks)}</details>"


def figure(fig: Figure, caption: str = "", label: str = "") -> str:
    """A plotly figure with a caption; ``label`` describes it to those who cannot see it."""
    height = fig["layout"]["height"]
    below = f"<figcaption>{inline(caption)}</figcaption>" if caption else ""
    return (
        f'<figure><div class="plot" role="img" aria-label="{escape(label or caption)}" '
        f'style="min-height:{height}px"></div>'
        f"{data_script(fig)}{below}</figure>"
    )


def chooser(
    options: Mapping[tuple[str, str], Figure],
    caption: str = "",
    names: tuple[str, str] = ("run", "channel"),
) -> str:
    """Figures of which one is shown, chosen by two lists.

    Args:
        options: (first, second) -> figure; the first entry is shown.
    """
    if not options:
        return ""
    lists = []
    for position, name in enumerate(names):
        words = list(dict.fromkeys(key[position] for key in options))
        entries = "".join(f"<option>{escape(w)}</option>" for w in words)
        lists.append(f"<label>{escape(name)} <select>{entries}</select></label>")
    shown = "".join(
        f'<div class="choice" data-key="{escape(a)}|{escape(b)}"{"" if k == 0 else " hidden"}>'
        f"{figure(fig, label=f'{a}, {b}')}</div>"
        for k, ((a, b), fig) in enumerate(options.items())
    )
    below = f"<p class='caption'>{inline(caption)}</p>" if caption else ""
    return (
        f'<div class="chooser"><div class="lists">{"".join(lists)}</div>{shown}'
        f'<p class="none" hidden>not measured in this run</p>{below}</div>'
    )


def data_script(content: Any) -> str:
    """Data for a script of the page, as JSON that cannot end the script."""
    text = json.dumps(content, separators=(",", ":"), allow_nan=False).replace("</", "<\\/")
    return f'<script type="application/json">{text}</script>'


def _file(name: str) -> str:
    return (resources.files("coax_env.report") / name).read_text(encoding="utf-8")


def _scripts(body: str) -> str:
    """What draws the figures and replays the flights that a page has; nothing for others."""
    plots, flights = 'class="plot"' in body, 'class="flight"' in body
    if not (plots or flights):
        return ""
    themes = json.dumps({"light": template(False), "dark": template(True)})
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
