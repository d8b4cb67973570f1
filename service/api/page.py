"""Where the files of the live page are, in a checkout and in an installed wheel."""

from __future__ import annotations

from pathlib import Path

from devices.errors import FootTileError


def page_folder() -> Path:
    """Folder with `index.html`.

    Raises:
        FootTileError: the installation lacks it.
    """
    here = Path(__file__).resolve().parent
    # A wheel carries it as service/web, a checkout has it next to service.
    for folder in (here.parent / "web", here.parents[1] / "web"):
        if (folder / "index.html").is_file():
            return folder
    raise FootTileError(
        "the live page is not installed",
        where=str(here.parent / "web"),
        remedy="Install foottile again",
    )
