"""What a run of `foottile` gives, and what several tests of commands feed it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib import resources


@dataclass(frozen=True)
class Outcome:
    """Exit code and the two streams."""

    code: int
    out: str
    err: str

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
