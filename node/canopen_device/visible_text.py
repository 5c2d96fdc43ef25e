"""Text of devices and files as people may see it: characters that control a terminal or hide others are escapes."""

import re

_HIDDEN = (
    "\x00-\x08\x0b-\x1f\x7f-\x9f"  # C0 except the layout, DEL, C1
    "\xad\u061c\u180e\u200b\u200e\u200f\u2028-\u202e\u2060-\u206f\ufeff\ufff9-\ufffb"  # bidi controls, invisible
    "\ud800-\udfff"  # lone surrogates: no encoding has them
)


def visible_lines(text: str) -> str:
    """Return ``text`` with control and bidi characters and lone surrogates as escapes (``\\x1b``), but tab, newline."""
    return text if text.isprintable() else re.sub(f"[{_HIDDEN}]", _escape, text)


def visible(text: str) -> str:
    """Return ``text`` as visible_lines() does, with tabs and newlines as escapes, too: it stays one line."""
    return text if text.isprintable() else re.sub(f"[\t\n{_HIDDEN}]", _escape, text)


def shortened(text: str, most: int = 80) -> str:
    """Return the start of a text as a message shows it: ``most`` characters, and dots for the rest."""
    return text if len(text) <= most else f"{text[:most]}..."


def _escape(character: re.Match[str]) -> str:
    return character[0].encode("unicode_escape").decode()
