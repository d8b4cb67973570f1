"""Outcome of a run of `foottile`, and texts of scenes for it."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any


@dataclass(frozen=True)
class Outcome:
    """Exit code and the two streams."""

    code: int
    out: str
    err: str

    def succeeds(self) -> Outcome:
        """Check that the exit code is 0."""
        assert self.code == 0, self.err
        return self

    def printed(self, code: int = 0) -> Any:
        """Check the exit code and return the printed JSON."""
        assert self.code == code, self.err
        return json.loads(self.out)

    def fails(self, code: int, *words: str) -> None:
        """Check the exit code, and that the second stream has all of these words."""
        assert self.code == code, self.err
        for word in words:
            assert word in self.err


Run = Callable[..., Outcome]
Simulate = Callable[..., Path]


def scene_text(name: str, tiles: int | None = None) -> str:
    """Return the file of a built-in scene, with all tiles or the first ones."""
    text = (resources.files("devices.scene") / "builtin" / f"{name}.toml").read_text("utf-8")
    if tiles is None:
        return text
    head, *each = text.split("[[tile]]")
    _, begin, rest = each[-1].partition("\n[")
    return "[[tile]]".join([head, *each[:tiles]]) + begin + rest


def short_rig() -> str:
    """Return the scene of the indenter with its fewest and with fast strokes."""
    kind = 'kind = "indentation"'
    return scene_text("indentation").replace(kind, f"{kind}\nrepeats = 2\nstroke_s = 1.5")


def static_only(text: str) -> str:
    """Return a scene's text with the models that need only the curve of a rig recording."""
    return re.sub(r"(?m)^models = .*$", 'models = ["unwrap", "static"]', text)


def faulty(kind: str, *, t_s: float = 0.0, duration_s: float = 1000.0, **keys: object) -> str:
    """Return the section of a scene's fault, which lasts for the whole recording by default."""
    keys |= {"t_s": t_s, "duration_s": duration_s}
    lines = "".join(f"{key} = {json.dumps(value)}\n" for key, value in keys.items())
    return f'\n[[fault]]\nkind = "{kind}"\n{lines}'
