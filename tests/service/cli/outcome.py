"""What a run of `foottile` gives, and what several tests of commands feed it."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import dataclass
from importlib import resources
from typing import Any


@dataclass(frozen=True)
class Outcome:
    """Exit code and the two streams."""

    code: int
    out: str
    err: str

    def printed(self, code: int = 0) -> Any:
        """What it has printed as JSON; it has ended with this code."""
        assert self.code == code, self.err
        return json.loads(self.out)

    def fails(self, code: int, *words: str) -> None:
        """It has ended with this code, and its second stream has all of these words."""
        assert self.code == code, self.err
        for word in words:
            assert word in self.err


Run = Callable[..., Outcome]


def scene_text(name: str, tiles: int | None = None) -> str:
    """The file of a built-in scene, if asked for with its first tiles only."""
    text = (resources.files("devices.scene") / "builtin" / f"{name}.toml").read_text("utf-8")
    if tiles is None:
        return text
    head, *each = text.split("[[tile]]")
    _, begin, rest = each[-1].partition("\n[")
    return "[[tile]]".join([head, *each[:tiles]]) + begin + rest


def static_only(text: str) -> str:
    """A scene's text with the models that need no bench with holds, releases and taps."""
    return re.sub(r"(?m)^models = .*$", 'models = ["unwrap", "static"]', text)


def faulty(kind: str, *, t_s: float = 0.0, duration_s: float = 1000.0, **keys: object) -> str:
    """The section of a scene's fault; without other times it is there from the beginning."""
    keys |= {"t_s": t_s, "duration_s": duration_s}
    lines = "".join(f"{key} = {json.dumps(value)}\n" for key, value in keys.items())
    return f'\n[[fault]]\nkind = "{kind}"\n{lines}'
