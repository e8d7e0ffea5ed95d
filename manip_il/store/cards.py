"""The card that the Hub shows of a dataset or policy: `README.md` and what it needs, made from what lies in the folder.

No card holds an absolute path, a token or a date: the same folder gives the same bytes.
"""

from __future__ import annotations

from pathlib import Path

from manip_il.store.card_dataset import dataset_card
from manip_il.store.card_policy import policy_card
from manip_il.store.card_text import MADE_BY
from manip_il.store.manifest import Kind

CARD = "README.md"
STRIP = "assets/episodes.png"


def card_for(root: Path, kind: Kind, url: str) -> dict[str, bytes]:
    """Return path in the repository -> content. url: of the repository, for the commands that the card shows.

    A `README.md` that somebody else wrote is kept: then there is none among these. Raises `ManipError` for a folder
    that cannot be read.
    """
    own = root / CARD
    kept = own.is_file() and MADE_BY not in own.read_text(encoding="utf-8", errors="replace")
    if kind == "policy":
        return {} if kept else {CARD: policy_card(root, url).encode()}
    from manip_il.store.card_strip import picture_strip

    strip = picture_strip(root)
    files = {STRIP: strip} if strip else {}
    return files if kept else {**files, CARD: dataset_card(root, url, STRIP if strip else None).encode()}
