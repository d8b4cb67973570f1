"""Write the page that the live page's warnings link to, from its document.

`python scripts/help_page.py` after a change of docs/tile-reads-nonsense.md. The page has to be
there where there is no internet, and where browsers run no script.
"""

from __future__ import annotations

import html
import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
SOURCE = ROOT / "docs" / "tile-reads-nonsense.md"
PAGE = ROOT / "web" / "tile-reads-nonsense.html"
_HEAD = """<!doctype html>
<html lang="en-GB">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1, viewport-fit=cover">
<meta name="color-scheme" content="light dark">
<title>When a tile reads nonsense - FootTile</title>
<link rel="icon" href="/static/favicon.svg" type="image/svg+xml">
<link rel="stylesheet" href="/static/style.css">
<link rel="stylesheet" href="/static/help.css">
</head>
<body class="help-page">
<main>
<nav><a href="/">← Live page</a></nav>
"""


def render_page(text: str) -> str:
    """Return the page of a document that has headings, paragraphs and numbered lists."""
    parts = [_HEAD]
    for block in re.split(r"\n\n+", text.strip()):
        if heading := re.fullmatch(r"(#+) (.+)", block):
            level, title = len(heading[1]), heading[2]
            slug = re.sub(r"\W+", "-", title.lower())
            parts.append(f'<h{level} id="{slug}">{_inline(title)}</h{level}>')
        elif block.startswith("1. "):
            items = re.split(r"\n(?=\d+\. )", block)
            lines = (f"<li>{_inline(item.partition('. ')[2])}</li>" for item in items)
            parts.append("\n".join(["<ol>", *lines, "</ol>"]))
        else:
            parts.append(f"<p>{_inline(block)}</p>")
    return "\n".join([*parts, "</main>", "</body>", "</html>", ""])


def _inline(text: str) -> str:
    text = html.escape(re.sub(r"\s*\n\s*", " ", text), quote=False)
    text = re.sub(r"`([^`]+)`", r"<code>\1</code>", text)
    text = re.sub(r"\[([^]]+)\]\([^)]+\)", r"<cite>\1</cite>", text)  # not on this server
    return re.sub(r"\*([^*]+)\*", r"<em>\1</em>", text)


if __name__ == "__main__":
    PAGE.write_text(render_page(SOURCE.read_text("utf-8")), "utf-8")
